"""Moving meshes as other programs know them: named parts, a frame rate, one origin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hood.assets.formats.image import Texture
from hood.media.pieces import looks_of, pieces_of
from hood.media.renderer.render import BODY_COLOR
from hood.rollouts.file.reader import RolloutData

#: Farther from the origin than this [m] float32, which most formats hold, is no longer good to 2 µm.
_FAR = 32.0
PARTS = ("cloth", "body")


@dataclass(frozen=True)
class ClipPart:
    """One moving mesh."""

    name: str
    pos: np.ndarray  # (T, V, 3) float64 m, from the clip's origin, its axis up
    faces: np.ndarray  # (F, 3)
    colour: tuple[float, float, float]  # sRGB, 0 to 1
    uv: np.ndarray | None = None  # (U, 2)
    uv_faces: np.ndarray | None = None  # (F, 3), into uv
    texture: Texture | None = None
    roughness: float = 0.9  # 0 to 1

    def normals(self, frame: int) -> np.ndarray:
        """Unit normals (V, 3) of one frame; of vertices without a face, or with faces of no area, any."""
        found = np.zeros((self.pos.shape[1], 3))
        of_faces = corner_normals(self.pos[frame], self.faces, self.faces)
        found[: len(of_faces)] = of_faces
        found[np.linalg.norm(found, axis=1) < 0.5] = [0.0, 1.0, 0.0]
        return found


@dataclass(frozen=True)
class Clip:
    """Meshes that move together."""

    parts: tuple[ClipPart, ...]
    fps: float
    origin: np.ndarray  # (3,) m, whole metres; zero for motions near the world's origin

    @property
    def num_frames(self) -> int:
        return len(self.parts[0].pos)


def clip_of(
    data: RolloutData,
    parts: Sequence[str] = PARTS,
    num_frames: int | None = None,
    up: str = "y",
    textures: Mapping[str, Texture] | None = None,
) -> Clip:
    """A rollout as a clip: the cloth, one part a garment of an outfit, and the body.

    Args:
        parts: of :data:`PARTS`; a body without vertices is left out.
        num_frames: the first so many; None: all.
        up: ``y`` as in the rollout, or ``z``: turned by 90° about x.
        textures: images of garments that have texture coordinates, by the garment's name.

    Raises:
        ValueError: nothing is left to export, or a position is not finite.
    """
    count = len(data.time) if num_frames is None else min(num_frames, len(data.time))
    dt = float(data.attributes.get("dt", 0.0))
    if not dt > 0:
        raise ValueError(f"dt is {dt} s; the file does not say how long a frame takes")
    meshes = []
    if "cloth" in parts:
        meshes += _cloth(data, data.cloth_pos[:count], textures or {})
    if "body" in parts and data.body_pos.shape[1]:
        meshes.append(ClipPart("body", data.body_pos[:count], data.body_faces, BODY_COLOR))
    if not meshes:
        raise ValueError("there is no body in it, and the cloth is not asked for; nothing is left to export")
    for mesh in meshes:
        broken = ~np.isfinite(mesh.pos).all(axis=(1, 2))
        if broken.any():
            frame = int(broken.argmax())
            raise ValueError(f"{mesh.name} has no finite position in frame {frame}; give num_frames={frame} or less")
    farthest = max(float(np.abs(mesh.pos).max(initial=0.0)) for mesh in meshes)
    origin = np.round(meshes[0].pos[0].astype(np.float64).mean(axis=0)) if farthest > _FAR else np.zeros(3)
    moved = (np.asarray(mesh.pos, np.float64) - origin for mesh in meshes)
    turned = tuple(replace(mesh, pos=_upright(pos, up)) for mesh, pos in zip(meshes, moved, strict=True))
    return Clip(turned, 1.0 / dt, _upright(origin, up))


def _cloth(data: RolloutData, pos: np.ndarray, textures: Mapping[str, Texture]) -> list[ClipPart]:
    """One part a garment where the file says which vertex belongs to which; it looks like the fabric of most of it."""
    found, (looks, look_of) = [], looks_of(data)
    for piece in pieces_of(data):
        number = np.full(pos.shape[1], -1)
        number[piece.vertices] = np.arange(len(piece.vertices))
        faces, texture = number[data.cloth_faces[piece.faces]], textures.get(piece.name)
        own = pos[:, piece.vertices]
        look = looks[int(np.bincount(look_of[piece.vertices], minlength=1).argmax())]
        found.append(ClipPart(piece.name, own, faces, look.colour, piece.uv, piece.uv_faces, texture, look.roughness))
    return found


def _upright(pos: np.ndarray, up: str) -> np.ndarray:
    """``pos`` (…, 3) with the wanted axis up; a turn, no mirror image."""
    return pos if up == "y" else np.stack([pos[..., 0], -pos[..., 2], pos[..., 1]], axis=-1)


def corner_normals(pos: np.ndarray, faces: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Unit normals (M, 3), one per number in ``corners`` (F, 3): area-weighted over the faces that share it."""
    a, b, c = (pos[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    total = np.zeros((int(corners.max(initial=-1)) + 1, 3))
    for k in range(3):
        np.add.at(total, corners[:, k], cross)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)

"""Moving meshes as other programs know them: named parts, a frame rate, one origin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hood.dynamics.recorder import RolloutData
from hood.media.mesh_export import corner_normals
from hood.media.palette import part_colour
from hood.media.render import BODY_COLOR

#: Farther from the origin than this [m] float32, which most formats hold, is no longer good to 2 µm.
FAR = 32.0
PARTS = ("cloth", "body")


@dataclass(frozen=True)
class Part:
    """One moving mesh."""

    name: str
    pos: np.ndarray  # (T, V, 3) float64 m, from the clip's origin, its axis up
    faces: np.ndarray  # (F, 3)
    colour: tuple[float, float, float]  # sRGB, 0 to 1
    uv: np.ndarray | None = None  # (U, 2)
    uv_faces: np.ndarray | None = None  # (F, 3), into uv

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

    parts: tuple[Part, ...]
    fps: float
    origin: np.ndarray  # (3,) m, whole metres; zero for motions near the world's origin

    @property
    def num_frames(self) -> int:
        return len(self.parts[0].pos)


def clip_of(data: RolloutData, parts: Sequence[str] = PARTS, num_frames: int | None = None, up: str = "y") -> Clip:
    """A rollout as a clip: the cloth, one part a garment of an outfit, and the body.

    Args:
        parts: of :data:`PARTS`; a body without vertices is left out.
        num_frames: the first so many; None: all.
        up: ``y`` as in the rollout, or ``z``: turned by 90° about x.

    Raises:
        ValueError: nothing is left to export, or a position is not finite.
    """
    count = len(data.time) if num_frames is None else min(num_frames, len(data.time))
    dt = float(data.attributes.get("dt", 0.0))
    if not dt > 0:
        raise ValueError(f"dt is {dt} s; the file does not say how long a frame takes")
    meshes = []
    if "cloth" in parts:
        meshes += _cloth(data, data.cloth_pos[:count])
    if "body" in parts and data.body_pos.shape[1]:
        meshes.append(Part("body", data.body_pos[:count], data.body_faces, BODY_COLOR))
    if not meshes:
        raise ValueError("there is no body in it, and the cloth is not asked for; nothing is left to export")
    for mesh in meshes:
        broken = ~np.isfinite(mesh.pos).all(axis=(1, 2))
        if broken.any():
            frame = int(broken.argmax())
            raise ValueError(f"{mesh.name} has no finite position in frame {frame}; give num_frames={frame} or less")
    farthest = max(float(np.abs(mesh.pos).max(initial=0.0)) for mesh in meshes)
    origin = np.round(meshes[0].pos[0].astype(np.float64).mean(axis=0)) if farthest > FAR else np.zeros(3)
    moved = (np.asarray(mesh.pos, np.float64) - origin for mesh in meshes)
    turned = tuple(replace(mesh, pos=_upright(pos, up)) for mesh, pos in zip(meshes, moved, strict=True))
    return Clip(turned, 1.0 / dt, _upright(origin, up))


def _cloth(data: RolloutData, pos: np.ndarray) -> list[Part]:
    """One part a garment where the file says which vertex belongs to which."""
    title = str(data.attributes.get("garment", "cloth"))
    piece, uv, uv_faces = (data.still.get(name) for name in ("piece", "uv", "uv_faces"))
    if (
        uv is None
        or uv_faces is None
        or uv.ndim != 2
        or uv.shape[1] != 2
        or uv_faces.shape != data.cloth_faces.shape
        or _outside(uv_faces, len(uv))
    ):
        uv = uv_faces = None
    if piece is None or piece.shape != (pos.shape[1],) or piece.min(initial=0) == piece.max(initial=0):
        return [Part(_plain(title), pos, data.cloth_faces, part_colour(0), uv, uv_faces)]
    words, labels, found = title.split("+"), sorted(set(piece.tolist())), list[Part]()
    for rank, label in enumerate(labels):
        own = np.flatnonzero(piece == label)
        number = np.full(len(piece), -1)
        number[own] = np.arange(len(own))
        mine = (number[data.cloth_faces] >= 0).all(axis=1)
        name = _plain(words[rank]) if len(words) == len(labels) else f"cloth_{rank}"
        name = name if name not in [part.name for part in found] else f"{name}_{rank}"
        faces, texture = number[data.cloth_faces[mine]], None if uv_faces is None else uv_faces[mine]
        found.append(Part(name, pos[:, own], faces, part_colour(rank), uv, texture))
    return found


def _outside(faces: np.ndarray, count: int) -> bool:
    return bool(faces.size and not 0 <= faces.min() <= faces.max() < count)


def _plain(name: str) -> str:
    """A name that every format takes: letters, digits and underscores, no digit first."""
    stem = Path(name).stem if "/" in name or "\\" in name else name
    plain = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in stem)
    plain = f"cloth_{plain}" if not plain or plain[0].isdigit() else plain
    return "cloth" if plain == "body" else plain


def _upright(pos: np.ndarray, up: str) -> np.ndarray:
    """``pos`` (…, 3) with the wanted axis up; a turn, no mirror image."""
    return pos if up == "y" else np.stack([pos[..., 0], -pos[..., 2], pos[..., 1]], axis=-1)

"""The garments in a rollout, one by one, with their texture coordinates.

Colours that tell the garments of an outfit apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from hood.media.renderer.render import GARMENT_COLOR
from hood.mesh import topology
from hood.rollouts.file.reader import RolloutData

#: In their order; far from the body's colour and from each other, in lightness as well.
_OTHERS = ((0.80, 0.45, 0.22), (0.30, 0.52, 0.34), (0.62, 0.28, 0.42), (0.86, 0.74, 0.38), (0.28, 0.26, 0.42))


def outfit_colours(name: str, faces: np.ndarray, num_vertices: int, piece: np.ndarray | None = None) -> ArrayLike:
    """sRGB, 0 to 1: one colour (3,) of a garment; (V, 3) of several, whose ``name`` joins theirs by ``+``.

    Args:
        faces: (F, 3).
        piece: (V,) garment that a vertex belongs to. None, as in older recordings: every connected component counts as one.
    """
    if piece is not None and piece.shape == (num_vertices,):
        return np.array([part_colour(rank) for rank in np.unique(piece, return_inverse=True)[1].tolist()])
    if "+" not in name:
        return GARMENT_COLOR
    part = topology.connected_components(num_vertices, topology.unique_edges(faces))
    # By their first vertices: garments lie one after another. Vertices of no face are not drawn.
    order = {int(label): rank for rank, label in enumerate(dict.fromkeys(part[np.unique(faces)].tolist()))}
    colours = np.array([GARMENT_COLOR, *_OTHERS])
    return colours[[order.get(int(label), 0) % len(colours) for label in part]]


def part_colour(rank: int) -> tuple[float, float, float]:
    """Colour, sRGB from 0 to 1, of garment number ``rank`` of an outfit."""
    colours = (GARMENT_COLOR, *_OTHERS)
    red, green, blue = (float(channel) for channel in colours[rank % len(colours)])
    return red, green, blue


@dataclass(frozen=True)
class GarmentPiece:
    """One garment."""

    name: str  # letters, digits and underscores
    vertices: np.ndarray  # (P,) their numbers in the rollout
    faces: np.ndarray  # (N,) their numbers in the rollout
    uv: np.ndarray | None  # (U, 2); None where the rollout holds none
    uv_faces: np.ndarray | None  # (N, 3) into uv

    @property
    def is_mapped(self) -> bool:
        """Whether its texture coordinates cover an area; in an outfit, garments without any lie in one point."""
        if self.uv is None or self.uv_faces is None or not len(self.uv_faces):
            return False
        corners = self.uv[self.uv_faces].reshape(-1, 2)
        return bool((corners != corners[0]).any())


def pieces_of(data: RolloutData) -> list[GarmentPiece]:
    """The garments of a rollout, in their order; one where the file does not say which vertex belongs to which."""
    return pieces_by(str(data.attributes.get("garment", "cloth")), data.cloth_pos.shape[1], data.cloth_faces, data.still)


def pieces_by(title: str, count: int, faces: np.ndarray, still: Mapping[str, np.ndarray]) -> list[GarmentPiece]:
    """The same by the names of the garments, joined by ``+``, the number of vertices, the faces (F, 3) and what a rollout holds
    beside them (:data:`hood.rollouts.file.recorder.STILL`)."""
    piece, uv, uv_faces = (still.get(name) for name in ("piece", "uv", "uv_faces"))
    if (
        uv is None
        or uv_faces is None
        or uv.ndim != 2
        or uv.shape[1] != 2
        or uv_faces.shape != faces.shape
        or _outside(uv_faces, len(uv))
    ):
        uv = uv_faces = None
    if piece is None or piece.shape != (count,) or piece.min(initial=0) == piece.max(initial=0):
        return [GarmentPiece(plain_name(title), np.arange(count), np.arange(len(faces)), uv, uv_faces)]
    words, labels, found = title.split("+"), sorted(set(piece.tolist())), list[GarmentPiece]()
    for rank, label in enumerate(labels):
        mine = np.flatnonzero((piece[faces] == label).all(axis=1))
        name = plain_name(words[rank]) if len(words) == len(labels) else f"cloth_{rank}"
        name = name if name not in [other.name for other in found] else f"{name}_{rank}"
        found.append(GarmentPiece(name, np.flatnonzero(piece == label), mine, uv, None if uv_faces is None else uv_faces[mine]))
    return found


def split_seams(faces: np.ndarray, uv_faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points to draw: a vertex on a seam of the texture is several.

    Args:
        faces, uv_faces: vertex and texture coordinate of every corner, (F, 3).

    Returns:
        Vertex (N,) and texture coordinate (N,) of every point, and the faces (F, 3) over points.
    """
    pairs = np.stack([faces.reshape(-1), uv_faces.reshape(-1)], axis=1)
    points, number = np.unique(pairs, axis=0, return_inverse=True)
    return points[:, 0], points[:, 1], number.reshape(-1, 3)


def plain_name(name: str) -> str:
    """A name that every format takes: letters, digits and underscores, no digit first."""
    stem = Path(name).stem if "/" in name or "\\" in name else name
    plain = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in stem)
    plain = f"cloth_{plain}" if not plain or plain[0].isdigit() else plain
    return "cloth" if plain == "body" else plain


def _outside(faces: np.ndarray, count: int) -> bool:
    return bool(faces.size and not 0 <= faces.min() <= faces.max() < count)

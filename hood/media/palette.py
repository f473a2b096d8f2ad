"""Colours that tell the garments of an outfit apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hood.media.render import GARMENT_COLOR
from hood.mesh import topology

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

"""Colours that tell the garments of an outfit apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hood.media.render import GARMENT_COLOR
from hood.mesh import topology

#: In their order; far from the body's colour and from each other, in lightness as well.
_OTHERS = ((0.80, 0.45, 0.22), (0.30, 0.52, 0.34), (0.62, 0.28, 0.42), (0.86, 0.74, 0.38), (0.28, 0.26, 0.42))


def outfit_colours(name: str, faces: np.ndarray, num_vertices: int) -> ArrayLike:
    """One colour (3,) of a garment; (V, 3) of several, whose ``name`` joins theirs by ``+``.

    A recording does not keep where one garment of an outfit ends: with as many components as names every garment has its
    colour, with more every component has.
    """
    if "+" not in name:
        return GARMENT_COLOR
    part = topology.connected_components(num_vertices, topology.unique_edges(faces))
    # By their first vertices: garments lie one after another. Vertices of no face are not drawn.
    order = {int(label): rank for rank, label in enumerate(dict.fromkeys(part[np.unique(faces)].tolist()))}
    colours = np.array([GARMENT_COLOR, *_OTHERS])
    return colours[[order.get(int(label), 0) % len(colours) for label in part]]


def part_colour(rank: int) -> tuple[float, float, float]:
    """Colour of garment number ``rank`` of an outfit, the same as in pictures."""
    colours = (GARMENT_COLOR, *_OTHERS)
    red, green, blue = (float(channel) for channel in colours[rank % len(colours)])
    return red, green, blue

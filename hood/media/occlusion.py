"""Shade where surfaces are near each other: what of the light from all sides reaches the pixels of a picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hood.media.raster import VisibilityBuffer

Array = NDArray[np.float64]

#: Distance [m] within which one surface shades another.
REACH = 0.09
_COUNT = 6
#: Sine of the angle above the tangent plane from which a surface shades: flat faces of a round surface do not.
_LEAST = 0.1
_STRENGTH, _DARKEST = 2.2, 0.2


def _around() -> Array:
    """Places (4, 6, 2) on the unit disc where a pixel looks, turned by a quarter of their angle among four pixels."""
    turn, index = np.arange(4)[:, None], np.arange(_COUNT)
    angle = 2.0 * np.pi * (2.0 * index / _COUNT * 1.5 + turn / 4.0 / _COUNT * 2.0 + index * 0.08)
    radius = np.sqrt((index + (turn + 0.5) / 4.0) / _COUNT)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


AROUND = np.ascontiguousarray(_around())


def openness(
    buffer: VisibilityBuffer, focal: float, row: NDArray[np.integer], column: NDArray[np.integer], normal: Array
) -> Array:
    """Share (P,) of the light from all sides that reaches pixels: 1 in the open, less in creases and gaps.

    Every pixel looks at a few others within :data:`REACH`, and counts how far what they see stands above its own tangent
    plane, less the farther it is (ambient occlusion in screen space, as Mittring, "Finding next gen", 2007, and McGuire et
    al., "The Alchemy screen-space ambient obscurance algorithm", 2011). What no pixel sees keeps no light off.

    Args:
        buffer: what is seen; its nearness is 1/depth [1/m].
        focal: pixels that 1 m takes at a distance of 1 m.
        row, column: (P,) of the pixels, all of them covered.
        normal: (P, 3) towards the eye; right, up and forward.
    """
    height, width = buffer.face.shape
    pos = _positions(buffer, focal, row, column)
    offset = AROUND[2 * (row % 2) + column % 2]
    reach = focal * REACH / pos[:, 2]
    kept = np.zeros(len(row))
    for k in range(_COUNT):
        c = np.floor(column + 0.5 + reach * offset[:, k, 0]).astype(np.int64)
        r = np.floor(row + 0.5 + reach * offset[:, k, 1]).astype(np.int64)
        at = np.flatnonzero((c >= 0) & (r >= 0) & (c < width) & (r < height))
        at = at[buffer.face[r[at], c[at]] >= 0]
        away = _positions(buffer, focal, r[at], c[at]) - pos[at]
        dist_sq = np.einsum("pi,pi->p", away, away)
        share = np.maximum(1.0 - dist_sq / REACH**2, 0.0)
        above = np.einsum("pi,pi->p", normal[at], away) / np.sqrt(np.maximum(dist_sq, 1e-300))
        kept[at] += np.where(dist_sq > 0, np.maximum(above - _LEAST, 0.0) * share, 0.0)
    return np.clip(1.0 - _STRENGTH * kept / _COUNT, _DARKEST, 1.0)


def _positions(buffer: VisibilityBuffer, focal: float, row: NDArray[np.integer], column: NDArray[np.integer]) -> Array:
    """Seen points (P, 3) [m] right, up and forward of the eye."""
    height, width = buffer.face.shape
    depth = 1.0 / buffer.nearness[row, column]
    return np.stack([(column + 0.5 - 0.5 * width) / focal * depth, (0.5 * height - row - 0.5) / focal * depth, depth], axis=1)

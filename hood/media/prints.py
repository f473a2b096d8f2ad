"""Images on surfaces, looked up in every pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hood.assets.formats.image import Texture

Array = NDArray[np.float64]
#: Larger images [pixels along a side] are drawn smaller: pictures are small, and their pixels would miss most of it.
_SIDE = 1024


@dataclass(frozen=True)
class Print:
    """An image on some faces of a mesh."""

    image: Array  # (H, W, 3) linear colours, the top row first
    faces: NDArray[np.int64]  # (N,) numbers of the faces
    corners: Array  # (N, 3, 2) texture coordinates of their corners, v up; the image repeats beyond 0 and 1

    def at(self, uv: Array) -> Array:
        """Colours (P, 3) at texture coordinates (P, 2), linear between pixels."""
        height, width = self.image.shape[:2]
        across, down = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
        left, top = np.floor(across), np.floor(down)
        right_share, low_share = (across - left)[:, None], (down - top)[:, None]
        columns = [(left + k).astype(np.int64) % width for k in range(2)]
        rows = [(top + k).astype(np.int64) % height for k in range(2)]
        upper, lower = (
            (1.0 - right_share) * self.image[row, columns[0]] + right_share * self.image[row, columns[1]] for row in rows
        )
        return np.asarray((1.0 - low_share) * upper + low_share * lower)


def pixels_of(texture: Texture) -> Array:
    """(H, W, 3) linear colours of an image, of 1,024 pixels a side at most.

    Raises:
        ImportError: Pillow is missing.
        ValueError: the image is damaged.
    """
    return np.asarray((texture.pixels(_SIDE) / 255.0) ** 2.2)


def printed(prints: Sequence[tuple[int, Print]], face: NDArray[np.int64], weights: Array) -> Array:
    """Colours (P, 3) of pixels whose faces have an image; NaN for others.

    Args:
        prints: every image with the number from which the faces of its mesh are counted.
        face: (P,) number of the face in each pixel.
        weights: (P, 3) shares of its corners there.
    """
    found = np.full((len(face), 3), np.nan)
    for first, one in prints:
        place = np.full(max(int(face.max(initial=-1)), int(one.faces.max(initial=-1)) + first) + 1, -1)
        place[one.faces + first] = np.arange(len(one.faces))
        mine = np.flatnonzero(place[face] >= 0)
        uv = (weights[mine, :, None] * one.corners[place[face[mine]]]).sum(axis=1)
        found[mine] = one.at(uv)
    return found

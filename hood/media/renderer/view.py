"""What a camera sees of a surface: the nearest face of every sample, and the samples that share a colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hood.media.renderer.raster import NEAR, Camera, VisibilityBuffer, barycentric, ends_of, from_behind, rasterise
from hood.media.renderer.shading import Surface

_Array = NDArray[np.float64]


@dataclass(frozen=True)
class ViewedSurface:
    """A surface as the camera sees it, in the rectangle of samples of the picture that it covers."""

    number: NDArray[np.int64]  # (N,) of the faces that are not behind the camera
    faces: NDArray[np.int64]  # (N, 3), these
    screen: _Array  # (V, 2) samples of the rectangle
    depth: _Array  # (V,) m
    buffer: VisibilityBuffer  # its faces are numbers of ``faces``
    focal: float  # samples that 1 m takes at a distance of 1 m
    left: int  # samples of the picture beside and above the rectangle, even
    top: int
    middle: tuple[float, float]  # where the camera looks, samples across and down

    @classmethod
    def of(cls, camera: Camera, surface: Surface, width: int, height: int) -> ViewedSurface:
        seen = (surface.pos - np.asarray(camera.position)) @ camera.axes().T
        number, faces = np.arange(len(surface.faces)), surface.faces
        if seen[:, 2].min() <= NEAR:
            number = np.flatnonzero((seen[faces, 2] > NEAR).all(axis=1))
            faces = faces[number]
        depth, focal = np.maximum(seen[:, 2], NEAR), camera.focal(height)
        offset = focal * seen[:, :2] / depth[:, None]
        screen = np.stack([0.5 * width + offset[:, 0], 0.5 * height - offset[:, 1]], axis=1)
        # A rectangle of whole pixels, one at least.
        first, last = ends_of(screen)
        low = np.clip(np.floor(first / 2.0) * 2.0, 0, [width - 2, height - 2]).astype(np.int64)
        high = np.clip(np.ceil(last / 2.0) * 2.0, low + 2, [width, height]).astype(np.int64)
        screen -= low
        size = int(high[0] - low[0]), int(high[1] - low[1])
        closed = int((number < surface.closed).sum())
        buffer = rasterise(screen, 1.0 / (depth + surface.behind), faces, *size, place="view", closed=closed)
        middle = 0.5 * width - float(low[0]), 0.5 * height - float(low[1])
        return cls(number, faces, screen, depth, buffer, focal, int(low[0]), int(low[1]), middle)

    def first(self) -> NDArray[np.int64]:
        """(H, W) number of the sample that gives each sample its colour: the first of its 2 x 2 that sees the same face, or one
        that meets it at a vertex and is seen from the same side."""
        height, width = self.buffer.face.shape
        four = self._fours(self.buffer.face)
        leader = np.repeat(np.arange(4)[None], len(four), axis=0)
        mixed = np.flatnonzero((four != four[:, :1]).any(axis=1))
        leader[(four == four[:, :1]).all(axis=1)] = 0
        turned = from_behind(self.screen, self.faces)
        for i in range(1, 4):
            for j in range(i):
                one, other = four[mixed, j], four[mixed, i]
                meet = (self.faces[one][:, :, None] == self.faces[other][:, None, :]).any(axis=(1, 2))
                meet &= turned[one] == turned[other]
                same = (one >= 0) & (other >= 0) & ((one == other) | meet) & (leader[mixed, j] == j) & (leader[mixed, i] == i)
                leader[mixed[same], i] = j
        chosen = np.take_along_axis(self._fours(np.arange(height * width).reshape(height, width)), leader, axis=1)
        return np.asarray(chosen.reshape(height // 2, width // 2, 2, 2).swapaxes(1, 2).reshape(height, width))

    @staticmethod
    def _fours(values: NDArray[Any]) -> NDArray[Any]:
        """(H W / 4, 4) of (H, W)."""
        height, width = values.shape
        return values.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2).reshape(-1, 4)

    def seen(self, row: NDArray[np.integer], column: NDArray[np.integer]) -> tuple[NDArray[np.int64], _Array]:
        """Corners (P, 3) of the faces that samples see, and their shares (P, 3)."""
        corners = self.faces[self.buffer.face[row, column]]
        weights = barycentric(self.screen, corners, np.stack([column + 0.5, row + 0.5], axis=1)) / self.depth[corners]
        return corners, np.clip(weights / (weights @ np.ones(3))[:, None], 0.0, 1.0)

    def covered(self) -> tuple[NDArray[np.integer], NDArray[np.integer], NDArray[np.int64], _Array]:
        """Row and column (P,) of the pixels that see a face and give it its colour, its corners (P, 3) and their shares
        (P, 3)."""
        own = self.first() == np.arange(self.buffer.face.size).reshape(self.buffer.face.shape)
        row, column = np.nonzero((self.buffer.face >= 0) & own)
        return row, column, *self.seen(row, column)

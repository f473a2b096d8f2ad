"""Perspective cameras that frame what they look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Array = NDArray[np.float64]

NEAR = 0.05
"""Nothing closer to the camera than this is drawn [m]."""


@dataclass(frozen=True)
class Camera:
    """A perspective camera at `position` that looks at `target` ([m]); `fov` is vertical [degrees]."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float = 30.0

    @staticmethod
    def framing(
        points: ArrayLike,
        azimuth_deg: float = 20.0,
        elevation_deg: float = 8.0,
        fov: float = 30.0,
        aspect: float = 480 / 640,
        margin: float = 1.10,
    ) -> Camera:
        """The nearest camera in the given direction that sees all `points` (..., 3).

        Azimuth 0 looks at the front (from +z), 90 at the left side (from +x). Pass the points of a whole film
        to get one camera that holds them all. `aspect` is width / height; `margin` leaves a border.
        """
        cloud = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if len(cloud) == 0 or not np.isfinite(cloud).all():
            raise ValueError("Camera.framing: needs at least one point and finite coordinates")
        azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
        toward = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
        view = view_axes(-toward)
        x, y, depth = (cloud @ view.T).T
        tan_y = np.tan(np.radians(fov) / 2) / margin
        tan_x = tan_y * aspect
        # A point is seen when |x - centre| <= tan (distance + depth): the nearest camera has a closed form.
        center_x, distance_x = _fit(x, depth, tan_x)
        center_y, distance_y = _fit(y, depth, tan_y)
        distance = max(distance_x, distance_y, NEAR - depth.min() + 0.1)
        middle = 0.5 * (depth.min() + depth.max())
        target = center_x * view[0] + center_y * view[1] + middle * view[2]
        position = target - (distance + middle) * view[2]
        return Camera(_triple(position), _triple(target), fov)

    def focal(self, height: int) -> float:
        """Pixels of a picture of this height that 1 m takes at a distance of 1 m."""
        return float(0.5 * height / np.tan(np.radians(self.fov) / 2))

    def axes(self) -> _Array:
        """Rows right, up, forward, shape (3, 3)."""
        return view_axes(np.subtract(self.target, self.position))


def view_axes(forward: ArrayLike) -> _Array:
    """Rows right, up and forward (3, 3) of a view along `forward` (3,), upright where that is possible."""
    forward = unit(np.asarray(forward, dtype=np.float64))
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.999 else np.array([0.0, 0.0, -1.0])
    right = unit(np.cross(forward, up))
    return np.stack([right, np.cross(right, forward), forward])


def _fit(x: _Array, depth: _Array, tan: float) -> tuple[float, float]:
    """Centre and distance of the narrowest wedge of the given slope around all points."""
    high, low = float((x - tan * depth).max()), float((x + tan * depth).min())
    return 0.5 * (high + low), (high - low) / (2.0 * tan)


def unit(vectors: _Array) -> _Array:
    """Vectors (..., 3) of length one; zero stays zero."""
    length_sq = np.einsum("...i,...i->...", vectors, vectors)[..., None]
    return vectors / np.sqrt(np.maximum(length_sq, 1e-24))


def _triple(vector: _Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])

"""Blender's z up and units, and hood's y up in metres."""

from __future__ import annotations

import numpy as np


def to_metres(pos: np.ndarray, matrix: np.ndarray, scale: float, origin: np.ndarray) -> np.ndarray:
    """Local positions (V, 3) as hood has them, (V, 3) float64 m, y up.

    Args:
        matrix: (4, 4) of the object into the world.
        scale: metres per unit of the scene.
        origin: (3,) m, y up; what is at it becomes 0.
    """
    world = (np.asarray(pos, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]) * scale
    return np.stack([world[:, 0], world[:, 2], -world[:, 1]], axis=1) - origin


def to_local(pos: np.ndarray, matrix: np.ndarray, scale: float, origin: np.ndarray) -> np.ndarray:
    """The way back.

    Raises:
        ValueError: the matrix has no inverse: an axis is scaled to 0.
    """
    pos = np.asarray(pos, np.float64) + origin
    world = np.stack([pos[:, 0], -pos[:, 2], pos[:, 1]], axis=1) / scale
    try:
        return np.linalg.solve(matrix[:3, :3], (world - matrix[:3, 3]).T).T
    except np.linalg.LinAlgError as error:
        raise ValueError("an axis of the object is scaled to 0; give it a scale") from error


def wind_of(fields: list[tuple[np.ndarray, float]], scale: float) -> tuple[float, float, float] | None:
    """The air's speed (3,) [m/s], y up: the sum of the scene's wind fields, direction × strength; None without any.

    Args:
        fields: direction (3,) in the world, z up, and strength, units of the scene a second.
    """
    if not fields:
        return None
    x, y, z = sum((strength * scale * direction for direction, strength in fields), np.zeros(3)).tolist()
    return x, z, -y


def gravity_of(gravity: tuple[float, float, float], used: bool, scale: float) -> float:
    """Gravity downwards [m/s²]. Blender keeps units of the scene; its default of 9.81 means the earth's in all units.

    Raises:
        ValueError: it does not point down.
    """
    x, y, z = gravity
    if not used:
        return 0.0
    if z > 0.0 or max(abs(x), abs(y)) > 1e-4 * max(abs(z), 1e-4):
        raise ValueError(f"the scene's gravity is ({x:g}, {y:g}, {z:g}); hood takes one straight down: set its x and y to 0")
    return 9.81 if abs(-z - 9.81) < 5e-3 else -z * scale

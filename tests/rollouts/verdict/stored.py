"""Rollouts as they are read back, made of arrays for the tests of the verdict."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from hood.rollouts.file.reader import RolloutData

NO_BODY = np.zeros((0, 3), dtype=np.int32)


def stored(
    count: int,
    metrics: Mapping[str, np.ndarray] | None = None,
    *,
    cloth: np.ndarray | None = None,
    faces: np.ndarray | None = None,
    body: np.ndarray | None = None,
    body_faces: np.ndarray = NO_BODY,
    config: Mapping[str, Any] | None = None,
    **other: Any,
) -> RolloutData:
    """``count`` frames; a still triangle without a body unless ``cloth`` (V, 3) or (T, V, 3) and ``body`` are given."""
    still = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    given = still if cloth is None else cloth
    cloth, rest = _over_time(given, count), np.array(given if given.ndim == 2 else given[0])
    body = _over_time(np.zeros((0, 3)) if body is None else body, count)
    return RolloutData(
        cloth,
        np.array([[0, 1, 2]], dtype=np.int32) if faces is None else faces.astype(np.int32),
        rest,
        body,
        body_faces,
        np.arange(count) / 30.0,
        dict(metrics or {}),
        {"garment": "shirt", "config": json.dumps(dict(config or {}))},
        **other,
    )


def _over_time(pos: np.ndarray, count: int) -> np.ndarray:
    return np.array(pos, dtype=np.float64) if pos.ndim == 3 else np.repeat(pos[None].astype(np.float64), count, axis=0)


def frames(count: int, value: float = 0.1, **other: float) -> np.ndarray:
    """(count,) of ``value``, but for frames given as ``f7=0.9``."""
    values = np.full(count, value)
    for name, given in other.items():
        values[int(name[1:])] = given
    return values


def steps(count: int, value: float, **other: float) -> np.ndarray:
    """The same for what only steps have: frame 0 has none."""
    return frames(count, value, **{"f0": np.nan, **other})


def tube(radius: float, bottom: float, top: float, around: int = 24, along: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and faces (F, 3) of a cylinder around the y axis, open at both ends, normals outwards."""
    angle = np.arange(around) * 2 * np.pi / around
    height = np.linspace(bottom, top, along + 1)
    ring = np.stack([radius * np.sin(angle), np.zeros(around), radius * np.cos(angle)], axis=1)
    pos = (ring[None] + height[:, None, None] * np.array([0.0, 1.0, 0.0])).reshape(-1, 3)
    row, column = (values.ravel() for values in np.meshgrid(np.arange(along), np.arange(around), indexing="ij"))
    a, b = row * around + column, row * around + (column + 1) % around
    return pos, np.concatenate([np.stack([a, b, b + around], axis=1), np.stack([a, b + around, a + around], axis=1)])

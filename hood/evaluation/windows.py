"""Moments of a motion that a short look should not miss, found from the body alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hood.scene.motion import Motion

#: The body is posed in at most so many frames, and every so many of its vertices are looked at.
_MOST_POSES, _VERTEX_STRIDE = 60, 16


@dataclass(frozen=True)
class Window:
    """A stretch of a motion that begins at frame ``first``, and why it was taken."""

    first: int
    reason: str


def choose_windows(motion: Motion, num_frames: int, count: int, length: int) -> list[Window]:
    """At most ``count`` windows of ``length`` steps within the first ``num_frames`` frames, none of them twice.

    In this order: the start; the body's vertices fastest (m/s, root mean square); the body most bent, which is where its
    vertices are nearest to their centre; the median speed; the highest acceleration.

    Raises:
        ValueError: the frames are too few for one window.
    """
    last = num_frames - 1 - length
    if last < 0:
        raise ValueError(f"{num_frames} frames are too few for a window of {length + 1}")
    frames = np.unique(np.linspace(0, last, min(last + 1, _MOST_POSES)).round().astype(int))
    if motion.num_vertices == 0 or len(frames) < 4:
        even = np.linspace(0, last, min(count, last + 1)).round().astype(int)
        return [Window(int(frame), "the start" if frame == 0 else "evenly spread") for frame in even]
    speed, spread = _course(motion, frames)
    change = np.abs(np.gradient(speed, frames))
    picked = {
        "the start": 0,
        "fastest": int(speed.argmax()),
        "most bent": int(spread.argmin()),
        "median speed": int(np.argsort(speed)[len(speed) // 2]),
        "highest acceleration": int(change.argmax()),
    }
    windows: list[Window] = []
    for reason, index in picked.items():
        first = int(frames[index])
        if all(abs(first - known.first) >= length for known in windows) and len(windows) < count:
            windows.append(Window(first, reason))
    return windows


def _course(motion: Motion, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed [m/s] and mean distance from the centre [m] of the body's vertices in ``frames``."""
    here, there = (motion.some_points(at, _VERTEX_STRIDE) for at in (frames, frames + 1))
    speed = np.sqrt(((there - here) ** 2).sum(axis=2).mean(axis=1)) * motion.fps
    return speed, np.linalg.norm(here - here.mean(axis=1, keepdims=True), axis=2).mean(axis=1)

"""Motions of the second table, written as AMASS files: poses made of joint angles, and captures that went wrong."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.verdict.table.motions import recorded, turned, write
from tests.verdict.table.scene import Maker

Array = np.ndarray
_FPS = 60.0
#: Rows of joints in a pose.
HIPS, KNEES, SPINE, CHEST, SHOULDERS, ELBOWS = (1, 2), (4, 5), 3, 9, (16, 17), (18, 19)
#: Degrees about x to the body's left, y up, z to the front.
Angles = Mapping[int, tuple[float, float, float]]


def bent(
    word: str, joints: Angles, seconds: float = 0.7, root: tuple[float, float, float] = (0, 0, 0), up: float = 0.0
) -> Maker:
    """From standing, within ``seconds``, the joints are turned by so many degrees more; the body is turned and lifted [m]."""

    def make(folder: Path) -> Path:
        share = _share(seconds)
        poses, trans = (np.repeat(rows[:1], len(share), axis=0) for rows in recorded("stand_sway"))
        for joint, angles in joints.items():
            columns = slice(3 * joint, 3 * joint + 3)
            more = Rotation.from_rotvec(np.radians(share[:, None] * np.asarray(angles, dtype=np.float64)))
            poses[:, columns] = (Rotation.from_rotvec(poses[:, columns]) * more).as_rotvec()
        poses = turned(poses, Rotation.from_rotvec(np.radians(share[:, None] * np.asarray(root, dtype=np.float64))))
        return write(folder / f"{word}.npz", poses, trans + up * share[:, None] * [0, 0, 1.0])

    return make


def wheel(seconds: float = 0.9, turns: float = -1.0, about: str = "y", height: float = 0.35) -> Maker:
    """A turn over the hands, arms stretched out and legs apart."""

    def make(folder: Path) -> Path:
        share = _share(seconds)
        poses, trans = (np.repeat(rows[:1], len(share), axis=0) for rows in recorded("stand_sway"))
        for joint, degrees in ((1, 35.0), (2, -35.0)):
            poses[:, 3 * joint + 2] += np.radians(degrees) * np.minimum(4 * share, 1.0)
        poses = turned(poses, Rotation.from_euler(about, 360.0 * turns * share[:, None], degrees=True))
        return write(folder / f"wheel_{about}.npz", poses, trans + 4 * height * (share - share**2)[:, None] * [0, 0, 1.0])

    return make


def laid(name: str, start: int, about: str, degrees: float, high: float = 0.2) -> Maker:
    """An embedded motion turned as a whole, as by a wrong axis or for a body that lies; ``high`` [m] above the ground."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start:] for rows in recorded(name))
        turn = Rotation.from_euler(about, degrees, degrees=True)
        return write(folder / "laid.npz", turned(poses, turn), turn.apply(trans) + [0.0, 0.0, high])

    return make


def lost(name: str, start: int, first: int, last: int) -> Maker:
    """The rows ``first`` to ``last`` of the capture are zeros, in poses and place."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start:].copy() for rows in recorded(name))
        poses[first:last], trans[first:last] = 0.0, 0.0
        return write(folder / "lost.npz", poses, trans)

    return make


def swapped(name: str, start: int) -> Maker:
    """Left and right joints of arms and legs have changed places, unmirrored, as by a wrong table of joints."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start:].copy() for rows in recorded(name))
        for left, right in ((1, 2), (4, 5), (7, 8), (16, 17), (18, 19)):
            a, b = slice(3 * left, 3 * left + 3), slice(3 * right, 3 * right + 3)
            poses[:, a], poses[:, b] = poses[:, b].copy(), poses[:, a].copy()
        return write(folder / "swapped.npz", poses, trans)

    return make


def rising(name: str, start: int, speed: float, axis: int = 2, scale: float = 1.0) -> Maker:
    """An embedded motion that climbs or sinks at ``speed`` [m/s], or drifts along another axis; all in metres / ``scale``."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start:].copy() for rows in recorded(name))
        trans[:, axis] += speed * np.arange(len(trans)) / _FPS
        return write(folder / "rising.npz", poses, scale * trans)

    return make


def trembling(name: str, start: int, degrees: float, joints: tuple[int, ...]) -> Maker:
    """Some joints tremble from row to row, as where a marker was lost."""

    def make(folder: Path) -> Path:
        rng = np.random.default_rng(4)
        poses, trans = (rows[start : start + 120].copy() for rows in recorded(name))
        for joint in joints:
            poses[:, 3 * joint : 3 * joint + 3] += np.radians(degrees) * rng.normal(size=(len(poses), 3))
        return write(folder / "trembling.npz", poses, trans)

    return make


def as_said(name: str, start: int, rate: float) -> Maker:
    """An embedded motion whose file says another rate than that of its 60 rows a second."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start:] for rows in recorded(name))
        return write(folder / "said.npz", poses, trans, mocap_framerate=rate)

    return make


def _share(seconds: float, calm: int = 6, after: float = 0.6) -> Array:
    """Of the way (T,): some still rows, an eased way of ``seconds``, and ``after`` seconds at its end."""
    time = np.clip((np.arange(round((seconds + after) * _FPS) + calm) - calm) / (_FPS * seconds), 0.0, 1.0)
    return np.asarray(time * time * (3.0 - 2.0 * time))

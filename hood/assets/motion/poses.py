"""Poses that a garment may have been modelled in: T-pose, A-pose, and poses in files."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from hood.assets.files.guarded import check_size, guarded
from hood.assets.files.library import npy_header
from hood.assets.files.text import read_text
from hood.assets.motion.layouts.table import WHOLE
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.sequence_edit import standing_pose

_NUM_JOINTS = 24
#: Angle [degrees] of the arms of the usual A-pose below those of the T-pose.
A_POSE_ANGLE = 45.0
POSE_SUFFIXES = (".npy", ".json", ".txt")
_SIZE_LIMIT = 16 << 20
#: Numbers of one pose, of the smallest and the largest skeleton.
_FEWEST, _MOST = 3 * min(WHOLE), 3 * max(WHOLE)


def arms_down(angle: float) -> PoseSequence:
    """One frame of the T-pose with the arms turned down by ``angle`` [degrees] at the shoulders."""
    poses = standing_pose("a")[None] * (angle / A_POSE_ANGLE)
    return one_frame(f"arms down by {angle:g} degrees", poses)


def one_frame(name: str, poses: np.ndarray) -> PoseSequence:
    """A sequence of one frame at the origin, from joint rotations (1, 24, 3) [rad]."""
    return PoseSequence(name, poses, np.zeros((1, 3)), 30.0, np.zeros(10), np.eye(3))


def holds_pose(path: Path) -> bool:
    """Whether a file is one of :func:`read_pose`, by its name; an array by its header too: motions are arrays as well."""
    suffix = path.suffix.lower()
    if suffix != ".npy":
        return suffix in POSE_SUFFIXES

    def read() -> bool:
        with open(path, "rb") as file:
            shape, dtype = npy_header(file)
        return not dtype.hasobject and math.prod(shape) <= _MOST

    return bool(guarded(path, "pose", read))


def read_pose(path: Path) -> PoseSequence:
    """One frame from a file of axis-angle vectors [rad]: 66 to 165 numbers, mostly 72, in the order of the SMPL joints.

    ``.npy``, ``.json`` or ``.txt``; hands are left out.

    Raises:
        ValueError: another number of values, or not numbers; names the file.
    """
    if path.suffix.lower() not in POSE_SUFFIXES:
        raise ValueError(f"{path}: unknown pose format {path.suffix!r}; give {', '.join(POSE_SUFFIXES)} or a motion")
    check_size(path, _SIZE_LIMIT)
    values = guarded(path, "pose", lambda: _numbers(path))
    if not _FEWEST <= values.size <= _MOST or values.size % 3 or not np.isfinite(values).all():
        raise ValueError(f"{path}: {values.size} numbers; a pose has 72 finite ones, three for each of 24 joints")
    poses = np.zeros((1, _NUM_JOINTS, 3))
    poses[0, :22] = values.reshape(-1, 3)[:22]
    return one_frame(path.stem, poses)


def _numbers(path: Path) -> np.ndarray:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        # Mapped, not read: a head that announces more than the file holds is refused before memory is asked for.
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False), dtype=np.float64).reshape(-1)
    text = read_text(path)
    values = json.loads(text) if suffix == ".json" else text.replace(",", " ").split()
    return np.asarray(values, dtype=np.float64).reshape(-1)

"""Poses a garment may have been modelled around: T, A, and those in files; and which of them it was."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hood.assets.binding import PosedBody, posed_body, signed_distances
from hood.assets.body import Body
from hood.assets.sequence import PoseSequence
from hood.assets.sequence_edit import standing_pose
from hood.assets.unpickle import check_size, guarded

_NUM_JOINTS = 24
#: Angle [degrees] of the arms of the usual A-pose below those of the T-pose.
A_POSE_ANGLE = 45.0
_STEPS, _FINE_STEP = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0), 2.5
#: Another angle than 0 must bring the garment nearer to the skin by this share: sleeveless garments fit all alike.
_GAIN = 0.1
#: Distances count up to here [m]; every vertex inside the body counts this many times.
_FAR, _INSIDE = 0.1, 3.0
POSE_SUFFIXES = (".npy", ".json", ".txt")
_SIZE_LIMIT = 16 << 20


class Standing(NamedTuple):
    """A pose found, and how well the garment fits it."""

    pose: PosedBody
    angle: float  # degrees, of the arms below those of the T-pose
    score: float  # m, mean distance to the skin, where inside counts threefold


def arms_down(angle: float) -> PoseSequence:
    """One frame of the T-pose with the arms turned down by ``angle`` [degrees] at the shoulders."""
    poses = standing_pose("a")[None] * (angle / A_POSE_ANGLE)
    return one_frame(f"arms down by {angle:g} degrees", poses)


def one_frame(name: str, poses: np.ndarray) -> PoseSequence:
    """A sequence of one frame at the origin, from joint rotations (1, 24, 3) [rad]."""
    return PoseSequence(name, poses, np.zeros((1, 3)), 30.0, np.zeros(10), np.eye(3))


def find_standing_pose(points: np.ndarray, body: Body, betas: np.ndarray) -> Standing:
    """The pose between T and arms hanging that the garment ``points`` (V, 3) [m] fits best, to 2.5 degrees."""
    tried: dict[float, Standing] = {}

    def attempt(angle: float) -> float:
        if angle not in tried:
            posed = posed_body(body, arms_down(angle), 0, betas)
            tried[angle] = Standing(posed, angle, _misfit(points, posed))
        return tried[angle].score

    best = min(_STEPS, key=attempt)
    step = _STEPS[1]
    while step > _FINE_STEP:
        step /= 2 if step / 2 >= _FINE_STEP else step / _FINE_STEP
        best = min((best, best - step, best + step), key=attempt)
    return tried[best] if tried[best].score < (1 - _GAIN) * tried[0.0].score else tried[0.0]


def read_pose(path: Path) -> PoseSequence:
    """One frame from a file of axis-angle vectors [rad]: 66, 72 or more numbers in the order of the SMPL joints.

    ``.npy``, ``.json`` or ``.txt``; hands are left out.

    Raises:
        ValueError: another number of values, or not numbers; names the file.
    """
    if path.suffix.lower() not in POSE_SUFFIXES:
        raise ValueError(f"{path}: unknown pose format {path.suffix!r}; give {', '.join(POSE_SUFFIXES)} or a motion")
    check_size(path, _SIZE_LIMIT)
    values = guarded(path, "pose", lambda: _numbers(path))
    if values.size < 66 or values.size % 3 or not np.isfinite(values).all():
        raise ValueError(f"{path}: {values.size} numbers; a pose has 72 finite ones, three for each of 24 joints")
    poses = np.zeros((1, _NUM_JOINTS, 3))
    poses[0, :22] = values.reshape(-1, 3)[:22]
    return one_frame(path.stem, poses)


def _numbers(path: Path) -> np.ndarray:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        # Mapped, not read: a head that announces more than the file holds is refused before memory is asked for.
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False), dtype=np.float64).reshape(-1)
    text = path.read_text(encoding="utf-8", errors="replace")
    values = json.loads(text) if suffix == ".json" else text.replace(",", " ").split()
    return np.asarray(values, dtype=np.float64).reshape(-1)


def _misfit(points: np.ndarray, posed: PosedBody) -> float:
    dist = signed_distances(points, posed.surface, posed.faces)
    return float(np.minimum(np.where(dist < 0, -_INSIDE * dist, dist), _FAR).mean())

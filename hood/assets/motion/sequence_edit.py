"""Edits of a pose sequence: trimming, loops, and a lead-in from a standing pose.

Poses that a garment may have been modelled in: T-pose, A-pose, and poses in files.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.files.guarded import check_size, guarded
from hood.assets.files.library import npy_header
from hood.assets.files.text import read_text
from hood.assets.motion.layouts.content import WHOLE
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.skeleton import from_vectors

_UP = np.array([0.0, 1.0, 0.0])
_SHOULDERS = (16, 17)  # left, right
#: Time [s] before the end of a play during which it turns into its own first pose.
_SEAM = 0.25
_MAX_FRAMES = 1_000_000


def standing_pose(kind: str) -> np.ndarray:
    """(24, 3) axis-angle [rad] of the T-pose (``"t"``, all zero) or the A-pose (``"a"``, arms lowered by 45°).

    Raises:
        ValueError: another kind.
    """
    if kind not in ("t", "a"):
        raise ValueError(f"blend_from={kind}: give t (arms out) or a (arms lowered by 45 degrees)")
    pose = np.zeros((24, 3))
    if kind == "a":
        # The left arm points along +x: turning it about z by a negative angle lowers it.
        for joint, sign in zip(_SHOULDERS, (-1.0, 1.0), strict=True):
            pose[joint, 2] = sign * np.pi / 4
    return pose


def trim(sequence: PoseSequence, start: float | str | None = None, stop: float | str | None = None) -> PoseSequence:
    """The part from ``start`` to ``stop`` (included), each in seconds or, as ``"120f"``, in frames; None: the motion's own.

    Raises:
        ValueError: less than two frames are left.
    """
    if start is None and stop is None:
        return sequence
    first = 0 if start is None else frame_at("start", start, sequence.fps)
    last = sequence.num_frames - 1 if stop is None else frame_at("stop", stop, sequence.fps)
    last = min(last, sequence.num_frames - 1)
    if last - first < 1:
        seconds = (sequence.num_frames - 1) / sequence.fps
        said = " and ".join(f"{key}={value}" for key, value in (("start", start), ("stop", stop)) if value is not None)
        raise ValueError(
            f"{sequence.name}: with {said} fewer than two of its {sequence.num_frames} frames ({seconds:.2f} s) are left; "
            "choose a longer part"
        )
    return sequence.window(first, last + 1)


def frame_at(key: str, value: float | str, fps: float) -> int:
    """Frame of a time in seconds, or of ``"120f"``.

    Raises:
        ValueError: negative, not finite or not a number; the message starts with ``key``.
    """
    text = str(value).strip()
    if re.fullmatch(r"\d{1,9}f", text):
        return int(text[:-1])
    try:
        seconds = float(text.removesuffix("s"))
    except ValueError:
        seconds = np.nan
    if not np.isfinite(seconds) or not 0 <= seconds <= 1e6:
        raise ValueError(f"{key}={value}: give seconds (1.5) or frames of the file (120f), not negative")
    return round(seconds * fps)


def loop(sequence: PoseSequence, plays: int) -> PoseSequence:
    """The motion ``plays`` times; each play goes on from the place and heading in which the one before ended.

    The last quarter of a second of every play but the final one turns into the first pose, so that a motion which does not
    end as it began has no jump. Heights are those of the motion: nothing rises or sinks from play to play.

    Raises:
        ValueError: ``plays`` is not a positive number, or too many frames come out.
    """
    if plays < 1 or sequence.num_frames * plays > _MAX_FRAMES:
        raise ValueError(
            f"loop={plays}: give how often the motion is played, at least 1 and at most {_MAX_FRAMES} frames in all"
        )
    if plays == 1:
        return sequence
    closed = _closed(sequence)
    first, last = closed.poses[0, 0], closed.poses[-1, 0]
    turn = from_vectors((_heading(last) - _heading(first)) * _UP)
    parts, heading, place = [], Rotation.identity(), closed.transl[0]
    for play in range(plays):
        source = sequence if play == plays - 1 else closed
        transl = place + heading.apply(source.transl - source.transl[0])
        transl[:, 1] = source.transl[:, 1]
        poses = source.poses.copy()
        poses[:, 0] = (heading * from_vectors(poses[:, 0])).as_rotvec()
        part = replace(source, poses=poses, transl=transl)
        parts.append(part if play == 0 else part.window(1, part.num_frames))  # its first frame is the last one before it
        heading, place = heading * turn, transl[-1]
    return _join(parts)


def blend_in(sequence: PoseSequence, seconds: float, kind: str = "t") -> PoseSequence:
    """``sequence`` after ``seconds`` of moving into its first pose from a standing one (:func:`standing_pose`).

    The body stands upright with the heading and the root position of the first frame; joints follow slerps with a smooth
    start and end. A garment modelled in that pose can so be put on where the motion itself starts in another one.

    Raises:
        ValueError: negative or more than a minute.
    """
    if not 0 <= seconds <= 60:
        raise ValueError(f"blend_in={seconds}: give 0 to 60 seconds")
    pose = standing_pose(kind)
    count = round(seconds * sequence.fps)
    if count == 0:
        return sequence
    pose[0] = _heading(sequence.poses[0, 0]) * _UP
    weight = _smooth(np.arange(count) / count)
    poses = _between(np.broadcast_to(pose, (count, 24, 3)), sequence.poses[:1], weight)
    fingers = None
    if sequence.fingers is not None:
        fingers = _between(np.zeros((count, *sequence.fingers.shape[1:])), sequence.fingers[:1], weight)
    lead = replace(sequence, poses=poses, transl=np.repeat(sequence.transl[:1], count, axis=0), fingers=fingers)
    return _join([lead, sequence])


def _closed(sequence: PoseSequence) -> PoseSequence:
    """The motion with its end turned into its first pose, at the heading and place of its own end."""
    count = min(max(round(_SEAM * sequence.fps), 1), sequence.num_frames - 1)
    weight = _smooth(np.arange(1, count + 1) / count)
    target = sequence.poses[:1].copy()
    turn = _heading(sequence.poses[-1, 0]) - _heading(target[0, 0])
    target[0, 0] = (from_vectors(turn * _UP) * from_vectors(target[0, 0])).as_rotvec()
    poses, transl = sequence.poses.copy(), sequence.transl.copy()
    poses[-count:] = _between(poses[-count:], target, weight)
    transl[-count:, 1] += weight * (transl[0, 1] - transl[-count:, 1])
    fingers = sequence.fingers
    if fingers is not None:
        fingers = fingers.copy()
        fingers[-count:] = _between(fingers[-count:], fingers[:1], weight)
    return replace(sequence, poses=poses, transl=transl, fingers=fingers)


def _heading(root: np.ndarray) -> float:
    """Angle [rad] about the vertical axis of where a root orientation faces; z forward has none."""
    ahead = from_vectors(root).apply([0.0, 0.0, 1.0])
    return float(np.arctan2(ahead[0], ahead[2]))


def _smooth(share: np.ndarray) -> np.ndarray:
    return share * share * (3.0 - 2.0 * share)


def _between(start: np.ndarray, end: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Slerp from (T, J, 3) towards (T or 1, J, 3) by ``weight`` (T,), along the short arcs."""
    first = from_vectors(start.reshape(-1, 3))
    last = from_vectors(np.broadcast_to(end, start.shape).reshape(-1, 3))
    step = (first.inv() * last).as_rotvec() * np.repeat(weight, start.shape[1])[:, None]
    return (first * from_vectors(step)).as_rotvec().reshape(start.shape)


def _join(parts: list[PoseSequence]) -> PoseSequence:
    fingers = None
    if all(part.fingers is not None for part in parts):
        fingers = np.concatenate([part.fingers for part in parts if part.fingers is not None])
    poses, transl = (np.concatenate([getattr(part, name) for part in parts]) for name in ("poses", "transl"))
    return replace(parts[0], poses=poses, transl=transl, fingers=fingers)


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

"""Loading a motion by name or by path: resampled, turned y up, cut and repeated.

The up axis of a recorded motion, found from the whole skeleton: where the head is, what stands still, where a floor is.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hood.assets.files.library import locate
from hood.assets.files.said import Doubt
from hood.assets.motion import sequence_edit as edit
from hood.assets.motion.recording import NUM_BODY_JOINTS, Recording, read_recording
from hood.assets.motion.sequence import PoseSequence, checked_sequence, resample, still, turn_world
from hood.assets.motion.skeleton import UP_AXES, joints_about_pelvis, require_up, some_frames, spread

#: The head is over the feet along an axis where the unit vector between them has this component there, and a body stands
#: along an axis where that is so in this share of the frames; along that of its layout in the second share.
_ALONG, _MOSTLY, _OFTEN = 0.7, 0.8, 0.5
#: Heights [m] of the pelvis above a floor at 0, lying and standing.
_LYING, _STANDING = (-0.1, 0.4), (0.5, 1.5)
#: A joint stands still below this speed [m/s], or this share of the median speed of all joints.
_STILL, _STILL_SHARE = 0.1, 0.35
#: Lowest joints within this of the floor [m] are on it.
_ON_FLOOR = 0.1
#: What carries a body is still, and on the floor, in these shares of the frames; where it is in less than the others, nothing
#: carries it along that axis.
_CARRIES, _FLOOR = (0.5, 0.6), (0.35, 0.35)
#: Whoever walks leaves footprints that are so far apart [m]; a body that hangs by its feet leaves them in one place.
_WALKS = 0.5
#: After loading the head is below the feet where the component along the axis is below this.
_HEAD_DOWN = -0.5


class Bearing(NamedTuple):
    """The up axis by the skeleton. ``sure``: tested, by steps that carry the body along this axis and along no other, or by
    the body standing along that of its layout."""

    axis: str  # of UP_AXES
    sure: bool


class Carried(NamedTuple):
    """How a body is carried if an axis points up: shares of the frames, and how far apart [m] what carries it stands."""

    still: float
    on_floor: float
    apart: float

    @property
    def holds(self) -> bool:
        return self.still >= _CARRIES[0] and self.on_floor >= _CARRIES[1]

    @property
    def fails(self) -> bool:
        return self.still < _FLOOR[0] or self.on_floor < _FLOOR[1]


def find_bearing(recording: Recording) -> Bearing:
    """The axis along which the body stands; that of the layout where the skeleton does not tell."""
    along = recording.uprights
    shares = {axis: float((along @ _vector(axis) > _ALONG).mean()) for axis in UP_AXES}
    if shares[recording.up] >= _OFTEN:
        return Bearing(recording.up, True)
    axis = max(shares, key=lambda name: shares[name])
    own = _carried(recording, recording.up)
    if shares[axis] < _MOSTLY:
        # Rolls, cartwheels, crawls in a circle; or a camera that looks down.
        return Bearing(recording.up, own is None or not own.fails)
    other = _carried(recording, axis)
    if own is not None and other is not None:
        if other.fails and own.holds:
            return Bearing(recording.up, True)
        # A body that hangs by its feet is still there as well, and does not walk; nor does one that lies and swings an arm.
        if own.fails and other.holds and (other.apart > _WALKS or _is_custom(axis, recording.up)):
            return Bearing(axis, True)
        if other.fails:
            return Bearing(axis, False)
    return _by_heights(recording, axis, own is None or own.holds)


def find_up(path: Path, recording: Recording) -> tuple[str, UserWarning | None]:
    """The up axis to take where nobody gives one, and what to tell the user: :func:`bearing_notice`, else a body head down."""
    axis, notice = bearing_notice(path, recording)
    return axis, notice or head_down_doubt(path, recording, axis)


def bearing_notice(path: Path, recording: Recording) -> tuple[str, UserWarning | None]:
    """The up axis to take, and what to tell the user about it: nothing, the fact that it is not that of the layout, or a
    doubt."""
    found = find_bearing(recording)
    own = recording.up
    if found.axis == own and found.sure:
        return own, _camera_doubt(path, recording)
    if found.axis == own:
        said = f"{path}: the body neither stands along an axis nor rests on a floor, and {own} is taken as up"
        return own, Doubt("orientation", f"{said}; up={_others(own)} gives another axis")
    what = f"{path}: its body stands along {found.axis}, though {own} is up in files with its keys"
    if found.sure:
        return found.axis, UserWarning(
            f"{what}; it is taken as {found.axis} up (up={found.axis} says so, up={own} {_turns(found.axis, own)})"
        )
    if found.axis.lstrip("-") == own.lstrip("-"):
        said = f"{what}, or it is head down, and {own} is taken; pass up={found.axis} if it stands, up={own} if it is"
    else:
        said = f"{what}, or it lies on the floor, and {own} is taken; pass up={found.axis} if it stands, up={own} if it lies"
    return own, Doubt("orientation", said)


def head_down_doubt(path: Path, recording: Recording, axis: str) -> Doubt | None:
    """The doubt about a body that is head down in most frames with ``axis`` up."""
    height = recording.uprights @ _vector(axis)
    down = spread(len(recording.poses))[height < _HEAD_DOWN]
    if len(down) <= len(height) / 2:
        return None
    share = len(down) / len(height)
    turned = axis[1:] if axis.startswith("-") else f"-{axis}"
    said = (
        f"{path}: the body is head down in {100 * share:.0f}% of its frames with {axis} up; up={turned} turns it over, "
        f"up={axis} says that it is right"
    )
    return Doubt("orientation", said, tuple(map(int, down[:100])), share, "")


def _vector(axis: str) -> np.ndarray:
    return UP_AXES[axis][1]


def _carried(recording: Recording, axis: str) -> Carried | None:
    """How the body is carried with ``axis`` up; None for a single pose."""
    first, step = some_frames(len(recording.poses), recording.fps)
    if not len(first):
        return None
    places = [joints_about_pelvis(recording.poses[at]) + recording.transl[at][:, None] for at in (first, first + step)]
    speed = np.linalg.norm(places[1] - places[0], axis=2) * recording.fps / step
    height = places[0] @ _vector(axis)
    row, low = np.arange(len(first)), height.argmin(axis=1)
    lowest = height[row, low]
    still = speed[row, low] < max(_STILL, _STILL_SHARE * float(np.median(speed)))
    on_floor = lowest < np.quantile(lowest, 0.1) + _ON_FLOOR
    prints = places[0][row, low][still & on_floor]
    apart = float(np.linalg.norm(np.ptp(prints, axis=0))) if len(prints) else 0.0
    return Carried(float(still.mean()), float(on_floor.mean()), apart)


def _by_heights(recording: Recording, axis: str, rests: bool) -> Bearing:
    """By the heights over a floor at 0, for a body that moves too little to tell: along ``axis``, not that of its layout.

    Args:
        rests: what is lowest along the axis of the layout is still.
    """
    height, along = (float(np.median(recording.transl @ _vector(name))) for name in (recording.up, axis))
    stands = _STANDING[0] < along < _STANDING[1]
    if _is_custom(axis, recording.up):
        return Bearing(axis, stands)
    # No program has x up: what looks so lies, unless it is nowhere near a floor. What is upside down may do a handstand.
    lies = rests and _LYING[0] < height < _LYING[1] and not stands
    return Bearing(recording.up, True) if lies and axis.lstrip("-") == "x" else Bearing(axis, False)


def _is_custom(axis: str, up: str) -> bool:
    """Whether files with ``axis`` up are as usual as those with ``up``."""
    return {axis, up} == {"y", "z"} or (up == "-y" and axis in ("y", "z"))


def _camera_doubt(path: Path, recording: Recording) -> Doubt | None:
    """Cameras are not level: what is up in their picture is not exactly against gravity."""
    if not recording.camera:
        return None
    lean = recording.uprights.mean(axis=0) @ _vector(recording.up)
    degrees = float(np.degrees(np.arccos(np.clip(lean, -1.0, 1.0))))
    said = (
        f"{path}: its body is seen from a camera ({recording.layout} files), up is taken from the picture, and it leans "
        f"by {degrees:.0f} degrees on average; a motion in the world, of the same program or another, is level"
    )
    return Doubt("orientation", said, value=degrees, unit="degrees")


def _turns(axis: str, own: str) -> str:
    return "turns it over" if axis.lstrip("-") == own.lstrip("-") else "lays it down"


def _others(own: str) -> str:
    return " or ".join(axis for axis in ("y", "z", "-y") if axis != own)


HANDS = ("flat", "file")


def load_sequence(
    name: str | Path,
    fps: float = 30.0,
    up: str = "auto",
    *,
    start: float | str | None = None,
    stop: float | str | None = None,
    loop: int = 1,
    blend_in: float = 0.0,
    blend_from: str = "t",
    hands: str = "flat",
    file_fps: float | None = None,
    person: int | str | None = None,
    trans_unit: str = "auto",
    num_frames: int | None = None,
) -> PoseSequence:
    """A motion by its embedded name or from a file, as it is to be performed.

    Args:
        name: an embedded name, or a motion file of any layout (:func:`hood.assets.motion.recording.read_recording`).
        fps: frames per second of the result; rotations are interpolated by slerp, translations linearly.
        up: axis of the file's world that points up: "y", "z", "x", "-y", "-z", "-x", or "auto", along which the body stands;
            where that is open z for AMASS layouts, -y for cameras and y for the others, with a doubt.
        start: first moment of the file to keep, in seconds, or in frames of the file as "120f"; None: its beginning.
        stop: last moment to keep, likewise; None: its end.
        loop: times the motion is played; each play goes on from where the last one ended.
        blend_in: seconds of moving from a standing pose into the first frame, put before it.
        blend_from: that pose, "t" or "a".
        hands: "flat", or "file" for the fingers (SMPL-H, SMPL-X) or hands (SMPL) that the file holds.
        file_fps: frame rate of the file, whatever it says itself.
        person: who of several people in the file, by name or place; one of several is never taken unasked.
        trans_unit: unit of the file's translation, "m", "cm" or "mm"; "auto": found from steps and heights.
        num_frames: for how many frames a file with a single pose is held; None: five seconds.

    Returns:
        The :class:`PoseSequence`, with ``poses`` (T, 24, 3) rad, ``transl`` (T, 3) m, y up.

    Raises:
        FileNotFoundError: unknown name or missing file.
        ValueError: not a motion file, nothing left of it, an option out of range; names the file and the fix.

    Examples:
        >>> import hood
        >>> motion = hood.load_sequence("plie", fps=60, stop=2.0)
        >>> motion.poses.shape, motion.fps
        ((121, 24, 3), 60)
    """
    path = locate("motions", name)
    require_up(up)
    if hands not in HANDS:
        raise ValueError(f"hands={hands}: give flat, or file for fingers as recorded")
    recording = read_recording(path, file_fps, person, trans_unit)
    for note in recording.notes:
        warnings.warn(note, stacklevel=2)
    axis = _up_axis(path, recording) if up == "auto" else up
    sequence = _sequence(path.stem, recording, hands)
    return _performed(
        sequence,
        fps=fps,
        axis=axis,
        start=start,
        stop=stop,
        loop=loop,
        blend_in=blend_in,
        blend_from=blend_from,
        num_frames=num_frames,
    )


def perform_poses(
    sequence: PoseSequence,
    fps: float = 30.0,
    up: str = "auto",
    *,
    start: float | str | None = None,
    stop: float | str | None = None,
    loop: int = 1,
    blend_in: float = 0.0,
    blend_from: str = "t",
    hands: str = "flat",
    num_frames: int | None = None,
) -> PoseSequence:
    """The same of a motion that is there already, see :func:`load_sequence`; y is up where ``up`` is "auto".

    Raises:
        ValueError: arrays that are no motion, or an option out of range.
    """
    require_up(up)
    sequence = checked_sequence(sequence)
    if hands == "flat":
        poses = sequence.poses.copy()
        poses[:, NUM_BODY_JOINTS:] = 0.0
        sequence = replace(sequence, poses=poses, fingers=None)
    return _performed(sequence, fps, "y" if up == "auto" else up, start, stop, loop, blend_in, blend_from, num_frames)


def _performed(
    sequence: PoseSequence,
    fps: float,
    axis: str,
    start: float | str | None,
    stop: float | str | None,
    loop: int,
    blend_in: float,
    blend_from: str,
    num_frames: int | None,
) -> PoseSequence:
    """A motion in the world of its file, with ``axis`` up, as it is to be performed."""
    if sequence.num_frames == 1:
        sequence = still(sequence, fps, num_frames)
    else:
        sequence = resample(edit.trim(sequence, start, stop), fps)
    if axis != "y":
        sequence = turn_world(sequence, UP_AXES[axis])
    return edit.blend_in(edit.loop(sequence, loop), blend_in, blend_from)


def _sequence(name: str, recording: Recording, hands: str) -> PoseSequence:
    """The recording in the world of its file, with hands as recorded or flat."""
    poses, fingers = recording.poses, recording.fingers
    if hands == "flat":
        poses, fingers = poses.copy(), None
        poses[:, NUM_BODY_JOINTS:] = 0.0
    return PoseSequence(
        name, poses, recording.transl, recording.fps, recording.betas, np.eye(3), fingers, recording.gender, recording.family
    )


def _up_axis(path: Path, recording: Recording) -> str:
    """The axis along which the body stands; a warning where it is not that of the layout, a doubt where that is not sure."""
    axis, notice = find_up(path, recording)
    if notice is not None:
        warnings.warn(notice, stacklevel=3)
    return axis

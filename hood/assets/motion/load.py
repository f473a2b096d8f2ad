"""Loading a motion by name or by path: resampled, turned y up, cut and repeated."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from hood.assets.files.library import locate
from hood.assets.motion import sequence_edit as edit
from hood.assets.motion.axes import UP_AXES, require_up
from hood.assets.motion.recording import NUM_BODY_JOINTS, Recording, read_recording
from hood.assets.motion.sequence import PoseSequence, resample, still, turn_world
from hood.assets.motion.up_axis import find_up

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

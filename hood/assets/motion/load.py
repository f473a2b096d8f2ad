"""Loading a motion by name or by path: resampled, turned y up, cut and repeated."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from hood.assets.files.library import locate
from hood.assets.motion import sequence_edit as edit
from hood.assets.motion.recording import NUM_BODY_JOINTS, Recording, read_recording
from hood.assets.motion.sequence import Z_UP_TO_Y_UP, PoseSequence, resample, turn_world
from hood.assets.motion.up_axis import bearing_notice

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
) -> PoseSequence:
    """A motion by its embedded name or from a file, as it is to be performed.

    Args:
        name: an embedded name, an AMASS ``.npz`` of any layout, or a ``.pkl`` with joint rotations.
        fps: frames per second of the result; rotations are interpolated by slerp, translations linearly.
        up: axis of the file's world that points up: "z", "y", or "auto", along which the body stands; z for AMASS layouts and
            y for the others where that is open.
        start: first moment of the file to keep, in seconds, or in frames of the file as "120f"; None: its beginning.
        stop: last moment to keep, likewise; None: its end.
        loop: times the motion is played; each play goes on from where the last one ended.
        blend_in: seconds of moving from a standing pose into the first frame, put before it.
        blend_from: that pose, "t" or "a".
        hands: "flat", or "file" for the fingers (SMPL-H, SMPL-X) or hands (SMPL) that the file holds.
        file_fps: frame rate of the file, whatever it says itself.

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
    if up not in ("y", "z", "auto"):
        raise ValueError(f"up={up}: give z (AMASS), y or auto, the axis that points up in the file")
    if hands not in HANDS:
        raise ValueError(f"hands={hands}: give flat, or file for fingers as recorded")
    recording = read_recording(path, file_fps)
    poses, fingers = recording.poses, recording.fingers
    if hands == "flat":
        poses, fingers = poses.copy(), None
        poses[:, NUM_BODY_JOINTS:] = 0.0
    sequence = PoseSequence(
        path.stem,
        poses,
        recording.transl,
        recording.fps,
        recording.betas,
        np.eye(3),
        fingers,
        recording.gender,
        recording.family,
    )
    sequence = resample(edit.trim(sequence, start, stop), fps)
    if (_up_axis(path, recording) if up == "auto" else up) == "z":
        sequence = turn_world(sequence, Z_UP_TO_Y_UP)
    return edit.blend_in(edit.loop(sequence, loop), blend_in, blend_from)


def _up_axis(path: Path, recording: Recording) -> str:
    """The axis along which the body stands; a warning where it is not that of the layout."""
    axis, notice = bearing_notice(path, recording)
    if notice is not None:
        warnings.warn(notice, stacklevel=3)
    return axis

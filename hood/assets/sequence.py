"""Motions as a body performs them: of any frame rate and layout, resampled and turned y up."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hood.assets.bearing import bearing_notice
from hood.assets.library import locate
from hood.assets.motion_file import NUM_BODY_JOINTS, Recording, read_recording

__all__ = ["HANDS", "NUM_BODY_JOINTS", "Z_UP_TO_Y_UP", "PoseSequence", "load_sequence", "resample", "turn_world"]

#: z-up (AMASS) to y-up: (x, y, z) → (x, z, -y).
Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
HANDS = ("flat", "file")


@dataclass(frozen=True)
class PoseSequence:
    """Joint rotations and root translation over time, y up.

    ``world_rotation`` is the turn applied to the file's world; a body adds its pelvis offset with it (see
    :meth:`hood.assets.body.Body.translation`).
    """

    name: str
    poses: np.ndarray  # (T, 24, 3) axis-angle [rad], float64; hands zero unless asked for
    transl: np.ndarray  # (T, 3) m, float64
    fps: float
    betas: np.ndarray  # (S,) of the recorded subject, of the model that recorded it
    world_rotation: np.ndarray  # (3, 3)
    fingers: np.ndarray | None = None  # (T, 30, 3) axis-angle [rad]; None: flat hands
    gender: str | None = None  # of the recorded subject; None: the file does not tell
    family: str | None = None  # "smpl", "smplh" or "smplx", the model that recorded it; None: the file does not tell

    @property
    def num_frames(self) -> int:
        return len(self.poses)

    def window(self, start: int, stop: int) -> PoseSequence:
        """Frames ``start:stop``."""
        fingers = None if self.fingers is None else self.fingers[start:stop]
        return replace(self, poses=self.poses[start:stop], transl=self.transl[start:stop], fingers=fingers)


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
    from hood.assets import sequence_edit as edit

    path = locate("motions", name)
    if up not in ("y", "z", "auto"):
        raise ValueError(f"up axis {up!r}: give 'z' (AMASS), 'y' or 'auto'")
    if hands not in HANDS:
        raise ValueError(f"hands {hands!r}: give 'flat' or 'file'")
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


def resample(sequence: PoseSequence, fps: float) -> PoseSequence:
    """The motion at another frame rate: rotations by slerp, translations linearly; time stamps k / fps, no drift."""
    if abs(sequence.fps - fps) < 1e-9:
        return sequence
    source, target = time_stamps(sequence.name, sequence.num_frames, sequence.fps, fps)
    transl = np.stack([np.interp(target, source, sequence.transl[:, axis]) for axis in range(3)], axis=1)
    fingers = None if sequence.fingers is None else _slerp(sequence.fingers, source, target)
    return replace(sequence, poses=_slerp(sequence.poses, source, target), transl=transl, fps=fps, fingers=fingers)


def time_stamps(name: str, num_frames: int, fps: float, new_fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] of the frames of a recording, and of its frames at another rate: k / new_fps as far as it goes.

    Raises:
        ValueError: less than two frames are left, or more than a million.
    """
    count = np.floor((num_frames - 1) * new_fps / fps + 1e-9) + 1
    if count < 2:
        raise ValueError(f"{name}: {num_frames} frames at {fps:g} fps are less than two at {new_fps:g}")
    if count > 1e6:
        raise ValueError(f"{name}: {num_frames} frames at {fps:g} fps are {count:.0f} at {new_fps:g}; check the frame rate")
    source = np.arange(num_frames) / fps
    return source, np.minimum(np.arange(int(count)) / new_fps, source[-1])


def turn_world(sequence: PoseSequence, rotation: np.ndarray) -> PoseSequence:
    """The motion in a turned world: root orientation and translation by ``rotation`` (3, 3)."""
    poses = sequence.poses.copy()
    poses[:, 0] = (Rotation.from_matrix(rotation) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    transl = sequence.transl @ rotation.T
    return replace(sequence, poses=poses, transl=transl, world_rotation=rotation @ sequence.world_rotation)


def _slerp(poses: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(T, J, 3) axis-angle at the times ``target`` of (N, J, 3) at the times ``source``."""
    result = np.zeros((len(target), *poses.shape[1:]))
    for joint in range(poses.shape[1]):
        if np.any(poses[:, joint]):
            result[:, joint] = Slerp(source, Rotation.from_rotvec(poses[:, joint]))(target).as_rotvec()
    return result

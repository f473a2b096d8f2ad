"""Pose sequences: joint rotations and root translation over time, resampled and turned."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.motion.axes import Z_UP_TO_Y_UP
from hood.assets.motion.recording import NUM_BODY_JOINTS
from hood.assets.motion.skeleton import from_vectors, slerp

__all__ = ["NUM_BODY_JOINTS", "Z_UP_TO_Y_UP", "PoseSequence", "resample", "still", "turn_world"]

#: Seconds for which a single pose is held where nobody says how long.
_HELD = 5.0


@dataclass(frozen=True)
class PoseSequence:
    """Joint rotations and root translation over time, y up.

    ``world_rotation`` is the turn applied to the file's world; a body adds its pelvis offset with it (see
    :meth:`hood.assets.body.body.Body.translation`).
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

    def at(self, frames: np.ndarray) -> PoseSequence:
        """The frames with these numbers (N,)."""
        fingers = None if self.fingers is None else self.fingers[frames]
        return replace(self, poses=self.poses[frames], transl=self.transl[frames], fingers=fingers)


def still(sequence: PoseSequence, fps: float, num_frames: int | None = None) -> PoseSequence:
    """A single pose held at ``fps`` for ``num_frames``, at least two; None: five seconds."""
    count = max(round(_HELD * fps) + 1 if num_frames is None else num_frames, 2)
    return replace(sequence.at(np.zeros(count, dtype=np.int64)), fps=fps)


def resample(sequence: PoseSequence, fps: float) -> PoseSequence:
    """The motion at another frame rate: rotations by slerp, translations linearly; time stamps k / fps, no drift."""
    if abs(sequence.fps - fps) < 1e-9:
        return sequence
    source, target = time_stamps(sequence.name, sequence.num_frames, sequence.fps, fps)
    transl = np.stack([np.interp(target, source, sequence.transl[:, axis]) for axis in range(3)], axis=1)
    fingers = None if sequence.fingers is None else slerp(sequence.fingers, source, target)
    return replace(sequence, poses=slerp(sequence.poses, source, target), transl=transl, fps=fps, fingers=fingers)


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
    poses[:, 0] = (Rotation.from_matrix(rotation) * from_vectors(poses[:, 0])).as_rotvec()
    transl = sequence.transl @ rotation.T
    return replace(sequence, poses=poses, transl=transl, world_rotation=rotation @ sequence.world_rotation)

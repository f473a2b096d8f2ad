"""Pose sequences: joint rotations and root translation over time, resampled and turned."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.material import NO_GRADIENT
from hood.assets.motion.recording import NUM_BODY_JOINTS
from hood.assets.motion.skeleton import Z_UP_TO_Y_UP, from_vectors, slerp

__all__ = ["NUM_BODY_JOINTS", "Z_UP_TO_Y_UP", "PoseSequence", "resample", "still", "turn_world"]

#: Seconds for which a single pose is held where nobody says how long.
_HELD = 5.0
#: Joints of poses that arrays may hold: those of the body without and with hands, and with the fingers of SMPL-H.
_JOINTS, _NUM_FINGERS = (NUM_BODY_JOINTS, 24, 52), 30
#: No joint turns so far [rad], and no body moves so fast [m/s]: such numbers are in other units.
_FARTHEST, _FASTEST = 4.0 * np.pi, 100.0


@dataclass(frozen=True)
class PoseSequence:
    """Joint rotations and root translation over time, y up.

    ``world_rotation`` is the turn applied to the file's world; a body adds its pelvis offset with it (see
    :meth:`hood.assets.body.body.Body.translation`).
    """

    name: str  # for messages and files
    poses: np.ndarray  # (T, 24, 3) axis-angle [rad], float64; hands zero unless asked for
    transl: np.ndarray  # (T, 3) m, float64
    fps: float  # frames per second
    betas: np.ndarray  # (S,) of the recorded subject, of the model that recorded it
    world_rotation: np.ndarray  # (3, 3)
    fingers: np.ndarray | None = None  # (T, 30, 3) axis-angle [rad]; None: flat hands
    gender: str | None = None  # of the recorded subject; None: the file does not tell
    family: str | None = None  # "smpl", "smplh" or "smplx", the model that recorded it; None: the file does not tell

    @classmethod
    def from_arrays(
        cls, poses: Any, transl: Any, fps: float, betas: Any = (), name: str = "motion", gender: str | None = None
    ) -> PoseSequence:
        """A motion of arrays, y up, as :func:`hood.simulate` takes it for ``sequence``.

        Args:
            poses: (T, J, 3) or (T, 3 J) axis-angle [rad], in the order of SMPL: 22 joints, 24, or the 52 of SMPL-H.
            transl: (T, 3) m, of the root.
            fps: frames per second.
            betas: (S,) shape coefficients of the person; none: the mean body.
            name: for messages.
            gender: of the person.

        Raises:
            ValueError: arrays of another shape or type, not finite, or in other units; names the argument, the index and the
                fix.
        """
        turns = real_rows("sequence", "poses", poses, "(frames, joints, 3)", (2, 3))
        turns = turns.reshape(len(turns), -1, 3) if turns.shape[-1] % 3 == 0 else turns[..., None]
        if turns.shape[-1] != 3 or turns.shape[1] not in _JOINTS:
            raise ValueError(
                f"sequence: poses have shape {np.shape(poses)}; give (frames, joints, 3), {', '.join(map(str, _JOINTS))} joints"
            )
        fingers = turns[:, -_NUM_FINGERS:] if turns.shape[1] > 24 else None
        body = np.zeros((len(turns), 24, 3))
        kept = NUM_BODY_JOINTS if fingers is not None else turns.shape[1]
        body[:, :kept] = turns[:, :kept]
        family = {24: "smpl", 52: "smplh"}.get(turns.shape[1])
        return checked_sequence(cls(name, body, transl, fps, betas, np.eye(3), fingers, gender, family))

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.poses)

    def window(self, start: int, stop: int) -> PoseSequence:
        """Frames ``start:stop``."""
        fingers = None if self.fingers is None else self.fingers[start:stop]
        return replace(self, poses=self.poses[start:stop], transl=self.transl[start:stop], fingers=fingers)

    def at(self, frames: np.ndarray) -> PoseSequence:
        """The frames with these numbers (N,)."""
        fingers = None if self.fingers is None else self.fingers[frames]
        return replace(self, poses=self.poses[frames], transl=self.transl[frames], fingers=fingers)


def checked_sequence(sequence: PoseSequence) -> PoseSequence:
    """The motion with its arrays in float64, as somebody may have made it.

    Raises:
        ValueError: as of :meth:`PoseSequence.from_arrays`.
    """
    poses = real_rows("sequence", "poses", sequence.poses, "(frames, 24, 3)", (3,), 3)
    transl = real_rows("sequence", "transl", sequence.transl, "(frames, 3)", (2,), 3)
    fps = rate_of("sequence", sequence.fps)
    if poses.shape[1] != 24:
        raise ValueError(f"sequence: poses have shape {poses.shape}; give (frames, 24, 3), or hood.PoseSequence.from_arrays")
    if len(transl) != len(poses):
        raise ValueError(f"sequence: transl has {len(transl)} frames, poses have {len(poses)}; give as many of both")
    far = np.abs(poses).max(axis=(1, 2)) > _FARTHEST
    if far.any():
        frame = int(far.argmax())
        raise ValueError(
            f"sequence: poses[{frame}] turns a joint by {np.abs(poses[frame]).max():.3g} rad; degrees become radians by "
            "np.radians(poses)"
        )
    speed = np.linalg.norm(np.diff(transl, axis=0), axis=1) * fps
    if len(speed) and speed.max() > _FASTEST:
        frame = int(speed.argmax())
        raise ValueError(
            f"sequence: transl moves by {speed[frame]:.3g} m/s after frame {frame}; give metres, centimetres become metres by "
            "transl / 100"
        )
    betas = np.asarray(sequence.betas, dtype=np.float64).reshape(-1)
    if not np.isfinite(betas).all():
        raise ValueError(f"sequence: betas[{int((~np.isfinite(betas)).argmax())}] is not finite; give finite coefficients")
    return replace(sequence, poses=poses, transl=transl, fps=fps, betas=betas)


def real_rows(
    argument: str, key: str, value: Any, form: str, ndims: tuple[int, ...], last: int | None = None, single: bool = False
) -> np.ndarray:
    """An array of finite reals that somebody gives, in float64.

    Args:
        argument, key: what it is, for messages.
        form: shape that is asked for, in words.
        ndims: numbers of axes that it may have.
        last: length of its last axis.
        single: leave float32 as it is: a long mesh sequence would take twice the memory.

    Raises:
        ValueError: something else; names the first index that is not finite.
    """
    if getattr(value, "requires_grad", False):
        raise ValueError(f"{argument}: {key}: {NO_GRADIENT}")
    try:
        array = np.asarray(value.cpu() if hasattr(value, "cpu") else value)
    except ValueError:
        raise ValueError(f"{argument}: rows of {key} differ in length; give {form}") from None
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{argument}: {key} is of type {array.dtype}; give an array of numbers, {form}")
    if array.ndim not in ndims or 0 in array.shape or (last is not None and array.shape[-1] != last):
        raise ValueError(f"{argument}: {key} has shape {array.shape}; give {form}")
    if not np.isfinite(array).all():
        place = tuple(map(int, np.argwhere(~np.isfinite(array))[0]))
        raise ValueError(f"{argument}: {key}[{', '.join(map(str, place))}] is {array[place]}; give finite numbers")
    return array if single and array.dtype == np.float32 else array.astype(np.float64)


def rate_of(argument: str, fps: Any) -> float:
    """Frames per second that somebody gives.

    Raises:
        ValueError: no such number.
    """
    if getattr(fps, "requires_grad", False):
        raise ValueError(f"{argument}: fps: {NO_GRADIENT}")
    number = isinstance(fps, (int, float, np.number)) and not isinstance(fps, bool)
    if not number or not 0.1 <= float(fps) <= 1e5:
        raise ValueError(f"{argument}: fps is {fps!r}; give frames per second, 0.1 to 100000, such as fps=30")
    return float(fps)


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

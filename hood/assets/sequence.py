"""Motions: AMASS files of any frame rate, resampled and turned y up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hood.assets.library import locate, read_arrays

#: Body joints that drive a garment: pelvis to wrists. Columns 66:72 of SMPL+H poses are fingers, not SMPL's hands.
NUM_BODY_JOINTS = 22
_SMPL_JOINTS = 24
#: z-up (AMASS) to y-up: (x, y, z) → (x, z, -y).
Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class PoseSequence:
    """Joint rotations and root translation over time, y up.

    ``world_rotation`` is the turn applied to the file's world; a body adds its pelvis offset with it (see
    :meth:`hood.assets.body.Body.translation`).
    """

    name: str
    poses: np.ndarray  # (T, 24, 3) axis-angle [rad], float64; hands zero
    transl: np.ndarray  # (T, 3) m, float64
    fps: float
    betas: np.ndarray  # (S,) of the recorded subject, of the model that recorded it
    world_rotation: np.ndarray  # (3, 3)

    @property
    def num_frames(self) -> int:
        return len(self.poses)

    def window(self, start: int, stop: int) -> PoseSequence:
        """Frames ``start:stop``."""
        return replace(self, poses=self.poses[start:stop], transl=self.transl[start:stop])


def load_sequence(name: str | Path, fps: float = 30.0, up: str = "z") -> PoseSequence:
    """An embedded motion or an AMASS ``.npz`` (SMPL+H or SMPL-X keys), resampled to ``fps`` and turned y up.

    Raises:
        FileNotFoundError: unknown name or missing file.
        ValueError: not an AMASS file, fewer than two frames, non-finite poses, unknown up axis.
    """
    path = locate("motions", name)
    if path.suffix != ".npz":
        raise ValueError(f"{path}: motions are AMASS .npz files (poses, trans, mocap_framerate)")
    if up not in ("y", "z"):
        raise ValueError(f"up axis {up!r}: give 'z' (AMASS) or 'y'")
    arrays = read_arrays(path, ("trans",), "AMASS motion")
    poses, transl = _body_poses(path, arrays), np.asarray(arrays["trans"], dtype=np.float64)
    _check(path, poses, transl)
    rate = _frame_rate(path, arrays)
    betas = np.asarray(arrays.get("betas", np.zeros(10)), dtype=np.float64).reshape(-1)
    sequence = PoseSequence(path.stem, poses, transl, rate, betas, np.eye(3))
    sequence = resample(sequence, fps)
    return turn_world(sequence, Z_UP_TO_Y_UP) if up == "z" else sequence


def resample(sequence: PoseSequence, fps: float) -> PoseSequence:
    """The motion at another frame rate: rotations by slerp, translations linearly; time stamps k / fps, no drift."""
    if abs(sequence.fps - fps) < 1e-9:
        return sequence
    count = int(np.floor((sequence.num_frames - 1) * fps / sequence.fps + 1e-9)) + 1
    if count < 2:
        raise ValueError(f"{sequence.name}: {sequence.num_frames} frames at {sequence.fps:g} fps are less than two at {fps:g}")
    source = np.arange(sequence.num_frames) / sequence.fps
    target = np.minimum(np.arange(count) / fps, source[-1])
    poses = np.zeros((count, _SMPL_JOINTS, 3))
    for joint in range(_SMPL_JOINTS):
        if np.any(sequence.poses[:, joint]):
            turns = Rotation.from_rotvec(sequence.poses[:, joint])
            poses[:, joint] = Slerp(source, turns)(target).as_rotvec()
    transl = np.stack([np.interp(target, source, sequence.transl[:, axis]) for axis in range(3)], axis=1)
    return replace(sequence, poses=poses, transl=transl, fps=fps)


def turn_world(sequence: PoseSequence, rotation: np.ndarray) -> PoseSequence:
    """The motion in a turned world: root orientation and translation by ``rotation`` (3, 3)."""
    poses = sequence.poses.copy()
    poses[:, 0] = (Rotation.from_matrix(rotation) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    transl = sequence.transl @ rotation.T
    return replace(sequence, poses=poses, transl=transl, world_rotation=rotation @ sequence.world_rotation)


def _body_poses(path: Path, arrays: dict[str, np.ndarray]) -> np.ndarray:
    if "poses" in arrays:
        flat = np.asarray(arrays["poses"], dtype=np.float64)
        if flat.ndim != 2 or flat.shape[1] < 3 * NUM_BODY_JOINTS:
            raise ValueError(f"{path}: poses has shape {flat.shape}; AMASS has (N, 156) with at least 66 columns")
        flat = flat[:, : 3 * NUM_BODY_JOINTS]
    elif "root_orient" in arrays and "pose_body" in arrays:
        shapes = [arrays[key].shape for key in ("root_orient", "pose_body")]
        if [shape[1:] for shape in shapes] != [(3,), (63,)] or shapes[0][0] != shapes[1][0]:
            raise ValueError(f"{path}: root_orient and pose_body have shapes {shapes}; AMASS has (N, 3) and (N, 63)")
        flat = np.concatenate([arrays["root_orient"], arrays["pose_body"]], axis=1).astype(np.float64)
    else:
        raise ValueError(f"{path}: not an AMASS motion: neither 'poses' nor 'root_orient' and 'pose_body' inside")
    poses = np.zeros((len(flat), _SMPL_JOINTS, 3))
    poses[:, :NUM_BODY_JOINTS] = flat.reshape(len(flat), NUM_BODY_JOINTS, 3)
    return poses


def _frame_rate(path: Path, arrays: dict[str, np.ndarray]) -> float:
    for key in ("mocap_framerate", "mocap_frame_rate"):
        if key in arrays:
            value = np.asarray(arrays[key]).reshape(-1)
            rate = float(value[0]) if len(value) == 1 and np.issubdtype(value.dtype, np.number) else np.nan
            if not np.isfinite(rate) or rate <= 0:
                raise ValueError(f"{path}: {key} is {arrays[key]}; it must be a positive number of frames per second")
            return rate
    raise ValueError(f"{path}: no mocap_framerate: add it (frames per second) to the file")


def _check(path: Path, poses: np.ndarray, transl: np.ndarray) -> None:
    if len(poses) != len(transl) or transl.ndim != 2 or transl.shape[1] != 3:
        raise ValueError(f"{path}: poses has {len(poses)} frames, trans has shape {transl.shape}; they must agree")
    if len(poses) < 2:
        raise ValueError(f"{path}: the sequence has {len(poses)} frame(s); a motion needs at least 2")
    for name, values in (("poses", poses), ("trans", transl)):
        bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
        if bad.any():
            raise ValueError(f"{path}: {name} is not finite in frame {int(np.argmax(bad))}; remove or repair that frame")

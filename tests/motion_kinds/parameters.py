"""Contents of motion files with plain SMPL parameters, as AMASS has them or by body_pose, in every representation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from motion_kinds.walks import COUNT, matrices, walk, world


def amass(columns: int = 156, **more: Any) -> dict[str, Any]:
    own = world("z")
    return {
        "poses": own.flat(columns), "trans": own.transl, "betas": own.betas, "gender": "male", "mocap_framerate": 30.0,
        "dmpls": np.zeros((COUNT, 8)),
    } | more  # fmt: skip


def posed(poses: np.ndarray, **more: Any) -> dict[str, Any]:
    """Generic SMPL parameters, y up, at 30 frames a second."""
    return {"poses": poses, "trans": world("z").transl, "betas": walk().betas, "fps": 30} | more


def quaternions(first: bool) -> np.ndarray:
    own = world("z")
    found = Rotation.from_rotvec(own.poses.reshape(-1, 3)).as_quat().reshape(COUNT, 24, 4)
    return found[..., [3, 0, 1, 2]] if first else found


def six(kind: str) -> np.ndarray:
    turns = matrices(world("z").poses)
    pairs = {"rows": turns[..., :2, :], "columns": turns.transpose(0, 1, 3, 2)[..., :2, :], "woven": turns[..., :, :2]}[kind]
    return pairs.reshape(COUNT, 24, 6)


def split(**more: Any) -> dict[str, Any]:
    own = world()
    return {"body_pose": own.flat()[:, 3:], "global_orient": own.root, "transl": own.transl, "betas": own.betas} | more


def camera_space() -> dict[str, Any]:
    own = world("-y")
    return {"poses": own.flat(), "trans": own.transl, "betas": own.betas, "mocap_framerate": 30.0}


def of_kind(kind: Any, content: dict[str, Any]) -> dict[str, Any]:
    """Arrays of another kind of numbers."""
    return {
        key: value.astype(kind) if isinstance(value, np.ndarray) and value.dtype.kind == "f" else value
        for key, value in content.items()
    }


def of_tensors(content: dict[str, Any]) -> dict[str, Any]:
    """Every array as a tensor of torch."""
    return {key: torch.from_numpy(value.copy()) if isinstance(value, np.ndarray) else value for key, value in content.items()}


def rows_of_objects() -> dict[str, Any]:
    """AMASS with an array of objects that are the rows."""
    rows = np.empty(COUNT, dtype=object)
    rows[:] = list(world("z").flat())
    return amass(72, poses=rows)


def split_matrices() -> dict[str, Any]:
    own = world()
    return split(body_pose=matrices(own.poses[:, 1:]), global_orient=matrices(own.root)[:, None])


def one_frame_a_dict() -> list[dict[str, Any]]:
    own = world()
    return [{"pose": own.flat()[row], "trans": own.transl[row], "betas": own.betas} for row in range(COUNT)]

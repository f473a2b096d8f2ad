"""Licensed SMPL, SMPL-H and SMPL-X models: the one module that imports ``smplx`` (non-commercial licence)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.assets.body import Body
from hood.assets.sequence import PoseSequence

#: Number of joints in a file → (class name in smplx, body joints driven by a sequence, root included).
_FAMILY = {24: ("SMPL", 24), 52: ("SMPLH", 22), 55: ("SMPLX", 22)}


@dataclass(frozen=True)
class SmplFamilyBody(Body):
    """A body whose surface is evaluated by ``smplx``, pose blend shapes included; hands stay flat."""

    model: Any = None  # smplx module
    driven_joints: int = 22

    def surface(self, sequence: PoseSequence, betas: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
        """Posed vertices (T, W, 3) [m] relative to :meth:`translation`."""
        model = self.model.to(dtype)
        poses = torch.as_tensor(sequence.poses[:, : self.driven_joints]).to(dtype).flatten(1)
        num_frames = len(poses)
        shape = torch.zeros(num_frames, model.num_betas, dtype=dtype)
        count = min(len(betas), shape.shape[1])
        shape[:, :count] = torch.as_tensor(np.asarray(betas)[:count]).to(dtype)
        zeros = {name: torch.zeros(num_frames, width, dtype=dtype) for name, width in self._idle().items()}
        with torch.no_grad():
            return model(betas=shape, global_orient=poses[:, :3], body_pose=poses[:, 3:], **zeros).vertices

    def _idle(self) -> dict[str, int]:
        hands = {"left_hand_pose": 45, "right_hand_pose": 45}
        face = {"jaw_pose": 3, "leye_pose": 3, "reye_pose": 3, "expression": 10}
        return {24: {}, 52: hands, 55: hands | face}[self.num_joints]


def load_smpl_family(path: Path, arrays: dict[str, np.ndarray]) -> SmplFamilyBody:
    """A licensed model file from its arrays.

    Raises:
        ValueError: the number of joints belongs to no model of the family.
    """
    import smplx

    num_joints = arrays["weights"].shape[1]
    if num_joints not in _FAMILY:
        raise ValueError(f"{path}: {num_joints} joints; SMPL has 24, SMPL-H 52, SMPL-X 55")
    kind, driven = _FAMILY[num_joints]
    options = {} if kind == "SMPL" else {"use_pca": False, "flat_hand_mean": True}
    model = getattr(smplx, kind)("", data_struct=smplx.utils.Struct(**arrays), **options)
    parents = np.asarray(arrays["kintree_table"])[0].astype(np.int64)
    return SmplFamilyBody(
        name=path.stem,
        v_template=np.asarray(arrays["v_template"], dtype=np.float64),
        shapedirs=np.asarray(arrays["shapedirs"][..., : model.num_betas], dtype=np.float64),
        joint_regressor=np.asarray(arrays["J_regressor"], dtype=np.float64),
        weights=np.asarray(arrays["weights"], dtype=np.float64),
        parents=tuple(int(p) if 0 <= p < num_joints else -1 for p in parents),
        faces=np.asarray(arrays["f"]).astype(np.int64),
        model=model,
        driven_joints=driven,
    )

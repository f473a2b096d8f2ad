"""Licensed SMPL, SMPL-H and SMPL-X models: the one module that imports ``smplx`` (non-commercial licence)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hood.assets.body.body import Body, axis_angle_to_matrix
from hood.assets.motion.sequence import PoseSequence

#: Number of joints in a file → name of the model.
FAMILY = {24: "smpl", 52: "smplh", 55: "smplx"}
#: AMASS records at most this many shape coefficients.
_MAX_BETAS = 16
#: SMPL-X files end with directions of facial expression: 100 behind 300 of shape, or 10 behind 10.
_EXPRESSIONS = {400: 300, 20: 10}


@dataclass(frozen=True)
class SmplFamilyBody(Body):
    """A body whose surface is evaluated by ``smplx``, pose blend shapes included."""

    posedirs: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (P, 3W) m per entry of a rotation matrix
    _tensors: dict[torch.dtype, tuple[Tensor, ...]] = field(default_factory=dict, repr=False, compare=False)

    def surface(self, sequence: PoseSequence, betas: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
        """Posed vertices (T, W, 3) [m] relative to :meth:`translation`."""
        from smplx.lbs import lbs

        rotations = axis_angle_to_matrix(torch.as_tensor(self.joint_poses(sequence))).to(dtype)
        shape = torch.zeros(len(rotations), self.shapedirs.shape[2], dtype=dtype)
        count = min(len(betas), shape.shape[1])
        shape[:, :count] = torch.as_tensor(np.asarray(betas, dtype=np.float64)[:count])
        template, shapedirs, posedirs, regressor, weights = self._tensors_in(dtype)
        parents = torch.as_tensor(self.parents)
        with torch.no_grad():
            return lbs(
                shape, rotations, template[None], shapedirs, posedirs, regressor, parents, weights, pose2rot=False
            )[0]  # fmt: skip

    def some_points(self, sequence: PoseSequence, betas: np.ndarray, stride: int) -> Tensor:
        """Every ``stride``-th vertex of :meth:`surface`, (T, W′, 3) [m] in float64."""
        return self.surface(sequence, betas, torch.float64)[:, ::stride]

    def _tensors_in(self, dtype: torch.dtype) -> tuple[Tensor, ...]:
        # Each precision is rounded from float64 by itself: a module turned to float32 and back has lost its digits.
        if dtype not in self._tensors:
            arrays = (self.v_template, self.shapedirs, self.posedirs, self.joint_regressor, self.weights)
            self._tensors[dtype] = tuple(torch.as_tensor(array).to(dtype) for array in arrays)
        return self._tensors[dtype]


def smpl_family_body(path: Path, arrays: dict[str, np.ndarray]) -> SmplFamilyBody:
    """A licensed model from the arrays of its file (see :func:`hood.assets.body.load.read_model`).

    Raises:
        ValueError: the number of joints belongs to no model of the family.
        ImportError: ``smplx`` is not installed.
    """
    import smplx  # noqa: F401  (asked for here, so that its absence shows when the file is opened)

    num_vertices, num_joints = arrays["weights"].shape
    if num_joints not in FAMILY:
        raise ValueError(f"{path}: {num_joints} joints; SMPL has 24, SMPL-H 52, SMPL-X 55")
    num_shapes = arrays["shapedirs"].shape[2]
    if FAMILY[num_joints] == "smplx":
        num_shapes = _EXPRESSIONS.get(num_shapes, num_shapes)
    return SmplFamilyBody(
        name=path.stem if path.stem != "model" else f"{path.parent.name}_{path.stem}",
        v_template=arrays["v_template"],
        shapedirs=arrays["shapedirs"][..., : min(num_shapes, _MAX_BETAS)],
        joint_regressor=arrays["J_regressor"],
        weights=arrays["weights"],
        parents=tuple(int(parent) for parent in arrays["kintree_table"][0]),
        faces=arrays["f"],
        family=FAMILY[num_joints],
        posedirs=arrays["posedirs"].reshape(3 * num_vertices, -1).T,
    )

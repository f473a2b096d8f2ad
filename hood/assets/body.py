"""A parametric body: shape coefficients and joint rotations in, surface vertices out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hood.assets.library import locate, read_arrays
from hood.assets.sequence import PoseSequence
from hood.assets.skinning import axis_angle_to_matrix, joint_transforms, linear_blend_skinning

#: Joints 20 and 21 of every skeleton of the family; what hangs below them is hand and fingers.
_WRISTS = (20, 21)
_KEYS = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")


@dataclass(frozen=True)
class Body:
    """A body in SMPL layout, posed by the project's own linear blend skinning.

    Symbols: W vertices, J joints, S shape coefficients. Arrays are float64; posing is done in ``dtype``.
    """

    name: str
    v_template: np.ndarray  # (W, 3) m, T-pose, y up, z forward
    shapedirs: np.ndarray  # (W, 3, S) m per unit of beta
    joint_regressor: np.ndarray  # (J, W)
    weights: np.ndarray  # (W, J)
    parents: tuple[int, ...]  # (J,), -1 for the root
    faces: np.ndarray  # (G, 3) int64

    @property
    def num_joints(self) -> int:
        return len(self.parents)

    @property
    def omitted(self) -> np.ndarray:
        """(W,) bool: vertices that follow a joint below a wrist most. They get no body edges: fingers catch cloth."""
        hand = [False] * self.num_joints
        for joint, parent in enumerate(self.parents):
            hand[joint] = parent in _WRISTS or (parent >= 0 and hand[parent])
        return np.array(hand)[self.weights.argmax(axis=1)]

    def shaped(self, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rest vertices (W, 3) and joints (J, 3) [m] of shape ``betas`` (S' <= S,)."""
        rest = self.v_template + self.shapedirs[..., : len(betas)] @ np.asarray(betas, dtype=np.float64)
        return rest, self.joint_regressor @ rest

    def transforms(self, sequence: PoseSequence, betas: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
        """(T, J, 3, 4) rest-to-posed joint transforms, root translation not included."""
        joints = torch.as_tensor(self.shaped(betas)[1])
        # Skeletons with fingers have more joints than a sequence drives; those stay at rest.
        poses = np.zeros((sequence.num_frames, self.num_joints, 3))
        driven = min(self.num_joints, sequence.poses.shape[1])
        poses[:, :driven] = sequence.poses[:, :driven]
        rotations = axis_angle_to_matrix(torch.as_tensor(poses))
        return joint_transforms(rotations, joints, self.parents).to(dtype)

    def translation(self, sequence: PoseSequence, betas: np.ndarray) -> np.ndarray:
        """(T, 3) m, float64: world translation of every frame.

        The root joint is not the origin: turning the world turns the body about the root, so its offset is added back.
        """
        pelvis = self.shaped(betas)[1][0]
        return sequence.transl + (sequence.world_rotation - np.eye(3)) @ pelvis

    def surface(self, sequence: PoseSequence, betas: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
        """Posed vertices (T, W, 3) [m] relative to :meth:`translation`."""
        rest = torch.as_tensor(self.shaped(betas)[0]).to(dtype)
        return linear_blend_skinning(rest, torch.as_tensor(self.weights).to(dtype), self.transforms(sequence, betas, dtype))


def load_body(name: str | Path = "default") -> Body:
    """The embedded body by name, or a body file in SMPL layout (``.npz``).

    Files of the SMPL family with pose blend shapes are read through ``smplx``, see :mod:`hood.assets.smpl_family`.
    """
    path = locate("body", name)
    if path.suffix == ".pkl":
        raise ValueError(f"{path}: pickles run code when read; convert it to .npz with the keys {', '.join(_KEYS)}")
    arrays = read_arrays(path, _KEYS, "body model")
    if "posedirs" in arrays and np.any(arrays["posedirs"]):
        from hood.assets.smpl_family import load_smpl_family

        return load_smpl_family(path, arrays)
    weights = np.asarray(arrays["weights"], dtype=np.float64)
    num_vertices, num_joints = weights.shape
    if arrays["v_template"].shape != (num_vertices, 3):
        raise ValueError(f"{path}: v_template has shape {arrays['v_template'].shape}, weights say ({num_vertices}, 3)")
    parents = [int(p) for p in np.asarray(arrays["kintree_table"])[0].astype(np.int64)]
    return Body(
        name=path.stem,
        v_template=np.asarray(arrays["v_template"], dtype=np.float64),
        shapedirs=np.asarray(arrays["shapedirs"], dtype=np.float64),
        joint_regressor=np.asarray(arrays["J_regressor"], dtype=np.float64),
        weights=weights / weights.sum(axis=1, keepdims=True),
        parents=tuple(p if 0 <= p < num_joints else -1 for p in parents),
        faces=np.asarray(arrays["f"]).astype(np.int64),
    )

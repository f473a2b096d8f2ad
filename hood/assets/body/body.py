"""A parametric body: shape coefficients and joint rotations in, surface vertices out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hood.assets.body.skinning import axis_angle_to_matrix, joint_transforms, linear_blend_skinning
from hood.assets.motion.sequence import NUM_BODY_JOINTS, PoseSequence

#: Joints that skeletons of the SMPL family share, in their order.
JOINTS = (
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot neck "
    "left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist"
).split()
#: Joints 20 and 21 of every skeleton of the family; what hangs below them is hand and fingers.
_WRISTS = (20, 21)
#: Where the fingers (15 joints a side, left first) start in a skeleton of that many joints: SMPL-H, and SMPL-X, whose jaw
#: and eyes come before them.
_FIRST_FINGER = {52: 22, 55: 25}


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
    family: str | None = None  # "smpl", "smplh" or "smplx": whose shape coefficients it takes; None: its own

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
        """Rest vertices (W, 3) and joints (J, 3) [m] of shape ``betas`` (S',); coefficients the body lacks are left out."""
        count = min(len(betas), self.shapedirs.shape[2])
        rest = self.v_template + self.shapedirs[..., :count] @ np.asarray(betas, dtype=np.float64)[:count]
        return rest, self.joint_regressor @ rest

    def joint_poses(self, sequence: PoseSequence) -> np.ndarray:
        """(T, J, 3) axis-angle [rad] of every joint; those that the sequence does not drive stay at rest."""
        poses = np.zeros((sequence.num_frames, self.num_joints, 3))
        first = _FIRST_FINGER.get(self.num_joints)
        # Joints 22 and 23 of a sequence are SMPL's hands; other skeletons have jaw or fingers there.
        driven = min(self.num_joints, sequence.poses.shape[1] if first is None else NUM_BODY_JOINTS)
        poses[:, :driven] = sequence.poses[:, :driven]
        if sequence.fingers is not None and first is not None:
            poses[:, first : first + sequence.fingers.shape[1]] = sequence.fingers
        return poses

    def subject_betas(self, sequence: PoseSequence) -> np.ndarray:
        """(S,) of the recorded subject where this body is the model that recorded it, zeros otherwise."""
        betas = np.zeros(max(self.shapedirs.shape[2], 1))
        if self.family is not None and self.family == sequence.family:
            count = min(len(betas), len(sequence.betas))
            betas[:count] = sequence.betas[:count]
        return betas

    def transforms(self, sequence: PoseSequence, betas: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
        """(T, J, 3, 4) rest-to-posed joint transforms, root translation not included."""
        joints = torch.as_tensor(self.shaped(betas)[1])
        rotations = axis_angle_to_matrix(torch.as_tensor(self.joint_poses(sequence)))
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

    def some_points(self, sequence: PoseSequence, betas: np.ndarray, stride: int) -> Tensor:
        """Every ``stride``-th vertex of :meth:`surface` alone, (T, W′, 3) [m] in float64."""
        rest, weights = (torch.as_tensor(values[::stride]) for values in (self.shaped(betas)[0], self.weights))
        return linear_blend_skinning(rest, weights, self.transforms(sequence, betas, torch.float64))

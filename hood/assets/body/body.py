"""A parametric body: shape coefficients and joint rotations in, surface vertices out.

Linear blend skinning of SMPL-family bodies and of the garments bound to them. Differentiable, one function.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hood.assets.files.library import unknown
from hood.assets.files.text import meant, read_indices
from hood.assets.material import NO_GRADIENT
from hood.assets.motion.sequence import NUM_BODY_JOINTS, PoseSequence


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of axis-angle vectors (..., 3) [rad]; exact and differentiable at zero."""
    # sin(a)/a and (1 - cos a)/a² by a guarded angle: the small offset keeps the gradient of the norm finite at zero.
    tiny = torch.finfo(axis_angle.dtype).eps ** 2
    angle_sq = (axis_angle * axis_angle).sum(-1)
    angle = (angle_sq + tiny).sqrt()
    sinc = torch.sinc(angle / torch.pi)
    half_sinc = torch.sinc(angle / (2 * torch.pi))
    x, y, z = axis_angle.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + sinc[..., None, None] * cross + (0.5 * half_sinc**2)[..., None, None] * (cross @ cross)


def joint_transforms(rotations: Tensor, joints: Tensor, parents: Sequence[int]) -> Tensor:
    """Rest-to-posed transforms of every joint.

    Args:
        rotations: (T, J, 3, 3) local joint rotations.
        joints: (J, 3) rest joint positions [m].
        parents: parent index of each joint; -1 for the root, which comes first.

    Returns:
        (T, J, 3, 4): the linear part and translation that take a rest point to its posed place.
    """
    world_rotation: list[Tensor] = []
    world_position: list[Tensor] = []
    for joint, parent in enumerate(parents):
        if parent < 0:
            world_rotation.append(rotations[:, joint])
            world_position.append(joints[joint].expand(len(rotations), 3))
            continue
        bone = joints[joint] - joints[parent]
        world_rotation.append(world_rotation[parent] @ rotations[:, joint])
        world_position.append(world_position[parent] + world_rotation[parent] @ bone)
    rotation = torch.stack(world_rotation, dim=1)
    position = torch.stack(world_position, dim=1)
    translation = position - (rotation @ joints.unsqueeze(-1)).squeeze(-1)
    return torch.cat([rotation, translation.unsqueeze(-1)], dim=-1)


def linear_blend_skinning(rest_pos: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Posed vertices (T, V, 3) [m] of ``rest_pos`` (V, 3) or (T, V, 3) under ``transforms`` (T, J, 3, 4).

    ``weights`` (V, J) with rows that sum to one. Source: SMPL (Loper et al. 2015), eq. 4.
    """
    num_frames, num_joints = transforms.shape[:2]
    blended = weights @ transforms.reshape(num_frames, num_joints, 12)
    blended = blended.unflatten(-1, (3, 4))
    return (blended[..., :3] @ rest_pos.unsqueeze(-1)).squeeze(-1) + blended[..., 3]


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

    name: str  # for messages and files
    v_template: np.ndarray  # (W, 3) m, T-pose, y up, z forward
    shapedirs: np.ndarray  # (W, 3, S) m per unit of beta
    joint_regressor: np.ndarray  # (J, W)
    weights: np.ndarray  # (W, J)
    parents: tuple[int, ...]  # (J,), -1 for the root
    faces: np.ndarray  # (G, 3) int64
    family: str | None = None  # "smpl", "smplh" or "smplx": whose shape coefficients it takes; None: its own

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            if getattr(value, "requires_grad", False):
                raise ValueError(f"body {self.name!r}: {key}: {NO_GRADIENT}")

    @property
    def num_joints(self) -> int:
        """J."""
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


def body_part(
    part: str, faces: np.ndarray, num_vertices: int, body: Body | None, bones: Mapping[str, np.ndarray] | None = None
) -> np.ndarray:
    """(G,) bool: the faces of a part of a body. A face is of the side of its centre, or of most of its corners.

    Args:
        part: a joint or a bone, whose part is what follows it most (``left_wrist``); ``above_JOINT`` or ``below_JOINT``, by the
            height in T-pose; or the path of a ``.txt`` or ``.json`` list of vertices.
        faces: (G, 3) of the body's surface.
        num_vertices: W.
        body: whose joints are meant; None where the surface has none, and is known by its bones and vertices alone.
        bones: of a mesh, the vertices (W,) bool that follow each most, by name.

    Raises:
        ValueError: the body has no such part, or no face in it; names what there is.
    """
    side, _, joint = part.partition("_")
    bone = meant(part, bones or {})
    if Path(part).suffix.lower() in (".txt", ".json"):
        found = _listed(Path(part).expanduser(), faces, num_vertices)
    elif bones and bone is not None:
        found = bones[bone][faces].sum(axis=1) >= 2
    elif bones and body is None:
        raise ValueError(f"part {part!r}: {unknown('bone', part, bones)}; or a .txt or .json list of the body's vertices")
    elif side in ("above", "below") and joint:
        of, number = _joint(part, joint, body)
        height = of.v_template[faces].mean(axis=1)[:, 1]
        level = of.shaped(np.zeros(0))[1][number, 1]
        found = height > level if side == "above" else height <= level
    else:
        of, number = _joint(part, part, body)
        follows = of.weights.argmax(axis=1) == number
        found = follows[faces].sum(axis=1) >= 2
    if not found.any():
        raise ValueError(f"part {part!r}: no face of the body is in it; leave it out, or choose another")
    return np.asarray(found)


def _joint(part: str, name: str, body: Body | None) -> tuple[Body, int]:
    """The body, and the number of its joint ``name``."""
    if body is None:
        raise ValueError(f"part {part!r}: this body has no joints; give a .txt or .json list of its vertices")
    if name not in JOINTS:
        raise ValueError(f"part {part!r}: {unknown('joint', name, JOINTS)}; above_JOINT, below_JOINT, or a list of vertices")
    if JOINTS.index(name) >= body.num_joints:
        raise ValueError(f"part {part!r}: the body has {body.num_joints} joints and no {name}; give another part")
    return body, JOINTS.index(name)


def _listed(path: Path, faces: np.ndarray, count: int) -> np.ndarray:
    numbers = read_indices(path)
    outside = (numbers < 0) | (numbers >= count)
    if outside.any():
        raise ValueError(f"{path}: vertex {int(numbers[np.argmax(outside)])} of {count} of the body; they are numbered from 0")
    inside = np.zeros(count, dtype=bool)
    inside[numbers] = True
    return np.asarray(inside[faces].sum(axis=1) >= 2)

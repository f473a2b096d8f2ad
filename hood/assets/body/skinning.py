"""Linear blend skinning of SMPL-family bodies and of the garments bound to them. Differentiable, one function."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


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

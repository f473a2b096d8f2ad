"""Own linear blend skinning against smplx, and its derivatives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body, axis_angle_to_matrix, joint_transforms, linear_blend_skinning


@pytest.mark.parametrize("seed", [0, 1])
def test_surface_equals_smplx(seed: int, body: Body, body_file: Path) -> None:
    smplx = pytest.importorskip("smplx")
    rng = np.random.default_rng(seed)
    with np.load(body_file) as arrays:
        struct = smplx.utils.Struct(**dict(arrays))
    model = smplx.SMPL("", data_struct=struct, dtype=torch.float64).double()
    betas = torch.as_tensor(rng.normal(size=10))
    poses = torch.as_tensor(rng.normal(scale=0.7, size=(3, 24, 3)))
    with torch.no_grad():
        expected = model(betas=betas.expand(3, 10), global_orient=poses[:, :1].flatten(1), body_pose=poses[:, 1:].flatten(1))
    rest, joints = body.shaped(betas.numpy())
    transforms = joint_transforms(axis_angle_to_matrix(poses), torch.as_tensor(joints), body.parents)
    own = linear_blend_skinning(torch.as_tensor(rest), torch.as_tensor(body.weights), transforms)
    # smplx adds 1e-8 to the axis-angle vector, the file's weights are float32.
    assert float((own - expected.vertices).abs().max()) < 1e-6


def test_rotation_matrices_are_rotations() -> None:
    axis_angle = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2
    matrices = axis_angle_to_matrix(axis_angle)
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(3).double().expand(50, 3, 3), rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(50).double(), rtol=0, atol=1e-12)
    # The axis stays, the inverse is the opposite turn.
    torch.testing.assert_close((matrices @ axis_angle[..., None])[..., 0], axis_angle, rtol=0, atol=1e-12)
    torch.testing.assert_close(axis_angle_to_matrix(-axis_angle), matrices.mT, rtol=0, atol=1e-12)


def test_quarter_turn_about_y_takes_z_to_x() -> None:
    quarter = axis_angle_to_matrix(torch.tensor([0.0, torch.pi / 2, 0.0], dtype=torch.float64))
    torch.testing.assert_close(quarter @ torch.tensor([0, 0, 1.0]).double(), torch.tensor([1.0, 0, 0]).double())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [0.0, 1e-20, 1e-8, 1e-4, np.pi])
def test_small_and_large_angles_are_exact(size: float, dtype: torch.dtype) -> None:
    axis_angle = torch.tensor([0.6 * size, 0.0, 0.8 * size], dtype=dtype, requires_grad=True)
    matrix = axis_angle_to_matrix(axis_angle)
    cross = torch.tensor([[0, -0.8, 0], [0.8, 0, -0.6], [0, 0.6, 0]], dtype=torch.float64)
    exact = torch.eye(3).double() + np.sin(size) * cross + (1 - np.cos(size)) * cross @ cross
    torch.testing.assert_close(matrix.double(), exact, rtol=0, atol=8 * torch.finfo(dtype).eps)
    matrix.sum().backward()
    assert bool(torch.isfinite(axis_angle.grad).all())


def test_gradient_at_zero_is_the_generator() -> None:
    jacobian = torch.autograd.functional.jacobian(axis_angle_to_matrix, torch.zeros(3, dtype=torch.float64))
    skew = torch.zeros(3, 3, 3, dtype=torch.float64)
    for k, (i, j) in enumerate([(2, 1), (0, 2), (1, 0)]):
        skew[i, j, k], skew[j, i, k] = 1.0, -1.0
    torch.testing.assert_close(jacobian, skew, rtol=0, atol=1e-12)


def test_skinning_gradients() -> None:
    generator = torch.Generator().manual_seed(1)
    joints = torch.randn(3, 3, dtype=torch.float64, generator=generator)
    rest = torch.randn(4, 3, dtype=torch.float64, generator=generator)
    weights = torch.rand(4, 3, dtype=torch.float64, generator=generator)
    weights /= weights.sum(dim=1, keepdim=True)
    poses = torch.randn(2, 3, 3, dtype=torch.float64, generator=generator)
    poses[0, 1] = 0.0  # zero rotation inside

    def skinned(poses: torch.Tensor, joints: torch.Tensor, rest: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        return linear_blend_skinning(rest, weights, joint_transforms(axis_angle_to_matrix(poses), joints, (-1, 0, 1)))

    inputs = tuple(x.requires_grad_(True) for x in (poses, joints, rest, weights))
    assert torch.autograd.gradcheck(skinned, inputs, atol=1e-7)


def test_rest_positions_may_differ_by_frame() -> None:
    transforms = joint_transforms(torch.eye(3).expand(2, 1, 3, 3), torch.zeros(1, 3), (-1,))
    rest = torch.arange(18.0).reshape(2, 3, 3)
    torch.testing.assert_close(linear_blend_skinning(rest, torch.ones(3, 1), transforms), rest)

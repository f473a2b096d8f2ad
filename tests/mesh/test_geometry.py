import math

import numpy as np
import pytest
import torch

from hood.mesh import geometry, topology
from hood.mesh.closest_point.search import build_incidence
from hood.testing import cylinder, grid, random_rotation, sphere

HINGE = torch.tensor([[0, 1, 2, 3]])


def tensors(mesh, dtype=torch.float64):
    return torch.as_tensor(mesh[0]).to(dtype), torch.as_tensor(mesh[1])


def folded_hinge(angle, size=1.0, dtype=torch.float64):
    """Edge along z, one face in the xz-plane, the other turned up by ``angle``."""
    points = [[0, 0, 0], [0, 0, 1], [-0.7, 0, 0.4], [0.9 * math.cos(angle), 0.9 * math.sin(angle), 0.6]]
    return size * torch.tensor(points, dtype=dtype)


def test_areas_and_masses_of_a_sheet():
    pos, faces = tensors(grid(6, 5, 2.0))
    assert float(geometry.triangle_areas(pos, faces).sum()) == pytest.approx(4.0, rel=1e-14)
    mass = geometry.vertex_masses(pos, faces, 0.2)
    assert float(mass.sum()) == pytest.approx(0.8, rel=1e-14)
    per_face = geometry.vertex_masses(pos, faces, torch.full((len(faces),), 0.2, dtype=pos.dtype))
    torch.testing.assert_close(per_face, mass, rtol=1e-15, atol=0)


def test_isolated_vertex_has_no_mass_and_no_normal():
    pos, faces = tensors(grid(3, 3))
    pos = torch.cat([pos, torch.ones(1, 3, dtype=pos.dtype)])
    assert geometry.vertex_masses(pos, faces, 0.2)[-1] == 0
    assert (geometry.vertex_normals(pos, faces)[-1] == 0).all()


def test_normals_of_fans_are_the_vertex_normals():
    pos, faces = tensors(sphere(2))
    pos = torch.cat([pos[:1] + 2, pos, pos[:1] - 2])  # isolated vertices in front and behind
    faces = faces + 1
    table = build_incidence(faces, len(pos))
    expected = geometry.vertex_normals(pos, faces)
    torch.testing.assert_close(geometry.normals_of_fans(pos, faces, table.around, table.first), expected, rtol=0, atol=1e-14)
    rows = torch.tensor([0, 7, len(pos) - 1, 3])
    chosen = geometry.normals_of_fans(pos, faces, table.around, table.first, rows)
    torch.testing.assert_close(chosen, expected[rows], rtol=0, atol=1e-14)
    assert not bool(chosen[[0, 2]].any())


def test_normals_point_out_of_a_sphere_and_a_tube():
    pos, faces = tensors(sphere(2))
    normals = geometry.vertex_normals(pos, faces)
    assert float((normals * pos).sum(dim=1).min()) > 0.999
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(pos), dtype=pos.dtype))
    pos, faces = tensors(cylinder())
    centre = pos[faces].mean(dim=1) * torch.tensor([1.0, 0.0, 1.0], dtype=pos.dtype)
    assert float((geometry.face_normals(pos, faces) * centre).sum(dim=1).min()) > 0


@pytest.mark.parametrize("angle", [-3.0, -1.2, 0.0, 1e-3, 0.5, 3.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dihedral_angle_is_the_fold(angle, dtype):
    theta = geometry.dihedral_angles(folded_hinge(angle, dtype=dtype), HINGE)
    assert abs(float(theta)) == pytest.approx(abs(angle), rel=1e-4, abs=1e-7)
    opposite = geometry.dihedral_angles(folded_hinge(-angle, dtype=dtype), HINGE)
    assert float(theta) == pytest.approx(-float(opposite), abs=1e-6)


def test_small_edges_do_not_underflow_in_float32():
    pos = folded_hinge(0.5, size=1e-4, dtype=torch.float32).requires_grad_(True)
    theta = geometry.dihedral_angles(pos, HINGE)
    theta.sum().backward()
    assert abs(float(theta.detach())) == pytest.approx(0.5, rel=1e-5)
    large = folded_hinge(0.5, dtype=torch.float64).requires_grad_(True)
    geometry.dihedral_angles(large, HINGE).sum().backward()
    torch.testing.assert_close(pos.grad.double() * 1e-4, large.grad, rtol=1e-4, atol=1e-6)


def test_dihedral_gradient_matches_finite_differences():
    for angle in (0.0, 0.7, -2.9):
        pos = folded_hinge(angle).requires_grad_(True)
        assert torch.autograd.gradcheck(lambda x: geometry.dihedral_angles(x, HINGE), pos)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_hinges_have_angle_zero_and_finite_gradients(dtype):
    shapes = {
        "zero-length edge": [[0, 0, 0], [0, 0, 0], [-1, 0, 0], [1, 0, 0]],
        "collinear face": [[0, 0, 0], [0, 0, 1], [0, 0, 2], [1, 0, 0]],
        "one point": [[1, 1, 1]] * 4,
        "opposite vertex on the edge": [[0, 0, 0], [0, 0, 1], [0, 0, 0.5], [1, 0, 0]],
    }
    for name, shape in shapes.items():
        pos = torch.tensor(shape, dtype=dtype).requires_grad_(True)
        theta = geometry.dihedral_angles(pos, HINGE)
        theta.sum().backward()
        assert float(theta.detach()) == 0, name
        assert (pos.grad == 0).all(), name


def test_folded_by_pi_is_finite():
    pos = torch.tensor([[0, 0, 0], [0, 0, 1], [1, 0, 0.5], [1, 0, 0.5]], dtype=torch.float64).requires_grad_(True)
    theta = geometry.dihedral_angles(pos, HINGE)
    theta.sum().backward()
    assert abs(float(theta.detach())) == pytest.approx(math.pi)
    assert torch.isfinite(pos.grad).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("function", [geometry.triangle_areas, geometry.face_normals, geometry.vertex_normals])
def test_degenerate_triangles_have_zero_values_and_zero_gradients(function, dtype):
    for shape in ([[1, 2, 3]] * 3, [[0, 0, 0], [1, 1, 1], [3, 3, 3]], [[0, 0, 0], [0, 0, 0], [1, 0, 0]]):
        pos = torch.tensor(shape, dtype=dtype).requires_grad_(True)
        value = function(pos, torch.tensor([[0, 1, 2]]))
        value.sum().backward()
        assert (value == 0).all()
        assert (pos.grad == 0).all()


def test_rest_inverse_gives_the_deformation_gradient():
    rng = np.random.default_rng(1)
    pos, faces = tensors(grid(4, 3))
    pos = pos + 0.05 * torch.as_tensor(rng.normal(size=pos.shape))
    inverse = geometry.rest_inverse(pos, faces)

    def gradients(x):
        corners = x[faces]
        return torch.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], dim=2) @ inverse

    identity = torch.eye(2, dtype=pos.dtype).expand(len(faces), 2, 2)
    turned = 1.5 * pos @ torch.as_tensor(random_rotation(rng))
    for x, factor in ((pos, 1.0), (turned, 1.5)):
        stretch = gradients(x).mT @ gradients(x)
        torch.testing.assert_close(stretch, factor**2 * identity, rtol=1e-12, atol=1e-12)


def test_gradients_of_areas_and_normals():
    rng = np.random.default_rng(2)
    pos, faces = tensors(grid(3, 3))
    pos = (pos + 0.1 * torch.as_tensor(rng.normal(size=pos.shape))).requires_grad_(True)
    for function in (geometry.triangle_areas, geometry.face_normals, geometry.vertex_normals):
        assert torch.autograd.gradcheck(lambda x, f=function: f(x, faces), pos)


def test_tube_bends_by_its_turning_angle():
    mesh = cylinder(12, 3)
    theta = geometry.dihedral_angles(torch.as_tensor(mesh[0]), torch.as_tensor(topology.hinges(mesh[1]).vertices))
    seams = theta.abs() > 1e-6
    torch.testing.assert_close(theta[seams].abs(), torch.full_like(theta[seams], 2 * math.pi / 12))

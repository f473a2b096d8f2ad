import math

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.losses.bending import Bending
from hood.losses.stretching import Stretching
from hood.scene.cloth import build_cloth
from hood.testing import assert_internal_energy_contract, cylinder, fold, grid, make_problem, strip

F64 = torch.float64


def energy(term, cloth, pos):
    pos = torch.as_tensor(pos).to(cloth.rest_pos)
    return float(term(make_problem(cloth), pos, torch.zeros_like(pos)))


@pytest.mark.parametrize("term", [Stretching(), Bending()], ids=["stretching", "bending"])
def test_contract(term):
    assert_internal_energy_contract(term)


def test_uniaxial_stretch_by_hand():
    """G = diag((s² - 1) / 2, 0), so the energy is A h (μ + λ/2) G₀₀²."""
    material = Material(lame_mu=20000.0, lame_lambda=40000.0, thickness=5e-4)
    mesh = grid(5, 4, 2.0)
    cloth = build_cloth(*mesh, material, dtype=F64)
    strain = 0.5 * (1.1**2 - 1)
    expected = 4.0 * 5e-4 * (20000.0 + 20000.0) * strain**2
    assert energy(Stretching(), cloth, mesh[0] * [1.1, 1, 1]) == pytest.approx(expected, rel=1e-12)


def test_shear_by_hand():
    """x += γ z: G₀₁ = γ/2 and G₁₁ = γ²/2."""
    mesh = grid(4, 4, 1.0)
    cloth = build_cloth(*mesh, Material(lame_mu=20000.0, lame_lambda=40000.0, thickness=1e-3), dtype=F64)
    shear = 0.2
    sheared = mesh[0].copy()
    sheared[:, 0] += shear * sheared[:, 2]
    square, trace = 2 * (shear / 2) ** 2 + (shear**2 / 2) ** 2, shear**2 / 2
    expected = 1e-3 * (20000.0 * square + 20000.0 * trace**2)
    assert energy(Stretching(), cloth, sheared) == pytest.approx(expected, rel=1e-12)


def test_stretching_counts_each_face_with_its_own_fabric():
    mesh = strip(3, 2.0, 1.0)
    mu = np.where(mesh[0][:, 0] > 1.5, 30000.0, 10000.0)
    cloth = build_cloth(*mesh, Material(lame_mu=mu, lame_lambda=0.0, thickness=1e-3), dtype=F64)
    strain = 0.5 * (1.1**2 - 1)
    expected = 1e-3 * float((cloth.rest_area * cloth.lame_mu).sum()) * strain**2
    assert energy(Stretching(), cloth, mesh[0] * [1.1, 1, 1]) == pytest.approx(expected, rel=1e-12)


def test_bending_of_one_hinge_by_hand():
    """Two right triangles over a unit edge: l₀ = 1, A₁ + A₂ = 1, so the energy is k θ² / 8."""
    pos = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-1, 0, 0.0]])
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    cloth = build_cloth(pos, faces, Material(bending_stiffness=0.02), dtype=F64)
    for angle in (1e-4, 0.7, 3.0, -2.0):
        folded = pos.copy()
        folded[3] = [-math.cos(angle), math.sin(angle), 0]
        assert energy(Bending(), cloth, folded) == pytest.approx(0.02 * angle**2 / 8, rel=1e-10)


def test_bending_measures_the_shorter_way_around():
    pos = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-math.cos(3.0), math.sin(3.0), 0.0]])
    cloth = build_cloth(pos, np.array([[0, 1, 2], [1, 0, 3]]), Material(bending_stiffness=0.02), dtype=F64)
    through = pos.copy()
    through[3] = [-math.cos(-3.0), math.sin(-3.0), 0]
    turn = 2 * math.pi - 6.0
    assert energy(Bending(), cloth, through) == pytest.approx(0.02 * turn**2 / 8, rel=1e-9)


def test_flat_rest_option_bends_a_tube_at_rest():
    mesh = cylinder()
    assert energy(Bending(), build_cloth(*mesh, Material(), dtype=F64), mesh[0]) < 1e-30
    assert energy(Bending(), build_cloth(*mesh, Material(), flat_rest=True, dtype=F64), mesh[0]) > 1e-6


def test_flipped_faces_on_a_flat_sheet_do_not_bend_in_float32():
    pos, faces = grid(8, 8)
    flipped = faces.copy()
    flipped[::7] = flipped[::7, ::-1]
    cloth = build_cloth(pos, flipped, Material())
    assert energy(Bending(), cloth, pos) == 0.0


def test_bending_gradient_of_tiny_edges_in_float32():
    pos, faces = grid(5, 5, 4e-4)
    state = fold(pos, 0.8)
    gradients = []
    for dtype in (torch.float32, F64):
        cloth = build_cloth(pos, faces, Material(), dtype=dtype)
        x = torch.as_tensor(state).to(dtype).requires_grad_(True)
        Bending()(make_problem(cloth), x, x).sum().backward()
        gradients.append(x.grad.double())
    torch.testing.assert_close(gradients[0], gradients[1], rtol=0, atol=1e-4 * float(gradients[1].abs().max()))

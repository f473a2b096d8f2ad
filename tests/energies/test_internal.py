import math

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.bending import Bending, CurrentLengthBending
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential
from hood.testing import assert_internal_energy_contract, cylinder, fold, grid, make_problem, strip

F64 = torch.float64


def energy(term, cloth, pos):
    pos = torch.as_tensor(pos).to(cloth.rest_pos)
    return float(term(make_problem(cloth), pos, torch.zeros_like(pos)))


@pytest.mark.parametrize(
    ("term", "limits"),
    [
        (Stretching(), {}),
        (Bending(), {"flipped_flat": 0.0}),
        (CurrentLengthBending(), {"flipped_flat": 0.0, "at_rest": math.inf}),  # its rest shape is flat
    ],
    ids=["stretching", "bending", "current length bending"],
)
def test_contract(term, limits):
    assert_internal_energy_contract(term, **limits)


def test_the_contract_notices_a_broken_energy():
    class Spring(Stretching):
        def __call__(self, problem, next_pos, acc):
            return super().__call__(problem, next_pos, acc) + 1e-6 * next_pos[:, 1].square().sum()

    with pytest.raises(AssertionError, match="rigid_energy|net_force|at_rest"):
        assert_internal_energy_contract(Spring())


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


def test_current_length_bending_of_one_hinge_by_hand():
    """As above with the edge stretched from 1 to s: k s² θ² / 8, from a rest angle that does not count."""
    pos = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-math.cos(0.4), math.sin(0.4), 0.0]])
    cloth = build_cloth(pos, np.array([[0, 1, 2], [1, 0, 3]]), Material(bending_stiffness=0.02), dtype=F64)
    for angle, stretch in ((1e-4, 1.0), (0.7, 1.3), (3.0, 0.8), (-2.0, 2.0)):
        folded = pos.copy()
        folded[1, 2] = stretch
        folded[3] = [-math.cos(angle), math.sin(angle), 0]
        assert energy(CurrentLengthBending(), cloth, folded) == pytest.approx(0.02 * stretch**2 * angle**2 / 8, rel=1e-10)
    assert energy(Bending(), cloth, pos) < 1e-30
    assert energy(CurrentLengthBending(), cloth, pos) == pytest.approx(0.02 * 0.4**2 / 8, rel=1e-10)


def test_both_bendings_agree_without_stretch_from_a_flat_rest_shape_only():
    pos, faces = grid(5, 4, 0.3)
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    folded = fold(pos, 1.1)
    assert energy(CurrentLengthBending(), cloth, folded) == pytest.approx(energy(Bending(), cloth, folded), rel=1e-12)
    stretched = folded * [1.0, 1.0, 1.5]  # along the fold: the angle stays
    assert energy(Bending(), cloth, stretched) == pytest.approx(energy(Bending(), cloth, folded), rel=1e-12)
    ratio = energy(CurrentLengthBending(), cloth, stretched) / energy(Bending(), cloth, stretched)
    assert ratio == pytest.approx(1.5**2, rel=1e-12)
    tube = cylinder()
    cloth = build_cloth(*tube, Material(), dtype=F64)
    assert energy(Bending(), cloth, tube[0]) < 1e-30
    flat_rest = build_cloth(*tube, Material(), flat_rest=True, dtype=F64)
    opening = energy(CurrentLengthBending(), cloth, tube[0])
    assert opening == pytest.approx(energy(Bending(), flat_rest, tube[0]), rel=1e-12)


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


@pytest.mark.parametrize("term", [Bending(), CurrentLengthBending()])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_flipped_faces_on_a_flat_sheet_do_not_bend(term, dtype):
    pos, faces = grid(8, 8)
    flipped = faces.copy()
    flipped[::7] = flipped[::7, ::-1]
    cloth = build_cloth(pos, flipped, Material(), dtype=dtype)
    assert energy(term, cloth, pos) == 0.0


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


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_slivers_flipped_faces_a_third_face_and_an_isolated_vertex_stay_finite(dtype):
    pos = np.array([[0, 0, 0], [0.1, 0, 0], [0.05, 0.05, 0], [0.05, -0.05, 0], [0.05, 0, 0.05], [0.05, 1e-8, -1e-8], [2, 2, 2]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4], [1, 0, 5]])
    with pytest.warns(UserWarning, match="face 3"):
        cloth = build_cloth(pos, faces, Material(bending_stiffness=1e-3), dtype=dtype)
    assert len(cloth.hinges) == 3  # four faces at the edge 0-1: a chain
    state = pos + 1e-3 * np.random.default_rng(0).normal(size=pos.shape)
    for term in (Stretching(), Bending(), CurrentLengthBending()):
        gradient, energies = Potential({"term": term}).gradient(make_problem(cloth), torch.as_tensor(state).to(dtype))
        assert bool(torch.isfinite(energies["term"]).all())
        assert bool(torch.isfinite(gradient).all())
        assert not bool(gradient[6].any())

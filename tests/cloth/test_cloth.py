"""The static cloth: rest quantities, what is refused, and what is legal by a stated rule."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import StepInput
from hood.energies.potential import default_potential
from hood.testing import cylinder, grid, make_problem


def test_masses_and_areas_of_a_square() -> None:
    cloth = build_cloth(*grid(6, 6, 0.5), Material(density=0.2), dtype=torch.float64)
    assert float(cloth.rest_area.sum()) == pytest.approx(0.25)
    assert float(cloth.mass.sum()) == pytest.approx(0.05)
    assert int(cloth.free.sum()) == 36
    # Every interior edge is a hinge.
    assert len(cloth.hinges) == len(cloth.edges) - 4 * 5


def test_piecewise_fabric_stays_on_its_side() -> None:
    pos, faces = grid(7, 4, 0.6)
    left = pos[:, 0] < 0.25
    material = Material(
        density=np.where(left, 0.1, 0.4),
        lame_mu=np.where(left, 2e4, 6e4),
        bending_stiffness=np.where(left, 1e-6, 1e-4),
    )
    cloth = build_cloth(pos, faces, material, dtype=torch.float64)
    side = torch.as_tensor(left)
    count = side[cloth.faces].sum(dim=1)
    for side_count, density, mu in ((3, 0.1, 2e4), (0, 0.4, 6e4)):
        rows = count == side_count
        assert bool(rows.any())
        assert cloth.density[rows].unique().tolist() == pytest.approx([density])
        assert cloth.lame_mu[rows].unique().tolist() == pytest.approx([mu])
    border = (count > 0) & (count < 3)
    assert bool(((cloth.density[border] > 0.1) & (cloth.density[border] < 0.4)).all())
    stiff = cloth.bending_stiffness[~side[cloth.hinges[:, :2]].any(dim=1)]
    assert stiff.unique().tolist() == pytest.approx([1e-4])
    assert cloth.vertex_fabric[:, 0].tolist() == pytest.approx(np.where(left, 2e4, 6e4).tolist())
    ends = torch.as_tensor(material.lame_mu)[cloth.edges].mean(dim=1)
    torch.testing.assert_close(cloth.edge_fabric[:, 0], ends)
    # The heavy side weighs more.
    assert float(cloth.mass[~side].sum()) > 2 * float(cloth.mass[side].sum())


def test_flat_rest_forgets_the_rest_angles() -> None:
    mesh = cylinder(8, 4)
    bent, flat = (build_cloth(*mesh, Material(), flat_rest=value) for value in (False, True))
    assert float(bent.rest_angle.abs().max()) > 0.1
    assert not bool(flat.rest_angle.any())


def test_pinned_and_isolated_vertices_are_not_free() -> None:
    pos, faces = grid(3, 3, 0.2)
    pos = np.concatenate([pos, [[5.0, 5.0, 5.0]]])
    pinned = np.zeros(10, dtype=bool)
    pinned[:3] = True
    cloth = build_cloth(pos, faces, Material(), pinned)
    assert float(cloth.mass[9]) == 0.0
    assert cloth.free.tolist() == [False] * 3 + [True] * 6 + [False]


def test_rest_quantities_are_computed_in_float64() -> None:
    """A garment far from the origin keeps its areas to float32's own precision."""
    pos, faces = grid(5, 5, 0.1)
    near, far = (build_cloth(p, faces, Material()) for p in (pos, pos + 1000.0))
    for name in ("rest_area", "rest_inverse", "mass", "hinge_rest_length", "hinge_area"):
        torch.testing.assert_close(getattr(far, name), getattr(near, name), rtol=1e-6, atol=1e-6)
    assert near.mass.dtype == torch.float32


def test_cloth_is_frozen() -> None:
    cloth = build_cloth(*grid(3, 3), Material())
    with pytest.raises(AttributeError):
        cloth.num_scenes = 2  # type: ignore[misc]
    assert replace(cloth, num_scenes=2).num_scenes == 2


SQUARE = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [1, 0, 1.0]])
HALVES = np.array([[0, 1, 2], [1, 3, 2]])


@pytest.mark.parametrize(
    "pos, faces, message",
    [
        (SQUARE, [[0, 1, 2], [1, 3, 3]], r"face 1 repeats a vertex \(\[1, 3, 3\]\); remove"),
        (SQUARE, [[0, 1, 2], [1, 3, 4]], r"face 1 refers to vertices \[1, 3, 4\].*from 0 to 3"),
        (SQUARE, [[0, 1, 2], [1, 3, -1]], r"face 1 refers to vertices \[1, 3, -1\].*from 0 to 3"),
        (SQUARE, [[0, 1, 2], [2, 0, 1]], r"face 1 duplicates face 0.*remove one"),
        (SQUARE, [[0, 1, 2], [2, 1, 0]], r"face 1 duplicates face 0.*remove one"),
        (SQUARE * [1, 1, 0], HALVES, r"face 0 has zero rest area \(vertices \[0, 1, 2\]\); merge"),
        (np.where(np.arange(12).reshape(4, 3) == 7, np.nan, SQUARE), HALVES, r"vertex 2 is \[1.0, nan, 0.0\].*finite"),
        (np.zeros((0, 3)), np.zeros((0, 3), dtype=int), r"empty \(0 vertices, 0 faces\)"),
        (SQUARE, np.zeros((0, 3), dtype=int), r"empty \(4 vertices, 0 faces\)"),
        (SQUARE, [[0, 1, 3, 2]], "4 corners"),
        (SQUARE, [[0.0, 1.0, 2.0]], "float64; give integers"),
        (SQUARE[:, :2], HALVES, r"shape \(4, 2\)"),
    ],
)
def test_meshes_that_cannot_be_simulated_are_refused(pos: np.ndarray, faces: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match="cloth: .*" + message):
        build_cloth(pos, np.asarray(faces), Material())


@pytest.mark.parametrize(
    "pinned", [np.ones(3, bool), np.ones((4, 1), bool), np.array([0, 3]), np.array([0, 1, 2, 3]), np.full(4, 0.5)]
)
def test_a_pin_mask_that_does_not_fit_is_refused(pinned: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"pinned has shape .* one bool per vertex, \(4,\) .*mask\[indices\] = True"):
        build_cloth(SQUARE, HALVES, Material(), pinned)


def test_a_pin_mask_of_zeros_and_ones_will_do() -> None:
    assert build_cloth(SQUARE, HALVES, Material(), np.array([0, 1, 1, 0])).pinned.tolist() == [False, True, True, False]


@pytest.mark.parametrize("aspect", [1e3, 1e5, 1e7])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_slivers_are_warned_about_and_stay_finite(aspect: float, dtype: torch.dtype) -> None:
    pos = np.concatenate([SQUARE, [[0.5, 0.0, 1.0 + 1.01 / aspect if aspect == 1e3 else 1.0 + 1.0 / aspect]]])
    faces = np.concatenate([HALVES, [[1, 3, 4]]])
    if aspect > 1e3:
        with pytest.warns(UserWarning, match=r"face 2 \(vertices \[1, 3, 4\]\).*remesh"):
            cloth = build_cloth(pos, faces, Material(), dtype=dtype)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            cloth = build_cloth(pos, faces, Material(), dtype=dtype)
    assert float(cloth.rest_area[2]) > 0
    problem = make_problem(cloth)
    for state in (cloth.rest_pos, cloth.rest_pos * 1.1, cloth.rest_pos * torch.tensor([1.0, 1.0, 0.0])):
        gradient, energies = default_potential().gradient(problem, state.to(dtype))
        assert bool(torch.isfinite(gradient).all())
        assert all(bool(torch.isfinite(energy).all()) for energy in energies.values())


def test_three_faces_at_an_edge_make_a_chain_of_hinges() -> None:
    pos = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0.0]])
    cloth = build_cloth(pos, np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]]), Material())
    assert cloth.hinges.tolist() == [[0, 1, 2, 3], [0, 1, 3, 4]]
    assert cloth.rest_angle.abs().tolist() == pytest.approx([0.0, np.pi / 2])


def test_time_steps_that_are_none_are_refused() -> None:
    for dt, scene in (([0.0], 0), ([1 / 30, -1.0], 1), ([1 / 30, 1 / 30, float("nan")], 2), ([float("inf")], 0)):
        with pytest.raises(ValueError, match=f"dt of scene {scene} is .*seconds > 0 per scene"):
            StepInput(dt=torch.tensor(dt))
    with pytest.raises(ValueError, match="per scene, shape"):
        StepInput(dt=torch.tensor(1 / 30))
    problem = make_problem(build_cloth(SQUARE, HALVES, Material()))
    with pytest.raises(ValueError, match="dt has 2 entries for 1 scenes"):
        replace(problem, step=StepInput(dt=torch.full((2,), 1 / 30)))


def test_edges_that_were_first_asked_for_without_gradients_can_be_followed_later() -> None:
    pos, faces = grid(3, 3, 0.1)
    cloth = build_cloth(pos, faces, Material())
    with torch.inference_mode():
        cloth.edge_sq(cloth.rest_pos)
    here = cloth.rest_pos.clone().requires_grad_()
    cloth.edge_sq(here).sum().backward()
    assert here.grad is not None

"""The barrier between layers of cloth."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, has_layers, without_layers
from hood.testing import grid, make_problem, random_rotation

pytestmark = pytest.mark.usefixtures("compiled_layers")

F64 = torch.float64


def _two_sheets(gap: float = 0.0015, seed: int = 0) -> StepProblem:
    pos, faces = grid(6, 6, 0.2)
    rest, both = np.concatenate([pos, pos + [0.0, 0.1, 0.0]]), np.concatenate([faces, faces + len(pos)])
    noise = 3e-4 * np.random.default_rng(seed).normal(size=rest.shape)
    near = np.concatenate([pos, pos + [0.011, gap, 0.007]]) + noise
    return make_problem(build_cloth(rest, both, Material(), dtype=F64), near)


def _alone(term: LayerBarrier, problem: StepProblem, pos: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    potential = Potential({"layers": term})
    gradient, energies = potential.gradient(potential.prepare(problem), pos)
    return energies["layers"], gradient


def test_gradient_is_that_of_the_energy() -> None:
    problem, term = _two_sheets(), LayerBarrier()
    prepared = term.prepare(problem)
    pos = problem.state.pos
    energy, gradient = _alone(term, prepared, pos)
    assert float(energy) > 0
    rng = np.random.default_rng(1)
    for _ in range(5):
        way = torch.as_tensor(rng.normal(size=pos.shape))
        ends = [float(term(prepared, pos + sign * 1e-7 * way, pos)) for sign in (1.0, -1.0)]
        slope = float((gradient * way).sum())
        assert (ends[0] - ends[1]) / 2e-7 == pytest.approx(slope, rel=1e-5, abs=1e-8)


def test_compiled_energy_and_gradient_are_those_of_the_term() -> None:
    problem, term = _two_sheets(), LayerBarrier()
    energy, gradient = _alone(term, problem, problem.state.pos)
    layers = term.prepare(problem).layers[0].layers
    assert layers.energy(problem.state.pos.numpy()) == pytest.approx(float(energy), rel=1e-12)
    slope, rows, corners, own = layers.model(problem.state.pos.numpy())
    np.testing.assert_allclose(slope, gradient.numpy(), atol=1e-12)
    blocks = np.zeros((len(slope), 3, 3))
    np.add.at(blocks, corners.reshape(-1), rows.reshape(-1, 3)[:, :, None] * rows.reshape(-1, 3)[:, None, :])
    upper = blocks[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(own, upper, rtol=1e-10, atol=1e-10 * np.abs(upper).max())


def test_rigid_motion_changes_nothing_and_no_net_force_or_torque_remains() -> None:
    problem, term = _two_sheets(), LayerBarrier()
    pos = problem.state.pos
    energy, gradient = _alone(term, problem, pos)
    turn, shift = torch.as_tensor(random_rotation(np.random.default_rng(2))), torch.tensor([0.3, -0.2, 0.1], dtype=F64)
    moved = pos @ turn.T + shift
    there = make_problem(problem.cloth, moved)
    turned_energy, turned_gradient = _alone(term, there, moved)
    torch.testing.assert_close(turned_energy, energy, rtol=1e-9, atol=0.0)
    torch.testing.assert_close(turned_gradient, gradient @ turn.T, rtol=0.0, atol=1e-8 * float(gradient.abs().max()))
    size = float(gradient.abs().sum())
    assert float(gradient.sum(0).norm()) < 1e-13 * size
    assert float(torch.linalg.cross(pos, gradient).sum(0).norm()) < 1e-12 * size


def test_energy_does_not_depend_on_where_the_list_was_made() -> None:
    """A sum over all pairs, whatever the positions before: a pure function of the next positions."""
    problem, term = _two_sheets(), LayerBarrier()
    prepared = term.prepare(problem)
    far = (
        problem.state.pos + torch.tensor([0.0, 1.0, 0.0], dtype=F64) * torch.linspace(0.0, 0.1, len(problem.state.pos))[:, None]
    )
    term(prepared, far, far)
    again = float(term(prepared, problem.state.pos, far))
    assert again == pytest.approx(float(_alone(term, problem, problem.state.pos)[0]), rel=1e-12)


def test_parallel_edges_fade_smoothly() -> None:
    """Energy and force are continuous where crossing edges become parallel."""
    pos = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, -0.1, -0.1], [0, 0.001, 0], [0.1, 0.001, 0], [0, 0.1, 0.1]])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    problem = make_problem(cloth, pos)
    term = LayerBarrier()
    prepared = term.prepare(problem)
    forces = []
    for angle in (-1e-7, 0.0, 1e-7):
        turned = problem.state.pos.clone()
        turned[4, 2] += 0.1 * angle
        forces.append(_alone(term, prepared, turned)[1])
    scale = float(forces[1].abs().max())
    assert scale > 0
    assert float((forces[0] - forces[2]).abs().max()) < 1e-3 * scale


def test_nothing_at_rest_and_nothing_between_scenes() -> None:
    problem = _two_sheets()
    term = LayerBarrier()
    rest = make_problem(problem.cloth)
    assert float(_alone(term, rest, rest.state.pos)[0]) == 0.0
    both = concatenate_cloths([problem.cloth, problem.cloth])
    pos = torch.cat([problem.state.pos] * 2)
    energy, gradient = _alone(term, make_problem(both, pos), pos)
    one, slope = _alone(term, problem, problem.state.pos)
    torch.testing.assert_close(energy, torch.cat([one, one]), rtol=1e-12, atol=0.0)
    torch.testing.assert_close(gradient, torch.cat([slope, slope]), rtol=0.0, atol=1e-12)


def test_between_pieces_alone() -> None:
    pos, faces = grid(8, 3, 1.0)
    flat = pos * np.array([0.4, 1.0, 0.1])
    folded = flat.copy()
    over = flat[:, 0] > 0.2
    folded[over] = np.stack([0.4 - flat[over, 0], np.full(over.sum(), 0.001), flat[over, 2]], axis=1)
    problem = make_problem(build_cloth(flat, faces, Material(), dtype=F64), folded)
    assert float(_alone(LayerBarrier(), problem, problem.state.pos)[0]) > 0.0
    assert float(_alone(LayerBarrier(between=True), problem, problem.state.pos)[0]) == 0.0


def test_values_are_checked_and_layers_must_be_searched_for() -> None:
    with pytest.raises(ValueError, match="reach is 0"):
        LayerBarrier(reach=0.0)
    problem = _two_sheets()
    with pytest.raises(ValueError, match=r"Potential\.prepare"):
        default_potential().with_terms(layers=LayerBarrier()).total(problem.with_contact(), problem.state.pos)


def test_potential_without_its_layers() -> None:
    plain = default_potential()
    assert without_layers(plain) is plain
    both = plain.with_terms(layers=LayerBarrier())
    assert has_layers(both)
    assert not has_layers(without_layers(both))
    assert list(without_layers(both).terms) == list(plain.terms)


@pytest.mark.parametrize(("gap", "rests"), [(0.0015, False), (0.02, True)])
def test_layers_pull_where_they_are_near(gap: float, rests: bool) -> None:
    """Where none is, the term is not asked: what it would add is nothing."""
    near, term = _two_sheets(gap), LayerBarrier()
    prepared = term.prepare(near)
    assert term.is_inactive(prepared) == rests
    _, gradient = _alone(term, prepared, near.state.pos)
    assert bool((gradient == 0.0).all()) == rests
    assert term.is_zero(prepared, near.state.pos) == rests
    assert not term.is_zero(prepared, torch.full_like(near.state.pos, torch.nan))
    with pytest.raises(ValueError, match="layers not searched for yet"):
        Potential({"layers": term}).energies(near, near.state.pos)
    assert not term.is_inactive(near)

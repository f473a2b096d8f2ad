"""Cloth kept on the side of other cloth that it is on at t."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.app.settings.compose import build, load_config
from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.contact.self_contact import find_sides
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, SignedSelfContactPenalty, for_networks
from hood.solver.newton import minimize
from hood.tensors.batch import to_device
from hood.testing import cylinder, grid, make_problem, random_rotation

F64 = torch.float64
UP = torch.tensor([0.0, 1.0, 0.0], dtype=F64)


def two_sheets(gap: float = 0.005, noise: float = 3e-4, seed: int = 0) -> StepProblem:
    """A sheet of 36 vertices and another one ``gap`` [m] over it."""
    pos, faces = grid(6, 6, 0.2)
    rest, both = np.concatenate([pos, pos + [0.0, 0.1, 0.0]]), np.concatenate([faces, faces + len(pos)])
    near = np.concatenate([pos, pos + [0.011, gap, 0.007]])
    near = near + noise * np.random.default_rng(seed).normal(size=rest.shape)
    return make_problem(build_cloth(rest, both, Material(), dtype=F64), near)


def lowered(problem: StepProblem, by: float) -> torch.Tensor:
    """The start with the upper sheet moved down."""
    upper = (torch.arange(problem.cloth.num_vertices) >= 36).to(F64)
    return problem.state.pos - by * upper[:, None] * UP


def forces(term: SignedSelfContactPenalty, problem: StepProblem, pos: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Energy (B,) and gradient (V, 3)."""
    potential = Potential({"sides": term})
    gradient, energies = potential.gradient(potential.prepare(problem), pos)
    return energies.get("sides", torch.zeros(problem.num_scenes, dtype=pos.dtype)), gradient


@pytest.mark.parametrize("by", [0.003, 0.008])
def test_gradient_is_that_of_the_energy(by: float) -> None:
    problem, term = two_sheets(), SignedSelfContactPenalty()
    prepared, pos = term.prepare(problem), lowered(two_sheets(), by).requires_grad_(True)
    assert float(term(prepared, pos, pos).detach()) > 0
    assert torch.autograd.gradcheck(lambda x: term(prepared, x, x), (pos,), eps=1e-7, atol=1e-6)


def test_nothing_is_felt_apart_and_along_a_sheet_at_rest() -> None:
    problem = two_sheets()
    assert float(forces(SignedSelfContactPenalty(), problem, problem.state.pos)[0]) == 0
    assert float(forces(SignedSelfContactPenalty(), problem, lowered(problem, -0.05))[1].abs().max()) == 0
    assert len(find_sides(problem.cloth, lowered(problem, -0.05), 0.02).vertex) == 0
    tube, faces = cylinder(around=40, rows=30, radius=0.03, height=0.2)  # edges of 5 mm, well within the reach
    cloth = build_cloth(tube, faces, Material(), dtype=F64)
    pairs = find_sides(cloth, cloth.rest_pos, 0.02)
    assert len(pairs.vertex) == 0


def test_crossed_cloth_is_pushed_back_however_deep() -> None:
    problem, before = two_sheets(), 0.0
    for by in (0.004, 0.006, 0.012, 0.03):
        pos = lowered(problem, by)
        energy, gradient = forces(SignedSelfContactPenalty(), problem, pos)
        assert float(energy) > before
        before = float(energy)
        # Down the slope the upper sheet goes up, and the lower one down.
        assert float(-(gradient[36:] @ UP).sum()) > 0
        assert float(-(gradient[:36] @ UP).sum()) < 0


def test_sides_are_those_at_t_in_every_position() -> None:
    problem = two_sheets()
    over, under = (
        SignedSelfContactPenalty().prepare(problem),
        SignedSelfContactPenalty().prepare(make_problem(problem.cloth, lowered(problem, 0.01))),
    )
    assert over.sides is not None
    assert under.sides is not None
    normal_up = over.sides.side[over.sides.vertex >= 36]
    normal_down = under.sides.side[under.sides.vertex >= 36]
    assert len(normal_up) >= 25
    assert len(normal_down) >= 25
    assert normal_up.abs().min() == 1
    assert float(normal_up.mean()) == -float(normal_down.mean())
    term = SignedSelfContactPenalty()
    assert float(term(under, lowered(problem, 0.01), problem.state.pos)) == 0  # crossed at t: stays so
    assert float(term(over, lowered(problem, 0.01), problem.state.pos)) > 0
    assert float(term(under, problem.state.pos, problem.state.pos)) > 0


def test_cloth_beyond_a_rim_has_no_side() -> None:
    pos, faces = grid(6, 6, 0.2)
    rest, both = np.concatenate([pos, pos + [0.0, 0.1, 0.0]]), np.concatenate([faces, faces + len(pos)])
    cloth = build_cloth(rest, both, Material(), dtype=F64)
    beside = torch.as_tensor(np.concatenate([pos, pos + [0.212, 0.005, 0.0]]))  # 12 mm beside, 5 mm above
    assert len(find_sides(cloth, beside, 0.02).vertex) == 0


def test_one_sheet_folded_has_sides_against_itself() -> None:
    pos, faces = grid(11, 4, 0.3)
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    bend = np.stack(
        [np.where(pos[:, 0] > 0.15, 0.3 - pos[:, 0], pos[:, 0]), np.where(pos[:, 0] > 0.15, 0.01, 0.0), pos[:, 2]], 1
    )
    pairs = find_sides(cloth, torch.as_tensor(bend), 0.02)
    far = (torch.as_tensor(pos)[pairs.vertex, 0] - torch.as_tensor(pos)[pairs.corners[:, 0], 0]).abs() > 0.07
    assert int(far.sum()) >= 20


def test_rigid_motion_changes_nothing_and_no_net_force_or_torque_remains() -> None:
    problem, term = two_sheets(), SignedSelfContactPenalty()
    pos = lowered(problem, 0.006)
    energy, gradient = forces(term, problem, pos)
    turn, shift = torch.as_tensor(random_rotation(np.random.default_rng(2))), torch.tensor([0.3, -0.2, 0.1], dtype=F64)
    there = make_problem(problem.cloth, problem.state.pos @ turn.T + shift)
    turned_energy, turned_gradient = forces(term, there, pos @ turn.T + shift)
    torch.testing.assert_close(turned_energy, energy, rtol=1e-8, atol=0.0)
    torch.testing.assert_close(turned_gradient, gradient @ turn.T, rtol=0.0, atol=1e-7 * float(gradient.abs().max()))
    size = float(gradient.abs().sum())
    assert float(gradient.sum(0).norm()) < 1e-12 * size
    assert float(torch.linalg.cross(pos, gradient).sum(0).norm()) < 1e-11 * size


def test_a_batch_is_its_scenes() -> None:
    first, second = two_sheets(seed=1), two_sheets(gap=0.004, seed=2)
    batch = make_problem(concatenate_cloths([first.cloth, second.cloth]), torch.cat([first.state.pos, second.state.pos]))
    ends = [lowered(first, 0.006), lowered(second, 0.006)]
    energy, gradient = forces(SignedSelfContactPenalty(), batch, torch.cat(ends))
    alone = [forces(SignedSelfContactPenalty(), problem, pos) for problem, pos in zip((first, second), ends, strict=True)]
    torch.testing.assert_close(energy, torch.cat([one for one, _ in alone]))
    torch.testing.assert_close(gradient, torch.cat([one for _, one in alone]))
    assert float(energy.min()) > 0


def test_faces_without_an_area_leave_it_finite() -> None:
    problem = two_sheets()
    energy, gradient = forces(SignedSelfContactPenalty(), problem, torch.zeros_like(problem.state.pos))
    assert bool(torch.isfinite(energy).all())
    assert bool(torch.isfinite(gradient).all())


def test_a_config_has_it_off_and_turns_it_on() -> None:
    assert "layer_sides" not in build(load_config("train").losses).terms
    asked = build(load_config("train", ["losses.terms.layer_sides.weight=1e6"]).losses)
    assert asked.settings["layer_sides"]["weight"] == 1e6
    assert set(for_networks(asked.with_terms(layers=LayerBarrier())).terms) == set(default_potential().terms)
    with pytest.raises(ValueError, match="0 < epsilon <= reach"):
        SignedSelfContactPenalty(epsilon=0.03)


def test_the_solver_refuses_it() -> None:
    problem = two_sheets()
    with pytest.raises(ValueError, match=r"losses.terms.layer_sides is for training.*cloth_contact=on"):
        minimize(default_potential().with_terms(layer_sides=SignedSelfContactPenalty()), problem)


@pytest.mark.gpu
def test_the_same_on_a_gpu() -> None:
    problem, term = two_sheets(), SignedSelfContactPenalty()
    pos = lowered(problem, 0.006)
    there = replace(problem, cloth=to_device(problem.cloth, "cuda"), state=to_device(problem.state, "cuda"))
    there = replace(there, step=to_device(problem.step, "cuda"))
    energy, gradient = forces(term, problem, pos)
    other_energy, other_gradient = forces(term, there, pos.cuda())
    torch.testing.assert_close(other_energy.cpu(), energy)
    torch.testing.assert_close(other_gradient.cpu(), gradient)

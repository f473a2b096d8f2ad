"""Friction between layers of cloth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from layer_scenes import sheet_on_slope, stack

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, LayerFriction, barrier_force, without_layers
from hood.solver.newton import NewtonSettings, minimize
from hood.steppers.newton import implicit_euler
from hood.testing import grid, make_problem

pytestmark = pytest.mark.usefixtures("compiled_layers")

F64 = torch.float64
POTENTIAL = default_potential().with_terms(layers=LayerBarrier(), layer_friction=LayerFriction())


def _two_sheets(gap: float = 0.0015, closing: float = 0.0) -> StepProblem:
    """Sheets over each other, the upper one on its way down with ``closing`` m/s."""
    pos, faces = grid(6, 6, 0.2)
    rest, both = np.concatenate([pos, pos + [0.0, 0.1, 0.0]]), np.concatenate([faces, faces + len(pos)])
    noise = 1e-4 * np.random.default_rng(0).normal(size=rest.shape)
    near = np.concatenate([pos, pos + [0.011, gap, 0.007]]) + noise
    vel = np.zeros_like(near)
    vel[len(pos) :, 1] = -closing
    return make_problem(build_cloth(rest, both, Material(), dtype=F64), near, vel)


def _slid(problem: StepProblem, way: float = 2e-4) -> torch.Tensor:
    pos = problem.state.pos.clone()
    half = len(pos) // 2
    pos[half:] += way * torch.tensor([0.8, 0.1, 0.6], dtype=F64)
    return pos + 1e-5 * torch.as_tensor(np.random.default_rng(1).normal(size=pos.shape))


@pytest.mark.parametrize("way", [0.0, 5e-5, 2e-4, 1e-3])
def test_gradient_is_that_of_the_energy(way: float) -> None:
    term, problem = LayerFriction(), POTENTIAL.prepare(_two_sheets(closing=0.2))
    alone, pos = Potential({"friction": term}), _slid(problem, way)
    gradient, energies = alone.gradient(problem, pos)
    assert float(energies["friction"]) > 0
    rng = np.random.default_rng(2)
    for _ in range(3):
        along = torch.as_tensor(rng.normal(size=pos.shape))
        ends = [float(term(problem, pos + sign * 1e-8 * along, pos)) for sign in (1.0, -1.0)]
        slope = float((gradient * along).sum())
        assert (ends[0] - ends[1]) / 2e-8 == pytest.approx(slope, rel=1e-5, abs=1e-9 * float(gradient.abs().sum()))


def test_no_net_force_and_no_torque_but_that_of_the_gap() -> None:
    term, problem = LayerFriction(), POTENTIAL.prepare(_two_sheets(closing=0.2))
    pos = _slid(problem)
    gradient, _ = Potential({"friction": term}).gradient(problem, pos)
    size = float(gradient.abs().sum())
    assert size > 0
    assert float(gradient.sum(0).norm()) < 1e-13 * size
    grips = term.grips(problem)
    reach = float((grips.weights.unsqueeze(2) * pos[grips.corners]).sum(1).norm(dim=1).max())
    assert float(torch.linalg.cross(pos, gradient).sum(0).norm()) <= float(grips.force.sum()) * reach


def test_force_is_against_the_slip_and_never_above_the_coefficient() -> None:
    problem = POTENTIAL.prepare(_two_sheets(closing=0.2))
    term = LayerFriction(0.3)
    pos = _slid(problem, 5e-3)
    gradient, _ = Potential({"friction": term}).gradient(problem, pos)
    pull = gradient[len(pos) // 2 :].sum(0)
    normal = float(term.grips(problem).force.sum()) / 0.3
    assert float(pull @ torch.tensor([0.8, 0.0, 0.6], dtype=F64)) == pytest.approx(0.3 * normal, rel=0.02)


def test_scenes_of_a_batch_do_not_touch() -> None:
    one, term = _two_sheets(closing=0.2), LayerFriction()
    both = concatenate_cloths([one.cloth, one.cloth])
    pair = make_problem(both, torch.cat([one.state.pos] * 2), torch.cat([one.state.vel] * 2))
    pos = _slid(one)
    energy = term(POTENTIAL.prepare(one), pos, pos)
    twice = torch.cat([pos] * 2)
    torch.testing.assert_close(term(POTENTIAL.prepare(pair), twice, twice), torch.cat([energy] * 2))


def test_barrier_force_is_the_slope_of_the_barrier() -> None:
    share = torch.linspace(0.01, 0.99, 50, dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(((1.0 - share) ** 2 * -share.log()).sum(), share)
    torch.testing.assert_close(barrier_force(share.detach()), -slope)


def test_layers_that_lie_still_are_pressed_with_the_weight_above_them() -> None:
    count = 4
    *_, last = implicit_euler(POTENTIAL, stack(1 / 30, n=4, count=count), 40, NewtonSettings(target_rg=1e-5))
    assert float(last.state.vel.norm(dim=1).max()) < 0.01
    problem = POTENTIAL.prepare(replace(last.problem, state=last.state, contact=None, internal_force=None, layers=()))
    grips = LayerFriction(1.0).grips(problem)
    sheet = float(problem.cloth.mass.sum()) * 9.81 / count
    above = sum(range(1, count))  # sheets above a gap, of all gaps
    assert float((grips.force * grips.normal[:, 1].abs()).sum()) == pytest.approx(above * sheet, rel=0.05)


def test_features_that_nearly_touch_do_not_grip_without_bound() -> None:
    """At rest in the air half a millimetre apart: their barrier throws them apart, and then nothing presses."""
    near = POTENTIAL.prepare(_two_sheets(gap=5e-4))
    sheet = float(near.cloth.mass.sum()) / 2
    barrier, _ = Potential({"layers": LayerBarrier()}).gradient(near, near.state.pos)
    assert float(barrier[:36, 1].sum()) > 10 * 9.81 * sheet
    inertia = sheet * 900 * 3e-3  # what takes a sheet from one side of the reach to the other in a step
    assert 0.0 < float(LayerFriction(1.0).grips(near).force.sum()) < inertia


@pytest.mark.parametrize("engine", ["compiled", "torch"])
def test_sheet_sticks_below_the_angle_of_friction(engine: str) -> None:
    """At 20° with μ = 0.5 it creeps, at most by the speed of slip."""
    problem, first, down = sheet_on_slope(1 / 60, 20.0)
    *_, last = implicit_euler(POTENTIAL, problem, 12, NewtonSettings(engine=engine))
    assert bool(last.report.converged.all())
    speed = float((last.state.vel[first:].mean(0) * torch.as_tensor(down)).sum())
    assert 0.0 < speed < 5e-3


@pytest.mark.parametrize(("coefficient", "degrees"), [(0.0, 20.0), (0.5, 40.0), (0.2, 40.0)])
def test_sheet_slides_above_it_with_what_is_left_of_gravity(coefficient: float, degrees: float) -> None:
    problem, first, down = sheet_on_slope(1 / 60, degrees)
    potential = POTENTIAL.with_terms(layer_friction=LayerFriction(coefficient))
    speeds = [
        float((m.state.vel[first:].mean(0) * torch.as_tensor(down)).sum()) for m in implicit_euler(potential, problem, 18)
    ]
    turn = np.deg2rad(degrees)
    expected = 9.81 * (np.sin(turn) - coefficient * np.cos(turn))
    assert (speeds[-1] - speeds[5]) * 60 / 12 == pytest.approx(expected, rel=0.05)


def test_compiled_and_torch_reach_the_same_minimum() -> None:
    *_, before = implicit_euler(POTENTIAL, stack(1 / 30, n=4, count=4), 4)
    problem = POTENTIAL.prepare(replace(before.problem, state=before.state, contact=None, internal_force=None, layers=()))
    ends = []
    for engine in ("compiled", "torch"):
        pos, report = minimize(POTENTIAL, problem, settings=NewtonSettings(target_rg=1e-6, engine=engine))
        assert bool(report.converged.all())
        energies = POTENTIAL.energies(problem, pos)
        assert float(energies["layer_friction"]) > 0
        assert float(report.phi) == pytest.approx(float(sum(energies.values())), rel=1e-9)
        ends.append((pos, float(report.phi)))
    assert ends[0][1] == pytest.approx(ends[1][1], rel=1e-9, abs=1e-12)
    torch.testing.assert_close(ends[0][0], ends[1][0], rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("engine", ["compiled", "torch"])
def test_without_pairs_steps_are_to_the_bit_those_without(engine: str) -> None:
    problem, settings = stack(1 / 30, n=5, count=1), NewtonSettings(engine=engine)
    steps = zip(
        implicit_euler(POTENTIAL, problem, 3, settings), implicit_euler(default_potential(), problem, 3, settings), strict=True
    )
    for one, other in steps:
        assert torch.equal(one.state.pos, other.state.pos)


def test_values_are_checked_and_layers_must_be_searched_for() -> None:
    with pytest.raises(ValueError, match="coefficient is -1"):
        LayerFriction(-1.0)
    with pytest.raises(ValueError, match="add a LayerBarrier"):
        default_potential().with_terms(layer_friction=LayerFriction()).prepare(_two_sheets())
    with pytest.raises(ValueError, match=r"Potential\.prepare"):
        LayerFriction().applies(LayerBarrier().prepare(_two_sheets()))
    assert list(without_layers(POTENTIAL).terms) == list(default_potential().terms)

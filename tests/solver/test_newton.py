"""Projected Newton: right minimum, right physics, nothing silent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import optimize

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Attachments, State, StepInput, concatenate_states
from hood.energies.potential import Potential, default_potential, relative_gradient
from hood.energies.problem import StepProblem, inertial_guess
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system import linear
from hood.solver.system.sparsity import Scatter
from hood.tensors.batch import to_device
from hood.testing import concatenate_contacts, cylinder, grid, make_problem, plane_contact, strip

F64 = torch.float64
TIGHT = NewtonSettings(target_rg=1e-8, max_iterations=60, cg_iterations=300)
LINEAR = ("cg", "direct")


def hanging(n=7, m=6, dtype=F64, dt=1 / 30, material=None, size=0.3):
    """A sheet held along one side, swinging down from level."""
    pos, faces = grid(n, m, size)
    cloth = build_cloth(pos, faces, material or Material(), np.arange(n * m) < m, dtype=dtype)
    return make_problem(cloth, dt=dt)


def falling(height=0.01, contact=True, dtype=F64, material=None, dt=1 / 30):
    """A slightly wavy sheet over the plane y = 0."""
    pos, faces = grid(6, 6, 0.25)
    pos[:, 1] += height + 0.002 * np.sin(20 * pos[:, 0]) * np.cos(15 * pos[:, 2])
    cloth = build_cloth(pos, faces, material or Material(), dtype=dtype)
    return make_problem(cloth, dt=dt, contact=plane_contact(cloth.rest_pos) if contact else None)


def batch(problems):
    contact = concatenate_contacts([p.contact for p in problems])
    return StepProblem(
        concatenate_cloths([p.cloth for p in problems]),
        concatenate_states([p.state for p in problems]),
        StepInput(dt=torch.cat([p.step.dt for p in problems])),
        contact,
        problems[0].gravity,
    )


def pieces():
    """Three garments of different size, time step and height."""
    second = build_cloth(*cylinder(6, 4, 0.1, 0.2), Material(density=0.1), dtype=F64)
    second = make_problem(second, second.rest_pos + 0.01, dt=1 / 60, contact=plane_contact(second.rest_pos, height=-0.05))
    return [falling(), second, falling(0.004, dt=1 / 120)]


@pytest.mark.parametrize("linear", LINEAR)
def test_hanging_grid_converges_and_reports_it(linear):
    problem = hanging()
    start = inertial_guess(problem.state, problem.step)
    pos, report = minimize(default_potential(), problem, start, replace(TIGHT, target_rg=1e-6, linear=linear))
    assert report.converged.all()
    assert report.reason == ("",)
    gradient, energies = default_potential().gradient(problem, pos, report.acc)
    assert float(relative_gradient(problem, gradient)) <= 1e-6
    assert float(report.phi) == pytest.approx(float(sum(energies.values())), rel=1e-12)
    assert len(report.history) == report.iterations + 1
    phi = [float(progress.phi) for progress in report.history]
    assert all(later < earlier for earlier, later in zip(phi, phi[1:], strict=False))
    assert (report.cg_iterations > 0) == (linear == "cg")


def test_minimum_is_the_one_of_a_general_optimiser():
    problem = hanging(4, 3, size=0.1, material=Material(bending_stiffness=1e-4))
    potential, free = default_potential(), problem.cloth.free.numpy()
    pos, report = minimize(potential, problem, settings=TIGHT)
    full = problem.state.pos.numpy().copy()

    def value_and_slope(unknown):
        full[free] = unknown.reshape(-1, 3)
        point = torch.as_tensor(full)
        gradient, energies = potential.gradient(problem, point)
        return 1e3 * float(sum(energies.values())), 1e3 * gradient.numpy()[free].reshape(-1)

    options = {"maxiter": 5000, "maxfun": 10000, "gtol": 1e-10, "ftol": 0.0, "maxcor": 50}
    found = optimize.minimize(value_and_slope, full[free].reshape(-1), jac=True, method="L-BFGS-B", options=options)
    np.testing.assert_allclose(pos.numpy()[free].reshape(-1), found.x, rtol=0, atol=1e-6)
    assert 1e3 * float(report.phi) == pytest.approx(found.fun, rel=1e-9)


@pytest.mark.parametrize("double", [True, False])
def test_float32(double):
    problem = falling(dtype=torch.float32)
    settings = NewtonSettings(target_rg=1e-3, double=double)
    pos, report = minimize(default_potential(), problem, settings=settings)
    assert report.converged.all(), report.reason
    assert pos.dtype == report.acc.dtype == torch.float32
    gradient, _ = default_potential().gradient(problem, pos, report.acc)
    assert float(relative_gradient(problem, gradient)) <= 3e-3
    exact, _ = minimize(default_potential(), falling(), settings=replace(settings, target_rg=1e-7))
    torch.testing.assert_close(pos.double(), exact, rtol=0, atol=2e-5)


def test_pins_reach_their_targets_and_isolated_vertices_stay():
    pos, faces = grid(5, 5, 0.2)
    pos = np.concatenate([pos, [[0.1, -0.3, 0.1]]])
    cloth = build_cloth(pos, faces, Material(), np.arange(26) < 5, dtype=torch.float32)
    target = cloth.rest_pos + torch.tensor([0.0123456, 0.0, 0.00987])
    problem = make_problem(cloth)
    problem = replace(problem, step=replace(problem.step, pin_target=target))
    found, report = minimize(default_potential(), problem)
    assert report.converged.all()
    assert torch.equal(found[:5], target[:5])
    assert torch.equal(found[25], cloth.rest_pos[25])
    assert (found[5:25] != cloth.rest_pos[5:25]).any(dim=1).all()
    without, _ = minimize(default_potential(), replace(problem, step=replace(problem.step, pin_target=None)))
    assert torch.equal(without[:5], cloth.rest_pos[:5])


def test_nothing_to_move_is_converged():
    pos, faces = grid(3, 3, 0.1)
    problem = make_problem(build_cloth(pos, faces, Material(), np.ones(9, dtype=bool), dtype=F64))
    found, report = minimize(default_potential(), problem)
    assert report.converged.all()
    assert report.iterations == 0
    assert torch.equal(found, problem.state.pos)


@pytest.mark.parametrize("linear", LINEAR)
def test_batch_equals_singles(linear):
    potential, problems = default_potential(), pieces()
    settings = replace(TIGHT, linear=linear, max_iterations=4)
    together, report = minimize(potential, batch(problems), settings=settings)
    alone = [minimize(potential, problem, settings=settings) for problem in problems]
    torch.testing.assert_close(together, torch.cat([pos for pos, _ in alone]), rtol=0, atol=1e-9)
    torch.testing.assert_close(report.phi, torch.cat([single.phi for _, single in alone]), rtol=1e-9, atol=1e-12)
    assert report.reason == tuple(single.reason[0] for _, single in alone)


@pytest.mark.parametrize("linear", LINEAR)
def test_a_broken_scene_is_reported_and_leaves_the_others_alone(linear):
    problems = pieces()
    broken = problems[1].state.pos.clone()
    broken[3, 1] = float("nan")
    problems[1] = replace(problems[1], state=replace(problems[1].state, pos=broken))
    settings = replace(TIGHT, linear=linear)
    found, report = minimize(default_potential(), batch(problems), settings=settings)
    assert report.converged.tolist() == [True, False, True]
    assert report.reason == ("", "not finite", "")
    first, _ = minimize(default_potential(), problems[0], settings=settings)
    torch.testing.assert_close(found[: len(first)], first, rtol=0, atol=1e-7)


def test_stopping_early_is_never_silent():
    problem = hanging()
    _, report = minimize(default_potential(), problem, settings=NewtonSettings(max_iterations=1))
    assert (report.iterations, report.reason) == (1, ("max iterations",))
    assert not report.converged.any()
    _, report = minimize(default_potential(), problem, settings=NewtonSettings(budget_ms=0.0))
    assert (report.iterations, report.reason) == (0, ("time budget",))


class _Deceptive:
    """Promises to fall along y and does not."""

    def applies(self, problem):
        return True

    def __call__(self, problem, next_pos, acc):
        return problem.sum_vertices((next_pos - next_pos.detach())[:, 1])


def test_a_potential_that_does_not_fall_is_reported():
    problem = hanging()
    settled, _ = minimize(default_potential(), problem, settings=TIGHT)
    pos, report = minimize(default_potential().with_terms(odd=_Deceptive()), problem, settled)
    assert report.reason == ("line search failed",)
    assert torch.equal(pos, settled)


class _Wind:
    """A steady force along x; not known to the solver."""

    def applies(self, problem):
        return True

    def __call__(self, problem, next_pos, acc):
        return problem.sum_vertices(-1e-3 * next_pos[:, 0] + 1e-2 * next_pos[:, 0] ** 2)


def test_terms_of_other_classes_count():
    problem = hanging(material=Material(bending_stiffness=1e-2))
    potential = default_potential().with_terms(wind=_Wind())
    pos, report = minimize(potential, problem, settings=replace(TIGHT, target_rg=1e-5))
    assert report.converged.all(), report.reason
    assert float(relative_gradient(problem, potential.gradient(problem, pos)[0])) <= 1e-5
    still, _ = minimize(default_potential(), problem, settings=TIGHT)
    assert float((pos - still)[:, 0].abs().max()) > 1e-4


@pytest.mark.parametrize("linear", LINEAR)
def test_attachments_pull_together(linear):
    cloths = [build_cloth(*strip(4, 0.2, 0.05), Material(), np.arange(8) < 2, dtype=F64) for _ in range(2)]
    shift = torch.tensor([0.0, 0.0, 0.055], dtype=F64)
    both = concatenate_cloths(cloths)
    both = replace(both, num_scenes=1, **{name: 0 * getattr(both, name) for name in vars(both) if name.endswith("_scene")})
    pos = torch.cat([cloths[0].rest_pos, cloths[1].rest_pos + shift])
    problem = make_problem(both, pos)
    button = Attachments(torch.tensor([[7, 14], [5, 12]]), torch.tensor([True, False]))
    closed = replace(problem, step=replace(problem.step, attachments=button))
    gaps = []
    for case in (problem, closed):
        found, report = minimize(default_potential(), case, settings=replace(TIGHT, linear=linear))
        assert report.converged.all(), report.reason
        gaps.append((found[7] - found[14]).norm().item())
    assert gaps[0] > 4e-3
    assert gaps[1] < 1e-3


def test_rests_with_contact_and_falls_without():
    dt, steps = 1 / 30, 25
    for contact in (True, False):
        problem = falling(0.02, contact)
        start = problem.state.pos
        for _ in range(steps):
            pos, report = minimize(default_potential(), problem, settings=NewtonSettings(target_rg=1e-5))
            assert report.converged.all(), report.reason
            state = State(pos, problem.state.vel + dt * report.acc, problem.state.origin)
            problem = replace(problem, state=state, contact=plane_contact(pos) if contact else None)
        if contact:
            assert float(problem.state.pos[:, 1].min()) > 0.0015
            assert float(problem.state.pos[:, 1].max()) < 0.0025
            assert float(problem.state.vel.abs().max()) < 1e-3
        else:
            fall = torch.tensor([0.0, -9.81 * dt**2 * steps * (steps + 1) / 2, 0.0], dtype=F64)
            torch.testing.assert_close(pos, start + fall, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dt", [1 / 240, 1 / 30, 1 / 5])
@pytest.mark.parametrize("stiffness, density", [(1.0, 1.0), (10.0, 1.0), (100.0, 1.0), (1.0, 0.1)])
def test_extremes_stay_bounded(stiffness, density, dt):
    base = Material()
    material = replace(
        base,
        lame_mu=stiffness * base.lame_mu,
        lame_lambda=stiffness * base.lame_lambda,
        bending_stiffness=stiffness * base.bending_stiffness,
        density=density * base.density,
    )
    problem = falling(0.01, material=material, dt=dt)
    for _ in range(4):
        pos, report = minimize(default_potential(), problem, settings=NewtonSettings(max_iterations=40))
        assert torch.isfinite(pos).all()
        assert all(done or reason for done, reason in zip(report.converged.tolist(), report.reason, strict=True))
        state = State(pos, problem.state.vel + dt * report.acc, problem.state.origin)
        problem = replace(problem, state=state, contact=plane_contact(pos))
        assert float(problem.state.vel.norm(dim=1).max()) < 4 * 9.81 * dt + 0.5
        assert float(pos[:, 1].min()) > -0.01


def test_settings_are_checked():
    with pytest.raises(ValueError, match="cg or direct"):
        NewtonSettings(linear="lu")
    with pytest.raises(ValueError, match="target_rg"):
        NewtonSettings(target_rg=0.0)


def test_a_potential_without_contact_or_membrane():
    potential = default_potential()
    potential = Potential({name: term for name, term in potential.terms.items() if name in ("inertia", "gravity")})
    problem = falling()
    pos, report = minimize(potential, problem)
    assert report.converged.all()
    fall = torch.tensor([0.0, -9.81 / 900, 0.0], dtype=F64)
    torch.testing.assert_close(pos, problem.state.pos + fall, rtol=0, atol=1e-8)  # g is a float32 tensor


def test_operations_for_other_devices_give_the_same(monkeypatch):
    """What an accelerator runs in place of scipy, here on the CPU."""
    settings = replace(TIGHT, linear="cg", max_iterations=5)
    problem = batch(pieces())
    expected, report = minimize(default_potential(), problem, settings=settings)
    monkeypatch.setattr(linear, "product", linear.block_product)
    monkeypatch.setattr(Scatter, "__call__", Scatter.by_index)
    found, other = minimize(default_potential(), problem, settings=settings)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-10)
    assert other.iterations == report.iterations


@pytest.mark.gpu
def test_cuda_gives_the_same():
    problem = falling(dtype=torch.float32)
    expected, _ = minimize(default_potential(), problem, settings=TIGHT)
    on_gpu = StepProblem(
        to_device(problem.cloth, "cuda"),
        to_device(problem.state, "cuda"),
        StepInput(problem.step.dt.cuda()),
        to_device(problem.contact, "cuda"),
        problem.gravity.cuda(),
    )
    for name in LINEAR:
        found, report = minimize(default_potential(), on_gpu, settings=replace(TIGHT, linear=name))
        assert report.converged.all()
        torch.testing.assert_close(found.cpu(), expected, rtol=0, atol=1e-6)

"""Gradient and Hessian assembled in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Attachments
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.potential import default_potential
from hood.energies.wind import Wind
from hood.native.build import BuildError
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system import linear
from hood.solver.system.plan import SolverPlan, plan_for, quadratic_model
from hood.testing import fold, grid, make_problem, plane_contact

F64 = torch.float64


def touching_sheet(pinned=True, attached=True):
    """A sheet that pierces a moving plane, slides on it and is buttoned to itself."""
    pos, faces = grid(5, 4, 0.3)
    rng = np.random.default_rng(0)
    cloth = build_cloth(pos, faces, Material(bending_stiffness=1e-3), np.arange(20) < (4 if pinned else 0), dtype=F64)
    start = cloth.rest_pos + 0.001 * torch.as_tensor(rng.normal(size=pos.shape))
    motion = torch.tensor([2e-3, 1e-3, 0.0])
    problem = make_problem(cloth, start, 0.05 * rng.normal(size=pos.shape), contact=plane_contact(start, motion=motion))
    if attached:
        button = Attachments(torch.tensor([[3, 16], [5, 18]]), torch.tensor([True, False]))
        problem = replace(problem, step=replace(problem.step, attachments=button))
    return problem


def states(problem):
    rest = problem.cloth.rest_pos
    noise = 1e-3 * torch.as_tensor(np.random.default_rng(1).normal(size=rest.shape))
    fallen = rest.clone()
    fallen[4] = fallen[5]
    return {
        "near": problem.state.pos + noise,
        "stretched": 1.5 * rest + noise,
        "compressed": 0.6 * rest + noise,
        "folded": torch.as_tensor(fold(rest.numpy(), 3.0)) + 0.1 * noise,
        "coincident vertices": fallen,
    }


@pytest.mark.parametrize("name", ["near", "stretched", "compressed", "folded", "coincident vertices"])
def test_gradient_is_that_of_the_potential(name):
    problem, potential = touching_sheet(), default_potential()
    pos = states(problem)[name]
    acc = problem.acceleration(pos)
    expected, _ = potential.gradient(problem, pos, acc)
    model = quadratic_model(potential, problem, plan_for(problem), pos, acc)
    torch.testing.assert_close(model.gradient, expected, rtol=1e-10, atol=1e-10 * float(expected.abs().max()))


BLOWN = default_potential().with_terms(
    wind=Wind([3.0, 1.0, -2.0], gusts=0.3), stretch_damping=StretchDamping(0.02), bend_damping=BendDamping(0.03)
)


def product_and_difference(problem, pos, direction, h=1e-7, potential=None):
    """The exact matrix, indefinite part included, times a direction, and finite differences of the gradient."""
    potential, plan = potential or default_potential(), plan_for(problem)
    model = quadratic_model(potential, problem, plan, pos, problem.acceleration(pos))
    applied = linear.product(plan.pattern, model.triples + model.indefinite_part)(direction[plan.vertices])
    ahead, behind = (potential.gradient(problem, pos + sign * h * direction)[0] for sign in (1.0, -1.0))
    return applied, ((ahead - behind) / (2 * h))[plan.vertices]


@pytest.mark.parametrize("potential", [default_potential(), BLOWN], ids=["default", "wind and damping"])
@pytest.mark.parametrize("size", [1.05, 0.6])
def test_matrix_and_slack_are_the_hessian(size, potential):
    """In tension and under compression, with contact, sliding, pins and springs; flat, where bending is exact."""
    problem = touching_sheet()
    if potential is BLOWN:  # damping of bending is exact where the angle is that of the start
        flat = problem.state.pos * torch.tensor([1.0, 0.0, 1.0])
        problem = replace(problem, state=replace(problem.state, pos=flat))
    pos = size * problem.cloth.rest_pos * torch.tensor([1.0, 0.0, 1.02]) + torch.tensor([0.001, 0.0005, 0.0])
    direction = torch.as_tensor(np.random.default_rng(2).normal(size=pos.shape)) * problem.cloth.free.unsqueeze(1)
    applied, difference = product_and_difference(problem, pos, direction, potential=potential)
    torch.testing.assert_close(applied, difference, rtol=0, atol=1e-6 * float(difference.abs().max()))


def test_hessian_of_sticking_and_sliding_friction():
    problem = touching_sheet(attached=False)
    carried = problem.contact.next_point - problem.contact.point
    for slip in (5e-5, 1e-3):
        pos = problem.state.pos + carried + slip * torch.tensor([0.6, 0.0, 0.8])
        limp = {name: 0 * getattr(problem.cloth, name) for name in ("lame_mu", "lame_lambda", "bending_stiffness")}
        flat = replace(problem, cloth=replace(problem.cloth, **limp))
        direction = torch.as_tensor(np.random.default_rng(3).normal(size=pos.shape)) * problem.cloth.free.unsqueeze(1)
        applied, difference = product_and_difference(flat, pos, direction, h=1e-9)
        torch.testing.assert_close(applied, difference, rtol=0, atol=1e-4 * float(difference.abs().max()))


def dense(pattern, triples):
    apply, size = linear.product(pattern, triples), 3 * pattern.size
    return torch.stack([apply(column.reshape(-1, 3)).reshape(-1) for column in torch.eye(size, dtype=F64)])


def test_the_matrix_is_positive_and_the_slack_is_not():
    problem = touching_sheet()
    plan = plan_for(problem)
    for name, pos in states(problem).items():
        model = quadratic_model(default_potential(), problem, plan, pos, problem.acceleration(pos))
        matrix, indefinite_part = dense(plan.pattern, model.triples), dense(plan.pattern, model.indefinite_part)
        size = float(matrix.abs().max())
        torch.testing.assert_close(matrix, matrix.T, rtol=0, atol=1e-12 * size)
        torch.testing.assert_close(indefinite_part, indefinite_part.T, rtol=0, atol=1e-12 * size)
        inertia = float((problem.cloth.mass / problem.vertex_dt.squeeze(1) ** 2).min())
        assert float(torch.linalg.eigvalsh(matrix).min()) >= 0.99 * inertia, name
        assert float(torch.linalg.eigvalsh(indefinite_part).max()) <= 1e-10 * size, name


def test_the_hessian_is_indefinite_under_compression():
    pos, faces = grid(5, 5, 0.2)
    problem = make_problem(build_cloth(pos, faces, Material(bending_stiffness=0.0), dtype=F64))
    direction = torch.zeros_like(problem.state.pos)
    direction[::2, 1] = 1.0
    squeezed, plan = 0.6 * problem.cloth.rest_pos, plan_for(problem)
    applied, difference = product_and_difference(problem, squeezed, direction)
    torch.testing.assert_close(applied, difference, rtol=0, atol=1e-6 * float(difference.abs().max()))
    model = quadratic_model(default_potential(), problem, plan, squeezed, problem.acceleration(squeezed))
    positive = linear.product(plan.pattern, model.triples)(direction)
    assert float((applied * direction).sum()) < 0 < float((positive * direction).sum())


def test_plan_is_kept_until_something_changes():
    problem = touching_sheet()
    first = plan_for(problem)
    assert plan_for(problem) is first
    assert plan_for(replace(problem, cloth=replace(problem.cloth, mass=problem.cloth.mass.float()))) is first
    opened = replace(problem.step.attachments, active=torch.tensor([False, True]))
    assert plan_for(replace(problem, step=replace(problem.step, attachments=opened))) is first
    other = replace(problem, step=replace(problem.step, attachments=None))
    assert plan_for(other) is not first
    loose = replace(problem, cloth=replace(problem.cloth, pinned=torch.zeros(20, dtype=torch.bool)))
    assert plan_for(loose).pattern.size == 20


def test_the_compiled_solver_does_without_the_pattern_of_the_torch_form():
    """It takes seconds and gigabytes at 50,000 vertices."""
    problem = touching_sheet()
    plan = SolverPlan(problem.cloth, problem.step.attachments)
    try:
        minimize(default_potential(), problem, settings=NewtonSettings(engine="compiled"), plan=plan)
    except BuildError as error:
        pytest.skip(str(error))
    assert not {"pattern", "matrix", "indefinite_part", "face_vertices", "hinge_vertices"} & vars(plan).keys()
    minimize(default_potential(), problem, settings=NewtonSettings(engine="torch"), plan=plan)
    assert {"pattern", "matrix", "indefinite_part"} <= vars(plan).keys()


def test_fixed_vertices_are_no_unknowns():
    problem = touching_sheet()
    plan = SolverPlan(problem.cloth)
    assert plan.vertices.tolist() == list(range(4, 20))
    assert plan.pattern.size == 16

"""Contact and friction at points inside edges and faces: both forms of the solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_engine import COMPILED, TORCH, after, dense, dense_of, model_at

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Obstacle, State, StepInput, concatenate_obstacles
from hood.energies.contact import Collision
from hood.energies.friction import Friction, WeightFriction
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.mesh.penetration.crossing import crossings
from hood.solver.derivatives.vertices import energies_and_gradient
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system import linear
from hood.solver.system.iterate import Unknowns, in_double
from hood.solver.system.line_search import Path
from hood.solver.system.linear import by_blocks, diagonal_inverse
from hood.solver.system.plan import plan_for, quadratic_model
from hood.solver.vertex.block_jacobi import LocalTerms
from hood.solver.vertex.compiled import EngineTerms
from hood.solver.vertex.gauss_seidel import sweep
from hood.steppers.newton import implicit_euler
from hood.testing import grid, make_problem, sphere

F64 = torch.float64
PLACES = ("edges", "strict")
CENTRE = torch.tensor([0.14, -0.1, 0.16], dtype=F64)


def potential_at(place: str) -> Potential:
    """Contact at a place, with the same reach everywhere: what the points do alone."""
    return default_potential(contact=place, reach="constant")


def over_ball(height: float = 1e-3, cells: int = 4, dtype: torch.dtype = F64, seed: int = 0) -> StepProblem:
    """A coarse sheet on a moving ball, which comes up between its vertices; one corner is held."""
    pos, faces = grid(cells + 1, cells + 1, 0.3)
    fabric = Material(friction=np.linspace(0.5, 2.0, len(pos)))
    cloth = build_cloth(pos, faces, fabric, np.arange(len(pos)) == 0, dtype=dtype)
    ball, ball_faces = sphere(3, 0.1)
    now = torch.as_tensor(ball) + CENTRE
    zeros = torch.zeros(len(ball)).long(), torch.zeros(len(ball_faces)).long()
    moved = now + torch.tensor([1e-3, 2e-3, 0.0])
    obstacle = Obstacle(*(part.to(dtype) for part in (now, moved, now)), torch.as_tensor(ball_faces), *zeros)
    speed = 0.02 * np.random.default_rng(seed).normal(size=pos.shape)
    problem = make_problem(cloth, cloth.rest_pos + torch.tensor([0.0, height, 0.0], dtype=dtype), speed)
    pins = torch.where(cloth.pinned[:, None], problem.state.pos, torch.nan)
    return replace(problem, step=replace(problem.step, obstacle=obstacle, pin_target=pins))


def shaken(problem: StepProblem, size: float = 2e-3) -> torch.Tensor:
    noise = torch.randn(problem.state.pos.shape, generator=torch.Generator().manual_seed(1), dtype=F64)
    return problem.state.pos + size * noise.to(problem.state.pos) * problem.cloth.free[:, None]


def pressed(place: str) -> tuple[Potential, StepProblem, torch.Tensor]:
    """A state in which points push, and friction sticks and slides."""
    potential = potential_at(place)
    problem = potential.prepare(over_ball(height=-5e-3, cells=10))
    carried = torch.tensor([1e-3, 2e-3, 0.0]) * problem.cloth.free[:, None]
    return potential, problem, shaken(problem, 1.5e-4) + carried


@pytest.mark.parametrize("place", PLACES)
def test_gradient_is_that_of_the_potential(place: str) -> None:
    potential, problem, pos = pressed(place)
    acc = problem.acceleration(pos)
    expected, energies = potential.gradient(problem, pos, acc)
    terms = Unknowns(potential, problem).terms
    assert [len(points.forces.walls) for points in terms.points] == [1]
    model = quadratic_model(potential, problem, plan_for(problem), pos, acc)
    torch.testing.assert_close(model.gradient, expected, rtol=1e-10, atol=1e-12 * float(expected.abs().max()))
    torch.testing.assert_close(sum(terms.energies(pos, acc)), sum(energies.values()), rtol=1e-12, atol=0)
    slope, parts = energies_and_gradient(potential, problem, pos, acc)
    torch.testing.assert_close(slope, expected, rtol=1e-10, atol=1e-12 * float(expected.abs().max()))
    assert parts["collision"] == pytest.approx(float(energies["collision"]))
    # Both kinds of friction are there.
    grip = terms.points[0].forces.grips[0]
    slipping = grip.slip(terms.points[0].at(pos)).norm(dim=1)[grip.force > 0] > grip.limit[grip.force > 0]
    assert 0 < int(slipping.sum()) < len(slipping)


@pytest.mark.parametrize("place", PLACES)
def test_matrix_and_slack_are_the_hessian(place: str) -> None:
    potential, problem, pos = pressed(place)
    limp = {name: 0 * getattr(problem.cloth, name) for name in ("lame_mu", "lame_lambda", "bending_stiffness")}
    problem = replace(problem, cloth=replace(problem.cloth, **limp))
    plan = plan_for(problem)
    model = quadratic_model(potential, problem, plan, pos, problem.acceleration(pos))
    direction = torch.as_tensor(np.random.default_rng(2).normal(size=pos.shape)) * problem.cloth.free[:, None]
    applied = linear.product(plan.pattern, model.triples + model.indefinite_part)(direction[plan.vertices])
    ahead, behind = (potential.gradient(problem, pos + sign * 1e-9 * direction)[0] for sign in (1.0, -1.0))
    difference = ((ahead - behind) / 2e-9)[plan.vertices]
    torch.testing.assert_close(applied, difference, rtol=0, atol=2e-6 * float(difference.abs().max()))
    eigenvalues = np.linalg.eigvalsh(dense_of(plan, model.triples))
    assert eigenvalues.min() > 0
    assert np.linalg.eigvalsh(dense_of(plan, model.indefinite_part)).max() <= 1e-9 * eigenvalues.max()


@pytest.mark.usefixtures("compiled_solver")
@pytest.mark.parametrize("place", PLACES)
def test_compiled_model_is_that_of_the_torch_form(place: str) -> None:
    potential, problem, pos = pressed(place)
    unknowns, plan = Unknowns(potential, problem), plan_for(problem)
    there = unknowns.at(pos)
    model = quadratic_model(potential, problem, plan, there.pos, there.acc)
    scene = model_at(problem, potential, pos, wide=True)
    assert scene.values.phi == pytest.approx(float(there.phi), rel=1e-12)
    assert scene.values.noise == pytest.approx(float(there.noise), rel=1e-12)
    free = scene.tables.vertex[: scene.tables.num_rows]
    expected = model.gradient.numpy()[free]
    assert np.abs(scene.array("gradient")[:, :3] - expected).max() <= 2e-14 * np.abs(expected).max()
    plain, indefinite_part = dense_of(plan, model.triples), dense_of(plan, model.indefinite_part)
    size = np.abs(plain).max()
    assert np.abs(dense(scene, "matrix") - plain).max() <= 2e-14 * size
    scene.matrix(0.7)
    assert np.abs(dense(scene, "matrix") - plain - 0.7 * indefinite_part).max() <= 1e-12 * size  # the heading of a small slip
    rank = np.searchsorted(plan.vertices.numpy(), free)
    inverse = diagonal_inverse(plan.pattern, model.triples).numpy()[rank]
    slot = scene.tables.pairs.slot
    found = scene.array("inverse").reshape(-1, 3, 2, 4)[slot // 2, :, slot % 2, :3]
    assert np.abs(found - inverse).max() <= 1e-12 * np.abs(inverse).max()


@pytest.mark.usefixtures("compiled_solver")
@pytest.mark.parametrize("place", PLACES)
def test_iterations_are_those_of_the_torch_form(place: str) -> None:
    """Fast and crumpled cloth: paths are bent, systems meet negative curvature."""
    potential, problem = potential_at(place), over_ball(height=0.01)
    fast = replace(problem.state, vel=problem.state.vel + torch.tensor([0.3, -1.0, 0.0]))
    problem = potential.prepare(replace(problem, state=fast))
    for count in range(5):
        there, expected = after(potential, problem, TORCH, count)
        here, phi = after(potential, problem, COMPILED, count)
        assert float((here - there).norm()) <= 1e-4 * float((there - problem.state.pos).norm())
        assert phi == pytest.approx(expected, rel=1e-5, abs=1e-9)


@pytest.mark.usefixtures("compiled_solver")
@pytest.mark.parametrize("place", PLACES)
def test_runs_are_bit_identical_and_scenes_do_not_touch_each_other(place: str) -> None:
    potential, settings = potential_at(place), NewtonSettings(target_rg=1e-4, engine="compiled")
    problems = [over_ball(), over_ball(height=-2e-3, cells=5, seed=3)]
    alone = [minimize(potential, problem, settings=settings)[0] for problem in problems]
    minimize(potential_at("vertices"), problems[0], settings=settings)
    assert torch.equal(minimize(potential, problems[0], settings=settings)[0], alone[0])
    assert not torch.equal(minimize(potential_at("vertices"), problems[0], settings=settings)[0], alone[0])
    both = joined(problems)
    found, report = minimize(potential, both, settings=settings)
    assert report.converged.all()
    assert torch.equal(found, torch.cat(alone))
    plain, report = minimize(potential, both, settings=replace(settings, engine="torch"))
    assert report.converged.all()
    torch.testing.assert_close(plain, found, rtol=0, atol=1e-5)


def joined(problems: list[StepProblem]) -> StepProblem:
    steps, states = [problem.step for problem in problems], [problem.state for problem in problems]
    obstacle = concatenate_obstacles([step.obstacle for step in steps if step.obstacle is not None])
    pins = torch.cat([step.pin_target for step in steps if step.pin_target is not None])
    state = State(*(torch.cat([getattr(one, name) for one in states]) for name in ("pos", "vel", "origin")))
    step = StepInput(torch.cat([one.dt for one in steps]), obstacle, pins)
    return StepProblem(concatenate_cloths([one.cloth for one in problems]), state, step, gravity=problems[0].gravity)


@pytest.mark.usefixtures("compiled_solver")
@pytest.mark.parametrize("place", PLACES)
def test_views_of_single_vertices_have_the_points(place: str) -> None:
    potential, problem = potential_at(place), over_ball(height=-1e-3, dtype=torch.float32)
    problem = potential.prepare(problem)
    pos = shaken(problem)
    model = quadratic_model(potential, in_double(problem), plan_for(problem), pos.double(), problem.acceleration(pos).double())
    for view in (LocalTerms(potential, problem)(pos), EngineTerms(potential, problem)(pos)):
        free = problem.cloth.free
        assert float((view.force.double() + model.gradient)[free].norm()) <= 1e-4 * float(model.gradient[free].norm())
        expected = by_blocks(diagonal_inverse(plan_for(problem).pattern, model.triples))(-model.gradient[free])
        assert float((view.step[free].double() - expected).norm()) <= 1e-4 * float(expected.norm())


@pytest.mark.parametrize("place", PLACES)
def test_sweeps_go_down_the_same_potential(place: str) -> None:
    potential, problem = potential_at(place), over_ball(height=-1e-3)
    pos, report = sweep(potential, problem, None, 30)
    prepared = potential.prepare(problem)
    assert int(report.kept) == 30
    assert float(potential.total(prepared, pos)) == pytest.approx(float(report.phi), rel=1e-12)
    lowest = float(minimize(potential, problem, settings=NewtonSettings(target_rg=1e-6))[1].phi)
    start = float(potential.total(prepared, sweep(potential, problem, None, 0)[0]))
    assert float(report.phi) - lowest < 0.2 * (start - lowest)


@pytest.mark.parametrize("place", PLACES)
def test_the_correction_of_the_path_is_of_second_order_and_leads_out(place: str) -> None:
    """Cloth that falls onto the ball: points are stopped where the whole penalty balances the model."""
    potential = potential_at(place)
    problem = potential.prepare(over_ball(height=3e-3))
    unknowns, plan = Unknowns(potential, problem), plan_for(problem)
    now = unknowns.at(problem.state.pos)
    model = quadratic_model(potential, problem, plan, now.pos, now.acc)
    direction = torch.tensor([0.0, -0.02, 0.0], dtype=F64) * problem.cloth.free[:, None]
    path = Path(unknowns, now, direction, diagonal_inverse(plan.pattern, model.triples), plan.vertices)

    def off(length: float) -> float:
        return float((path.at(torch.tensor([length], dtype=F64)).pos - now.pos - length * direction).norm())

    assert off(0.0) < 1e-15
    assert off(1e-4) <= 0.02 * off(1e-3) + 1e-15
    (points,) = unknowns.terms.points
    deepest = {length: float(points.forces.walls[0].depth(points.at(pos)).max()) for length, pos in (
        ("straight", now.pos + direction), ("bent", path.at(torch.ones(1, dtype=F64)).pos))}  # fmt: skip
    assert deepest["straight"] > 0.015
    assert 0.0 < deepest["bent"] < 0.5 * deepest["straight"]


@pytest.mark.parametrize("cells", [4, 6, 10])
def test_a_ball_comes_through_between_vertices_alone(cells: int) -> None:
    """Triangles that the ball's surface cuts, counted by a check that shares nothing with contact or solver."""
    cut = {}
    for place in ("vertices", *PLACES):
        problem = over_ball(cells=cells)
        obstacle = problem.step.obstacle
        assert obstacle is not None
        for taken in implicit_euler(potential_at(place), problem, 6, NewtonSettings(target_rg=1e-3)):
            assert taken.report.converged.all()
        pos = taken.state.pos
        found = crossings(pos.numpy(), problem.cloth.faces.numpy(), obstacle.next_pos.numpy(), obstacle.faces.numpy())
        cut[place] = len(np.unique(found.pairs[:, 0]))
    assert cut["vertices"] >= 15
    assert cut["strict"] == 0
    assert cells == 4 or cut["edges"] == 0  # triangles as large as the ball have it through their middle


def test_a_place_that_nobody_searched_is_refused() -> None:
    problem = over_ball()
    with pytest.raises(ValueError, match="contact=edges not searched for yet; pass the problem through Potential.prepare"):
        potential_at("edges").total(problem.with_fold(), problem.state.pos)
    with pytest.raises(ValueError, match="folds of the body not searched for yet; pass the problem through Potential.prepare"):
        potential_at("vertices").total(problem.with_contact(), problem.state.pos)
    for term in (Collision, Friction):
        with pytest.raises(ValueError, match="contact is 'edge'; choose vertices, edges, strict"):
            term(contact="edge")
        with pytest.raises(ValueError, match="sides is 'one'; choose both, nearest"):
            term(sides="one")


def test_friction_by_weight_acts_at_vertices() -> None:
    potential = potential_at("edges").with_terms(friction=WeightFriction())
    problem = potential.prepare(over_ball(height=-1e-3))
    (points,) = Unknowns(potential, problem).terms.points
    assert len(points.forces.walls) == 1
    assert points.forces.grips == ()

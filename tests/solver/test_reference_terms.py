"""The solver on the energies of HOOD's published code: exact gradient, positive curvature, convergence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, State
from hood.contact.contact import CentroidContact, find_contact
from hood.energies.bending import CurrentLengthBending
from hood.energies.friction import CodedFriction
from hood.energies.membrane import CodedStretching
from hood.energies.potential import (
    Potential,
    coded_potential,
    default_potential,
    reference_potential,
    relative_gradient,
    scale,
)
from hood.energies.problem import StepProblem
from hood.solver.derivatives.step_terms import StepTerms
from hood.solver.derivatives.vertices import terms_without_form
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system import linear
from hood.solver.system.iterate import in_double
from hood.solver.system.plan import plan_for, quadratic_model
from hood.solver.vertex.gauss_seidel import neighbourhoods, sweep, vertex_systems
from hood.testing import cylinder, fold, grid, make_problem, sphere

F64 = torch.float64
RADIUS = 0.12
POTENTIALS = {
    "as meant": reference_potential(),
    "as coded": coded_potential(),
    "as coded, cvpr": coded_potential(collision_lagged=True),
    "as meant, the membrane as coded": reference_potential().with_terms(stretching=CodedStretching()),
}


def sheet_on_sphere(dtype: torch.dtype = F64, height: float = 1e-3) -> StepProblem:
    """A sheet just above a ball that moves sideways, with its contact."""
    pos, faces = grid(7, 7, 0.2)
    cloth = build_cloth(pos + [-0.1, RADIUS + height, -0.1], faces, Material(), dtype=dtype)
    points, triangles = sphere(3, RADIUS)
    ball = torch.as_tensor(points).to(dtype)
    move = torch.tensor([0.005, 0.0, 0.0], dtype=dtype)
    zeros = [torch.zeros(len(x), dtype=torch.int64) for x in (points, triangles)]
    body = Obstacle(ball, ball + move, ball - move, torch.as_tensor(triangles), *zeros)
    problem = make_problem(cloth)
    contact = find_contact(problem.state.pos, cloth.vertex_scene, body)
    return replace(problem, step=replace(problem.step, obstacle=body), contact=contact)


@pytest.fixture(scope="module")
def draped() -> StepProblem:
    """The same five steps later: hanging down around the ball, in contact; every step converges."""
    problem, potential = sheet_on_sphere(), reference_potential()
    for _ in range(5):
        body = problem.step.obstacle
        assert body is not None
        contact = find_contact(problem.state.pos, problem.cloth.vertex_scene, body)
        problem = replace(problem, contact=contact)
        pos, report = minimize(potential, problem)
        assert bool(report.converged.all()), report.reason
        state = State(pos, problem.state.vel + problem.vertex_dt * report.acc, problem.state.origin)
        problem = replace(problem, state=state)
    contact = find_contact(problem.state.pos, problem.cloth.vertex_scene, body)
    return potential.prepare(replace(problem, contact=contact))


@pytest.mark.parametrize("form", POTENTIALS)
@pytest.mark.parametrize("state", ["near", "stretched", "compressed", "folded", "coincident vertices"])
def test_gradient_is_that_of_the_potential(draped: StepProblem, state: str, form: str) -> None:
    potential = POTENTIALS[form]
    problem = potential.prepare(draped)
    assert terms_without_form(potential, problem) is None  # all in closed form
    noise = 1e-3 * torch.as_tensor(np.random.default_rng(0).normal(size=problem.state.pos.shape))
    rest = problem.cloth.rest_pos
    fallen = problem.state.pos.clone()
    fallen[24] = fallen[25]
    pos = {
        "near": problem.state.pos + noise,
        "stretched": 1.4 * rest + noise,
        "compressed": 0.6 * rest + noise,
        "folded": torch.as_tensor(fold((rest - rest[0]).numpy(), 3.0)) + 0.1 * noise,
        "coincident vertices": fallen,
    }[state]
    acc = problem.acceleration(pos)
    expected, energies = potential.gradient(problem, pos, acc)
    assert {"bending", "collision", "friction"} <= energies.keys()
    model = quadratic_model(potential, problem, plan_for(problem), pos, acc)
    torch.testing.assert_close(model.gradient, expected, rtol=1e-10, atol=1e-10 * float(expected.abs().max()))


def test_bending_matrix_is_that_of_a_least_squares_residual() -> None:
    """Where the angle is 0 the Gauss-Newton matrix is the Hessian itself; elsewhere it is positive."""
    pos, faces = grid(4, 4, 0.1)
    problem = make_problem(build_cloth(pos, faces, Material(bending_stiffness=1e-2), dtype=F64))
    potential, plan = Potential({"bending": CurrentLengthBending()}), plan_for(problem)
    stretched = problem.cloth.rest_pos * 1.3
    direction = torch.as_tensor(np.random.default_rng(1).normal(size=pos.shape))
    model = quadratic_model(potential, problem, plan, stretched, torch.zeros_like(stretched))
    applied = linear.product(plan.pattern, model.triples)(direction)
    h = 1e-6
    ahead, behind = (potential.gradient(problem, stretched + sign * h * direction)[0] for sign in (1.0, -1.0))
    difference = (ahead - behind) / (2 * h)
    torch.testing.assert_close(applied, difference, rtol=0, atol=1e-6 * float(difference.abs().max()))
    for angle in (0.5, 2.0):
        folded = torch.as_tensor(fold(pos, angle))
        model = quadratic_model(potential, problem, plan, folded, torch.zeros_like(folded))
        assert float((direction * linear.product(plan.pattern, model.triples)(direction)).sum()) > 0


@pytest.mark.parametrize("form", POTENTIALS)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("linear_solver", ["cg", pytest.param("direct", marks=pytest.mark.slow)])
def test_a_sheet_on_a_sphere_converges(dtype: torch.dtype, linear_solver: str, form: str) -> None:
    problem, potential = sheet_on_sphere(dtype), POTENTIALS[form]
    settings = NewtonSettings(target_rg=1e-3, max_iterations=30, linear=linear_solver)
    pos, report = minimize(potential, problem, settings=settings)
    prepared = potential.prepare(in_double(problem))
    gradient, energies = potential.gradient(prepared, pos.double(), report.acc.double())
    if isinstance(potential.terms["friction"], CodedFriction):  # has kinks, and minima on them: no gradient vanishes there
        longer = minimize(potential, problem, settings=replace(settings, max_iterations=200))[1]
        assert float(report.phi - longer.phi) <= 1e-4 * float(scale(prepared))
        assert float(relative_gradient(prepared, gradient)) <= 0.02
    else:
        assert bool(report.converged.all()), report.reason
        assert float(relative_gradient(prepared, gradient)) <= 2e-3
    assert float(energies["collision"]) > 0
    assert float(energies["friction"]) > 0


def test_it_converges_further(draped: StepProblem) -> None:
    _, report = minimize(reference_potential(), draped, settings=NewtonSettings(target_rg=1e-6, cg_iterations=200))
    assert bool(report.converged.all()), report.reason


def test_the_search_is_carried_to_float64_and_into_sweeps() -> None:
    problem, potential = sheet_on_sphere(torch.float32), reference_potential()
    prepared = potential.prepare(problem)
    double = in_double(prepared)
    assert isinstance(prepared.contact, CentroidContact)
    assert isinstance(double.contact, CentroidContact)
    assert torch.equal(double.contact.centroid_face, prepared.contact.centroid_face)
    assert double.contact.next_centroid.dtype == F64
    exact, best = minimize(potential, problem)
    noisy = exact + 3e-4 * torch.as_tensor(np.random.default_rng(2).normal(size=exact.shape)).float()
    before = sweep(potential, problem, noisy, 0)[1]
    after = sweep(potential, problem, noisy, 8)[1]
    assert int(after.kept) == 8
    assert float(after.phi - best.phi) < 0.1 * float(before.phi - best.phi)


def test_vertex_systems_are_the_diagonal_of_the_model(draped: StepProblem) -> None:
    problem, potential = draped, reference_potential()
    pos = problem.state.pos + 1e-3 * torch.as_tensor(np.random.default_rng(3).normal(size=problem.state.pos.shape))
    acc, plan = problem.acceleration(pos), plan_for(problem)
    model = quadratic_model(potential, problem, plan, pos, acc)
    place = {vertex: row for row, vertex in enumerate(plan.vertices.tolist())}
    terms = StepTerms(potential, problem)
    for group in neighbourhoods(terms):
        vertices = group.colour.vertices
        gradient, matrix = vertex_systems(terms, group, pos, acc)
        torch.testing.assert_close(gradient, model.gradient[vertices], rtol=1e-10, atol=1e-11)
        rows = [place[vertex] for vertex in vertices.tolist()]
        blocks = model.triples[plan.pattern.diagonal[rows].reshape(-1)].view(-1, 3, 3)
        torch.testing.assert_close(matrix, blocks, rtol=1e-10, atol=1e-8)


def test_a_free_tube_keeps_its_shape_only_by_the_default() -> None:
    """Rest angle 0: without gravity the tube of the published form opens, the default one is at rest."""
    cloth = build_cloth(*cylinder(8, 5, 0.05, 0.1), Material(bending_stiffness=1e-3), dtype=F64)
    problem = replace(make_problem(cloth), gravity=torch.zeros(3, dtype=F64))
    moved = [minimize(p, problem)[0] - cloth.rest_pos for p in (default_potential(), reference_potential())]
    assert float(moved[0].abs().max()) < 1e-12
    assert float(moved[1].abs().max()) > 1e-5


def test_odd_meshes_are_solved_and_isolated_vertices_stay() -> None:
    """Three faces at an edge, flipped faces, two components and a lone vertex: the same rules in the solver."""
    pos, faces = grid(4, 4, 0.1)
    fin = np.array([[0.0, 0.05, 0.0]]) + pos[[5]]
    apart = pos[:4] + np.array([1.0, 0.0, 0.0])
    points = np.concatenate([pos, fin, apart, apart + [0.05, 0.0, 0.0], [[0.3, 0.4, 0.5]]])
    faces = np.concatenate([faces, [[5, 6, 16]], [[17, 18, 21], [18, 19, 22]]])
    faces[::3] = faces[::3, ::-1]
    cloth = build_cloth(points, faces, Material(), dtype=F64)
    loose = (cloth.mass == 0).nonzero().squeeze(1)
    assert len(loose) >= 1
    for potential in (default_potential(), reference_potential()):
        found, report = minimize(potential, make_problem(cloth, vel=np.ones_like(points)))
        assert bool(report.converged.all())
        assert torch.equal(found[loose], cloth.rest_pos[loose])
        assert bool((found[cloth.free] != cloth.rest_pos[cloth.free]).all())

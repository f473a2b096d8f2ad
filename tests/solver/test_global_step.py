"""The step that all vertices would take together: the assembled matrix's, in torch and by the compiled solver."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from test_local import problem_of
from test_local_engine import needs_compiler
from test_points import over_ball, potential_at, shaken
from torch import Tensor

from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Attachments, concatenate_states, concatenate_step_inputs
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.scene.scene import Scene
from hood.solver.system.iterate import in_double, in_single
from hood.solver.system.linear import block_product
from hood.solver.system.plan import plan_for, quadratic_model
from hood.solver.vertex import block_jacobi
from hood.solver.vertex.block_jacobi import LocalTerms
from hood.solver.vertex.compiled import EngineTerms, local_terms
from hood.tensors.batch import to_device
from hood.tensors.conjugate_gradients import Steps
from hood.testing import make_problem

BUTTONS = Attachments(torch.tensor([[0, 9], [5, 30], [2, 40]]), torch.tensor([True, True, False]))


def case_of(name: str, request: pytest.FixtureRequest) -> tuple[Potential, StepProblem, Tensor]:
    """Contact of vertices and springs, with pins and without; or contact of points, with a pin."""
    if name == "over_ball":
        potential, problem = potential_at("strict"), over_ball()
        return potential, potential.prepare(problem), shaken(problem)
    problem, pos = problem_of(request.getfixturevalue(name))
    problem = replace(problem, step=replace(problem.step, attachments=BUTTONS))
    return default_potential(), in_double(problem), pos.double()


def draw(problem: StepProblem) -> tuple[Tensor, Tensor]:
    """Forces and damping, of the size of the weight and of inertia."""
    mass = problem.cloth.mass
    force = 9.81 * mass.unsqueeze(1) * torch.randn(len(mass), 3, dtype=mass.dtype)
    return force, mass / problem.vertex_dt.squeeze(1) ** 2 * torch.rand(len(mass), dtype=mass.dtype)


@pytest.mark.parametrize("name", ["tank_scene", "band_scene", "over_ball"])
def test_with_enough_steps_it_solves_with_the_assembled_matrix(name: str, request: pytest.FixtureRequest) -> None:
    potential, problem, pos = case_of(name, request)
    force, damping = draw(problem)
    moved = LocalTerms(potential, problem).solve(pos, force, damping, Steps(0.0, 400))
    plan = plan_for(problem)
    model = quadratic_model(potential, problem, plan, pos, problem.acceleration(pos))
    rows = plan.vertices
    pushed = block_product(plan.pattern, model.triples)(moved[rows]) + damping[rows].unsqueeze(1) * moved[rows]
    assert float((pushed - force[rows]).norm() / force[rows].norm()) < 1e-6
    assert not moved[~problem.cloth.free].any()


@needs_compiler
@pytest.mark.parametrize("name", ["tank_scene", "band_scene", "over_ball"])
def test_the_compiled_step_is_that_of_torch(name: str, request: pytest.FixtureRequest) -> None:
    potential, problem, pos = case_of(name, request)
    force, damping = draw(problem)
    exact = LocalTerms(potential, problem).solve(pos, force, damping)
    single = in_single(problem, to_device(problem.cloth, dtype=torch.float32))
    terms = EngineTerms(potential, single)
    for _ in range(2):  # by the matrix that is there, too
        found = terms.solve(pos.float(), force.float(), damping.float())
        assert float((found - exact).norm() / exact.norm()) < 1e-4
        assert not found[~problem.cloth.free].any()
    few, fewer = (
        solver.solve(pos.to(part), force.to(part), damping.to(part), Steps(0.0, 3))
        for solver, part in ((LocalTerms(potential, problem), torch.float64), (terms, torch.float32))
    )
    assert float((few - fewer).norm() / few.norm()) < 1e-4 < float((few - exact).norm() / exact.norm())


@needs_compiler
def test_the_engines_may_have_been_at_another_step(band_scene: Scene) -> None:
    """As they have when a gradient is asked for."""
    potential, (problem, pos) = default_potential(), problem_of(band_scene)
    force, damping = draw(problem)
    terms = EngineTerms(potential, problem)
    first = terms.solve(pos, force, damping)
    slower = replace(problem, step=replace(problem.step, dt=0.5 * problem.step.dt))
    other = EngineTerms(potential, slower).solve(pos, force, damping)
    assert not torch.equal(other, first)
    assert torch.equal(terms.solve(pos, force, damping), first)
    terms(0.5 * pos)
    assert torch.equal(terms.solve(pos, force, damping), first)


def test_a_garment_in_the_air_falls_nearly_as_one_piece(garments: dict[str, Garment]) -> None:
    """The longest wave: internal forces do not resist it, yet a vertex alone would hardly move. So few conjugate gradients
    leave some of it."""
    cloth = build_cloth(garments["tank"].rest_pos, garments["tank"].faces, Material(), dtype=torch.float64)
    problem = make_problem(cloth, cloth.rest_pos, torch.zeros_like(cloth.rest_pos))
    terms = LocalTerms(default_potential(), problem)
    view = terms(problem.state.pos)
    fallen = problem.vertex_dt**2 * problem.gravity
    step = terms.solve(problem.state.pos, view.force, torch.zeros_like(cloth.mass))
    way = fallen.expand_as(step).norm()
    assert float((step - fallen).norm() / way) < 0.5
    assert float(view.step.norm() / way) < 0.05


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
def test_partners_in_a_batch_change_nothing(compiled: bool, band_scene: Scene, tank_scene: Scene) -> None:
    """Each scene has its own step lengths and as many steps as alone."""
    potential, scenes = default_potential(), (band_scene, tank_scene)
    singles = [problem_of(scene) for scene in scenes]
    counts = [scene.cloth.num_vertices for scene in scenes]
    assert block_jacobi.STEPS(counts[0]) < block_jacobi.STEPS(counts[1])
    together = StepProblem(
        concatenate_cloths([scene.cloth for scene in scenes]),
        concatenate_states([problem.state for problem, _ in singles]),
        concatenate_step_inputs([problem.step for problem, _ in singles], counts),
    )
    together, pos = potential.prepare(together), torch.cat([pos for _, pos in singles])
    force, damping = draw(together)
    whole = local_terms(potential, together, compiled).solve(pos, force, damping)
    parts = zip(whole.split(counts), singles, force.split(counts), damping.split(counts), strict=True)
    for found, (problem, start), push, held in parts:
        alone = local_terms(potential, problem, compiled).solve(start, push, held)
        assert float((found - alone).norm() / alone.norm()) < 1e-3

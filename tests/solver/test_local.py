"""What a vertex sees of the potential alone: the exact force, and a step that lowers the energy of each vertex by itself."""

import pytest
import torch

from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.scene.scene import Scene
from hood.solver.vertex.block_jacobi import LocalTerms


def problem_of(scene: Scene) -> tuple[StepProblem, torch.Tensor]:
    """A step of a garment on the body, and positions off its start."""
    state = scene.start(4)
    problem = default_potential().prepare(StepProblem(scene.cloth, state, scene.step_input(4, state)))
    pos = state.pos + 1e-3 * torch.sin(60 * state.pos.flip(1)) * scene.cloth.free.unsqueeze(1)
    return problem, pos


@pytest.mark.parametrize("name", ["tank_scene", "band_scene"])
def test_the_force_is_minus_the_gradient(name: str, request: pytest.FixtureRequest) -> None:
    problem, pos = problem_of(request.getfixturevalue(name))
    view = LocalTerms(default_potential(), problem)(pos)
    gradient, _ = default_potential().gradient(problem, pos)
    free = problem.cloth.free.unsqueeze(1)
    assert float((view.force + gradient * free).norm() / (gradient * free).norm()) < 1e-4
    assert not view.force[~problem.cloth.free].any()
    assert not view.step[~problem.cloth.free].any()


def test_a_vertex_alone_gains_by_its_step(band_scene: Scene) -> None:
    """With its neighbours held, a small part of a vertex's step lowers the potential, and by what a quadratic would."""
    problem, pos = problem_of(band_scene)
    view = LocalTerms(default_potential(), problem)(pos)
    before = default_potential().total(problem, pos).double()
    tried = band_scene.cloth.free.nonzero().squeeze(1)[::9]
    assert len(tried) > 5
    for vertex in tried.tolist():
        there = pos.clone()
        there[vertex] += 0.2 * view.step[vertex]
        gained = before - default_potential().total(problem, there).double()
        expected = 0.2 * float((view.step[vertex] * view.force[vertex]).sum())
        assert expected > 0
        assert 0.5 * expected < float(gained) < 1.1 * expected


@pytest.mark.parametrize("left_out", [("bending",), ("stretching",), ("stretching", "bending")])
def test_terms_that_are_left_out_have_no_part_in_it(band_scene: Scene, left_out: tuple[str, ...]) -> None:
    potential = default_potential()
    potential = potential.only({name: term for name, term in potential.terms.items() if name not in left_out})
    problem, pos = problem_of(band_scene)
    known = potential.prepare(problem)
    force = LocalTerms(potential, known)(pos).force
    expected = torch.where(problem.cloth.free.unsqueeze(1), -potential.gradient(known, pos)[0], 0.0)
    torch.testing.assert_close(force, expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))

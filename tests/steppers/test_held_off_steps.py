"""Steps that are taken again with cloth held farther off: which minimum counts."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Obstacle, State, StepInput, concatenate_obstacles
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings, Report, minimize
from hood.steppers import newton as stepping
from hood.steppers.newton import minimize_held_off
from hood.testing import grid, sphere

F64 = torch.float64


def on_balls(*heights: float, density: float = 5.0) -> StepProblem:
    """Sheets at rest, each ``height`` [m] above the top of a small ball of its own, all of them in one place."""
    edge, radius = 0.05, 0.04
    flat, faces = grid(6, 6, 5 * edge)
    poses = [torch.as_tensor(flat - [2.5 * edge, -radius - height, 2.5 * edge]) for height in heights]
    cloth = concatenate_cloths([build_cloth(pos.numpy(), faces, Material(density=density), None, dtype=F64) for pos in poses])
    body, body_faces = (torch.as_tensor(part) for part in sphere(3, radius))
    ball = Obstacle(body, body, body, body_faces, torch.zeros(len(body)).long(), torch.zeros(len(body_faces)).long())
    pos = torch.cat(poses)
    state = State(pos, torch.zeros_like(pos), torch.zeros(len(heights), 3, dtype=F64))
    dt = torch.full((len(heights),), 1 / 30, dtype=F64)
    step = StepInput(dt, obstacle=concatenate_obstacles([ball] * len(heights)))
    gravity = torch.tensor([0, -9.81, 0], dtype=F64)
    return default_potential().prepare(StepProblem(cloth, state, step, gravity=gravity).with_contact())


def solved(problem: StepProblem) -> tuple[torch.Tensor, Report]:
    return minimize(default_potential(), problem, None, NewtonSettings())


def test_a_step_with_few_triangles_in_the_skin_is_left_as_it_is() -> None:
    problem = on_balls(0.1)
    pos, report = solved(problem)
    kept = minimize_held_off(default_potential(), problem, pos, NewtonSettings(), report)
    assert kept == (problem, pos, report, 0, 0)


def test_the_minimum_with_the_fewest_triangles_in_the_skin_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = on_balls(-0.002)
    pos, report = solved(problem)
    deep = int(problem.num_in_skin(pos))
    assert deep > 0
    first = minimize_held_off(default_potential(), problem, pos, NewtonSettings(), report)
    assert int(problem.num_in_skin(first.pos)) == 0 < first.iterations
    assert first.problem.contact is not None
    assert first.problem.contact.raised is not None
    found = []

    def worse(*arguments: object) -> tuple[torch.Tensor, Report]:
        """Two minima of which the second lies as deep as the start."""
        found.append((first.pos + torch.tensor([0.0, -0.001, 0.0], dtype=F64) * len(found), report))
        return (found[-1][0], report) if len(found) == 1 else (pos, report)

    monkeypatch.setattr(stepping, "minimize", worse)
    monkeypatch.setattr(StepProblem, "with_held_off", lambda self, *_: replace(self, contact=first.problem.contact))
    kept = minimize_held_off(default_potential(), problem, pos, NewtonSettings(), report)
    assert len(found) == stepping.MOST_RAISED
    assert torch.equal(kept.pos, first.pos)
    assert kept.iterations == stepping.MOST_RAISED * report.iterations


def test_what_misses_its_target_is_not_taken_and_tried_once_more() -> None:
    problem = on_balls(-0.002)
    pos, report = solved(problem)
    short = NewtonSettings(max_iterations=1, target_rg=1e-12)
    missed = minimize_held_off(default_potential(), problem, pos, short, report)
    assert (missed.problem, missed.report, missed.iterations) == (problem, report, stepping.MOST_MISSES)
    assert torch.equal(missed.pos, pos)
    start = problem.state.pos
    _, unsolved = minimize(default_potential(), problem, start, short)
    mended = minimize_held_off(default_potential(), problem, start, NewtonSettings(), unsolved)
    assert mended.report is not None
    assert bool(mended.report.converged.all())
    assert int(problem.num_in_skin(mended.pos)) == 0


def test_a_batch_gives_what_its_members_give_alone() -> None:
    heights = (-0.002, 0.1, -0.004)
    potential: Potential = default_potential()
    together = on_balls(*heights)
    pos, report = solved(together)
    whole = minimize_held_off(potential, together, pos, NewtonSettings(), report)
    assert whole.report is not None
    counts = together.num_in_skin(whole.pos)
    assert (together.num_in_skin(pos) > 0).tolist() == [True, False, True]
    for index, height in enumerate(heights):
        alone = on_balls(height)
        own, own_report = solved(alone)
        kept = minimize_held_off(potential, alone, own, NewtonSettings(), own_report)
        size = len(own)
        torch.testing.assert_close(whole.pos[index * size : (index + 1) * size], kept.pos, rtol=0, atol=2e-5)
        assert int(alone.num_in_skin(kept.pos)) == int(counts[index]) == 0
        assert bool(whole.report.converged[index])

"""Contact with the skin that a step led into."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from corners import corner, obstacle

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import State, StepInput, concatenate_obstacles
from hood.contact.contact import find_contact
from hood.contact.further import signed_distance
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.mesh.closest_point import tree
from hood.solver.newton import NewtonSettings, minimize
from hood.steppers.newton import NewtonStepper
from hood.testing import grid, sphere

F64 = torch.float64


def pushed(way: float) -> StepProblem:
    """A sheet of 20 mm, upright, at rest 35 mm above the floor and 60 mm off the wall, which comes by ``way`` [m]."""
    flat, faces = grid(3, 3, 0.02)
    pos = flat[:, [1, 0, 2]] + [-0.06, 0.035, -0.01]
    body, body_faces = corner()
    later = body.copy()
    later[len(body) // 2 :, 0] -= way
    step = StepInput(torch.tensor([1 / 30], dtype=F64), obstacle=obstacle(body, body_faces, later))
    state = State(torch.as_tensor(pos), torch.zeros(len(pos), 3, dtype=F64), torch.zeros(1, 3, dtype=F64))
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    return StepProblem(cloth, state, step, gravity=torch.tensor([0, -9.81, 0], dtype=F64))


def test_a_wall_that_comes_within_a_step_takes_the_cloth_along() -> None:
    """Positions against the wall itself: nothing of the search is used."""
    potential, problem = default_potential(), pushed(0.08)
    known = potential.prepare(problem)
    inside, _ = minimize(potential, known, None, NewtonSettings())
    assert float(inside[:, 0].max()) > -0.08 + 0.015  # the floor is nearer at t: nothing is known of the wall
    taken = NewtonStepper(potential, NewtonSettings()).predict(problem, None)
    assert taken.metrics["solver_converged"] == 1.0
    assert float(taken.next_pos[:, 0].max()) < -0.08 + 1e-3
    assert taken.entered is not None
    assert taken.entered.contact is not None
    torch.testing.assert_close(
        taken.entered.contact.point[taken.entered.contact.valid][:, 0].max(), torch.tensor(0.0, dtype=F64)
    )


def test_calm_cloth_enters_nothing() -> None:
    taken = NewtonStepper(default_potential(), NewtonSettings()).predict(pushed(0.0), None)
    assert taken.entered is None


def test_a_step_in_a_given_time_is_not_taken_again() -> None:
    taken = NewtonStepper(default_potential(), NewtonSettings(budget_ms=1e6)).predict(pushed(0.08), None)
    assert taken.entered is None


def test_what_is_known_already_is_not_entered() -> None:
    problem = default_potential().prepare(pushed(0.08))
    there = problem.state.pos.clone()
    again = problem.with_entered(there)
    assert again is not problem
    assert again.with_entered(there) is again
    assert problem.with_entered(there - torch.tensor([0.1, 0.0, 0.0], dtype=F64)) is problem


def test_depth_is_that_of_free_vertices() -> None:
    problem = pushed(0.08)
    assert problem.next_depth(problem.state.pos) == pytest.approx(0.02, abs=1e-3)
    assert replace(problem, step=replace(problem.step, obstacle=None)).next_depth(problem.state.pos) == 0.0
    massless = replace(problem, cloth=replace(problem.cloth, mass=torch.zeros_like(problem.cloth.mass)))
    assert massless.next_depth(problem.state.pos) == 0.0
    held = default_potential().prepare(
        replace(problem, cloth=replace(problem.cloth, pinned=torch.ones_like(problem.cloth.pinned)))
    )
    assert held.next_depth(held.state.pos) == 0.0
    assert held.with_entered(held.state.pos) is held


def test_distances_of_a_batch_are_those_of_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    both = concatenate_obstacles([obstacle(*sphere(4, 0.1)), obstacle(*corner())])
    points = torch.tensor([[0.02, 0.25, 0.0], [0.0, 0.05, 0.0], [-0.06, 0.03, 0.0], [-0.2, 0.3, 0.0]], dtype=F64)
    scene = torch.arange(4) // 2
    known = find_contact(points, scene, both).dist
    assert torch.equal(signed_distance(points, scene, both.pos, both), known)
    monkeypatch.setattr(tree, "library", lambda: None)
    torch.testing.assert_close(signed_distance(points, scene, both.pos, both), known, rtol=0, atol=1e-12)

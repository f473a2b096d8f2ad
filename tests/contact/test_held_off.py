"""Cloth is held farther off where a step left its triangles in the skin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from corners import obstacle

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import State, StepInput, concatenate_obstacles
from hood.contact.further import MOST, RISE
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.mesh.penetration.crossing import crossings
from hood.solver.newton import NewtonSettings, minimize
from hood.steppers.newton import NewtonStepper, as_taken
from hood.testing import grid, sphere

F64 = torch.float64


def on_ball(height: float, edge: float = 0.03, radius: float = 0.03, density: float = 0.2, pinned: bool = False) -> StepProblem:
    """A sheet at rest whose middle, between four vertices, is ``height`` [m] above the top of a small ball."""
    flat, faces = grid(6, 6, 5 * edge)
    pos = flat - [2.5 * edge, -radius - height, 2.5 * edge]
    body, body_faces = sphere(3, radius)
    held = np.ones(len(pos), dtype=bool) if pinned else None
    cloth = build_cloth(pos, faces, Material(density=density), held, dtype=F64)
    state = State(torch.as_tensor(pos), torch.zeros(len(pos), 3, dtype=F64), torch.zeros(1, 3, dtype=F64))
    step = StepInput(torch.tensor([1 / 30], dtype=F64), obstacle=obstacle(body, body_faces))
    return StepProblem(cloth, state, step, gravity=torch.tensor([0, -9.81, 0], dtype=F64)).with_contact()


def cut(problem: StepProblem, pos: torch.Tensor) -> np.ndarray:
    body = problem.step.obstacle
    assert body is not None
    pairs = crossings(pos.numpy(), problem.cloth.faces.numpy(), body.next_pos.numpy(), body.faces.numpy()).pairs
    return np.unique(pairs[:, 0])


def test_the_corners_of_triangles_in_the_skin_rise_and_no_others() -> None:
    problem = on_ball(-0.004)
    there, faces = problem.state.pos, cut(problem, problem.state.pos)
    assert len(faces) > 1
    corners = np.unique(problem.cloth.faces.numpy()[faces])
    again = problem.with_held_off(there)
    assert again.contact is not None
    assert again.contact.raised is not None
    expected = torch.zeros(len(there), dtype=F64)
    expected[corners] = RISE
    torch.testing.assert_close(again.contact.raised, expected)
    for _ in range(round(MOST / RISE)):
        again = again.with_held_off(there)
    assert again.contact is not None
    torch.testing.assert_close(again.contact.raised, expected * (MOST / RISE))
    assert again.with_held_off(there) is again


def test_cloth_outside_is_left_as_it_is() -> None:
    problem = on_ball(0.004)
    assert problem.with_held_off(problem.state.pos) is problem
    held = on_ball(-0.004, pinned=True)
    assert held.with_held_off(held.state.pos) is held
    bare = replace(problem, contact=None, step=replace(problem.step, obstacle=None))
    assert bare.with_held_off(bare.state.pos) is bare


def test_scenes_that_lie_in_one_place_are_not_compared() -> None:
    """The first sheet hangs where the second one's ball is."""
    high, low = on_ball(0.02), on_ball(-0.004)
    counts = [high.cloth.num_vertices, low.cloth.num_vertices]
    own = concatenate_obstacles([problem.step.obstacle for problem in (high, low)])
    pos = torch.cat([high.state.pos, low.state.pos])
    state = State(pos, torch.zeros_like(pos), torch.zeros(2, 3, dtype=F64))
    cloth = concatenate_cloths([high.cloth, low.cloth])
    both = StepProblem(cloth, state, StepInput(torch.full((2,), 1 / 30, dtype=F64), obstacle=own)).with_contact()
    again, alone = both.with_held_off(pos).contact, low.with_held_off(low.state.pos).contact
    assert again is not None
    assert alone is not None
    assert again.raised is not None
    assert alone.raised is not None
    assert torch.equal(again.raised[: counts[0]], torch.zeros(counts[0], dtype=F64))
    assert torch.equal(again.raised[counts[0] :], alone.raised)


def test_a_step_of_the_solver_leaves_no_triangles_in_the_skin() -> None:
    """Heavy, coarse cloth that starts in it; what the step was taken with is what it is judged by."""
    potential, problem = default_potential(), on_ball(-0.002, edge=0.05, radius=0.04, density=5.0)
    known = potential.prepare(problem)
    before, _ = minimize(potential, known, None, NewtonSettings())
    taken = NewtonStepper(potential, NewtonSettings()).predict(problem, None)
    assert len(cut(problem, before)) > 0
    assert len(cut(problem, taken.next_pos)) == 0
    assert taken.held_off is not None
    gradient, _ = potential.gradient(as_taken(known, taken), taken.next_pos)
    assert float(gradient.norm()) < 0.05 * float((9.81 * problem.cloth.mass).norm())
    hurried = NewtonStepper(potential, NewtonSettings(budget_ms=1e6)).predict(problem, None)
    assert hurried.held_off is None

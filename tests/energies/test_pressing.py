"""Friction by the contact's own force: bounded by what presses the cloth onto the skin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, State
from hood.contact.sample_points import PointContact
from hood.energies.friction import Friction
from hood.energies.potential import Potential, default_potential, reference_potential
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import implicit_euler
from hood.testing import grid, make_problem, sphere

F64 = torch.float64
G = 9.81


def on(body: tuple[np.ndarray, np.ndarray], height: float, size: float = 0.2, cells: int = 6) -> StepProblem:
    """A level sheet whose middle is ``height`` [m] above the origin, over a body at rest."""
    pos, faces = grid(cells, cells, size)
    cloth = build_cloth(pos + np.array([-size / 2, height, -size / 2]), faces, Material(), dtype=F64)
    problem = make_problem(cloth)
    now, corners = (torch.as_tensor(part) for part in body)
    obstacle = Obstacle(now, now, now, corners, torch.zeros(len(now)).long(), torch.zeros(len(corners)).long())
    gravity = torch.tensor([0.0, -G, 0.0], dtype=F64)
    return replace(problem, step=replace(problem.step, obstacle=obstacle), gravity=gravity)


def floor() -> tuple[np.ndarray, np.ndarray]:
    pos, faces = grid(9, 9, 2.0)
    return pos - np.array([1.0, 0.0, 1.0]), faces


def friction(potential: Potential) -> Friction:
    term = potential.terms["friction"]
    assert isinstance(term, Friction)
    return term


def force(potential: Potential, problem: StepProblem) -> torch.Tensor:
    assert problem.contact is not None
    return friction(potential).normal_force(problem, problem.contact)


def penalty(potential: Potential, problem: StepProblem) -> torch.Tensor:
    assert problem.contact is not None
    return 3.0 * friction(potential).weight * (2e-3 - problem.contact.dist).clamp_min(0.0) ** 2


@pytest.mark.parametrize("depth", [1e-3, 6e-3])
@pytest.mark.parametrize("speed", [0.0, -1.0, 3.0])
def test_deep_cloth_at_rest_shape_is_held_by_no_more_than_stops_it(depth: float, speed: float) -> None:
    """No pull: m/dt² times the way out of where it would fly, whatever the penalty says; nothing where it flies off anyway."""
    potential, dt = default_potential(), 1 / 30
    problem = on(floor(), -depth)
    problem = replace(problem, state=replace(problem.state, vel=torch.tensor([0.0, speed, 0.0], dtype=F64).expand(36, 3)))
    problem = potential.prepare(problem)
    ballistic_position = -depth + dt * speed - dt**2 * G
    expected = problem.cloth.mass / dt**2 * max(2e-3 - ballistic_position, 0.0)
    assert float((penalty(potential, problem) / problem.cloth.mass / G).min()) > 100
    torch.testing.assert_close(force(potential, problem), expected, rtol=1e-6, atol=1e-9)


def test_cloth_that_lies_still_and_cloth_over_a_ball_keep_the_contacts_own_force() -> None:
    """At rest what presses is what the contact carries: friction is as without the bound."""
    potential = default_potential()
    for body, height in ((floor(), 2e-3), (sphere(3, 0.1), 0.106)):
        for taken in implicit_euler(potential, on(body, height), 40, NewtonSettings(target_rg=1e-6, linear="direct")):
            assert taken.report.converged.all()
        last = potential.prepare(replace(taken.problem, state=taken.state, contact=None, internal_force=None))
        still = State(last.state.pos, torch.zeros_like(last.state.vel), last.state.origin)
        last = replace(last, state=still)
        unbounded = force(
            potential, replace(last, internal_force=torch.full_like(last.state.pos, -1e6) * last.contact.next_normal)
        )  # type: ignore[union-attr]
        assert float(unbounded.sum()) > 0.9 * float(last.cloth.mass.sum()) * G
        assert float((unbounded - force(potential, last)).abs().sum()) < 0.02 * float(unbounded.sum())


def test_stretched_cloth_presses_with_its_tension() -> None:
    """A sheet pulled down at its rim over a ball grips far beyond its weight."""
    potential = default_potential()
    problem = on(sphere(3, 0.1), 0.103)
    pos = problem.state.pos.clone()
    pos[:, 1] -= 0.6 * pos[:, [0, 2]].square().sum(dim=1).sqrt()
    problem = potential.prepare(replace(problem, state=replace(problem.state, pos=pos)))
    assert problem.internal_force is not None
    contact = problem.contact
    assert contact is not None
    pressed = -(problem.internal_force * contact.next_normal).sum(dim=1)
    rows = (penalty(potential, problem) > 0) & (pressed > 50 * problem.cloth.mass * G)
    assert int(rows.sum()) > 0
    assert bool((force(potential, problem)[rows] > 30 * problem.cloth.mass[rows] * G).any())


def test_every_other_term_pulls() -> None:
    """Also one that the package does not know; inertia, weight and the body do not."""

    class Wind:
        def applies(self, problem: StepProblem) -> bool:
            return True

        def __call__(self, problem: StepProblem, next_pos: torch.Tensor, acc: torch.Tensor) -> torch.Tensor:
            return problem.sum_vertices(0.03 * next_pos[:, 1])

    problem = on(floor(), 1e-3)
    calm, windy = (default_potential(), default_potential().with_terms(wind=Wind()))
    still, pressed = calm.prepare(problem), windy.prepare(problem)
    assert still.internal_force is not None
    assert pressed.internal_force is not None
    torch.testing.assert_close(
        pressed.internal_force - still.internal_force, torch.tensor([0.0, -0.03, 0.0], dtype=F64).expand(36, 3)
    )
    assert float((force(windy, pressed) - force(calm, still)).min()) == pytest.approx(0.03)
    assert calm.prepare(still) is still


def test_who_does_not_ask_gets_no_pull_and_who_asks_too_late_is_refused() -> None:
    problem = on(floor(), 1e-3)
    assert reference_potential().prepare(problem).internal_force is None
    assert default_potential(friction_coefficient=0.0).prepare(problem).internal_force is None
    potential = default_potential()
    with pytest.raises(ValueError, match="internal force not known yet"):
        potential.total(problem.with_fold(), problem.state.pos)


def test_points_of_edges_are_bounded_as_well() -> None:
    potential = default_potential(contact="edges")
    problem = potential.prepare(on(floor(), -6e-3))
    points = problem.points_at("edges")
    assert isinstance(points, PointContact)
    found = friction(potential).point_force(problem, points)
    carried = (problem.cloth.mass[points.vertices] * points.weights).sum(dim=1)
    expected = points.share * carried * 900.0 * (8e-3 + G / 900.0)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)


def test_both_forms_of_the_pull_agree() -> None:
    potential, problem = default_potential(), on(sphere(3, 0.1), 0.103).with_contact()
    noise = 1e-3 * torch.as_tensor(np.random.default_rng(0).normal(size=(36, 3)))
    problem = replace(problem, state=replace(problem.state, pos=problem.state.pos + noise))
    found = [potential.with_internal_force(problem, compiled).internal_force for compiled in (True, False)]
    assert found[0] is not None
    torch.testing.assert_close(found[0], found[1], rtol=1e-9, atol=1e-12)

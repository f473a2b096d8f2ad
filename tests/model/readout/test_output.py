"""From raw network output to displacements: accelerations, and corrections to a base that moves with the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, State, StepInput
from hood.contact.contact import find_contact
from hood.energies.problem import StepProblem
from hood.model.readout.output import AccelerationOutput, VelocityBaseOutput
from hood.testing import sphere

RADIUS = 0.2


def ball_problem(turn: np.ndarray, move: np.ndarray, gap: float = 4e-3, vel: float = 0.0, rounds: int = 2) -> StepProblem:
    """A spherical cloth, an icosahedron divided in ``rounds``, around a ball that makes a rigid motion."""
    pos, faces = sphere(3, RADIUS)
    cloth_pos, cloth_faces = sphere(rounds, RADIUS + gap)
    cloth = build_cloth(cloth_pos, cloth_faces, Material(), dtype=torch.float64)
    now = torch.as_tensor(pos)
    after = torch.as_tensor(pos @ turn.T + move)
    obstacle = Obstacle(now, after, now, torch.as_tensor(faces), torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long())
    state = State(cloth.rest_pos, torch.full_like(cloth.rest_pos, vel), torch.zeros(1, 3).double())
    step = StepInput(dt=torch.tensor([1 / 30]).double(), obstacle=obstacle)
    contact = find_contact(state.pos, cloth.vertex_scene, obstacle)
    return StepProblem(cloth, state, step, contact, torch.tensor([0, -9.81, 0]).double())


def test_base_of_cloth_on_a_translating_body_moves_along_exactly() -> None:
    move = np.array([0.03, -0.01, 0.02])
    problem = ball_problem(np.eye(3), move)
    base = VelocityBaseOutput().base(problem)
    torch.testing.assert_close(base, problem.state.pos + torch.as_tensor(move), rtol=0, atol=1e-9)


def test_base_of_cloth_on_a_turning_body_follows_it() -> None:
    """A turn of 2 degrees moves the cloth by 7 mm; the averages over neighbours lose little of it."""
    turn = Rotation.from_rotvec([0.0, np.radians(2), 0.0]).as_matrix()
    problem = ball_problem(turn, np.zeros(3))
    base = VelocityBaseOutput().base(problem)
    target = problem.state.pos @ torch.as_tensor(turn).T
    assert float((target - problem.state.pos).norm(dim=1).max()) > 6e-3
    assert float((base - target).norm(dim=1).max()) < 6e-4


def test_base_does_not_carry_the_velocity_on() -> None:
    still = ball_problem(np.eye(3), np.zeros(3))
    fast = ball_problem(np.eye(3), np.zeros(3), vel=5.0)
    torch.testing.assert_close(VelocityBaseOutput().base(still), VelocityBaseOutput().base(fast))


def test_base_is_outside_the_body() -> None:
    """Cloth that starts 1 cm inside, and a body that comes 3 cm nearer."""
    move = np.array([0.0, 0.0, 0.03])
    problem = ball_problem(np.eye(3), move, gap=-0.01)
    base = VelocityBaseOutput(clearance=2e-3).base(problem)
    obstacle = problem.step.obstacle
    assert obstacle is not None
    after = replace(obstacle, pos=obstacle.next_pos)
    contact = find_contact(base, problem.cloth.vertex_scene, after)
    assert float(problem.contact.dist.min()) < -0.009
    assert float(contact.dist.min()) > 1.5e-3


def test_pins_are_trusted() -> None:
    problem = ball_problem(np.eye(3), np.zeros(3), gap=0.05)
    pinned = torch.zeros(problem.cloth.num_vertices, dtype=torch.bool)
    pinned[:80] = True
    target = problem.state.pos + torch.tensor([0.0, 0.0, 0.01]).double()
    moved = replace(problem, cloth=replace(problem.cloth, pinned=pinned), step=replace(problem.step, pin_target=target))
    shift = (VelocityBaseOutput().base(moved) - problem.state.pos)[:, 2]
    assert float(shift[pinned].mean()) > 0.007
    assert 0.0005 < float(shift[~pinned].mean()) < float(shift[pinned].mean())


def test_without_a_body_the_base_is_the_inertial_guess() -> None:
    problem = replace(ball_problem(np.eye(3), np.zeros(3), vel=3.0), contact=None)
    torch.testing.assert_close(VelocityBaseOutput().base(problem), problem.state.pos + 0.1)


def test_one_scene_does_not_see_the_other() -> None:
    """The averages run along edges only."""
    from hood.cloth.cloth import concatenate_cloths
    from hood.cloth.state import concatenate_states, concatenate_step_inputs

    problems = [ball_problem(np.eye(3), np.array(move)) for move in ([0.02, 0, 0], [0, 0.03, 0])]
    cloth = concatenate_cloths([p.cloth for p in problems])
    state = concatenate_states([p.state for p in problems])
    step = concatenate_step_inputs([p.step for p in problems], [p.cloth.num_vertices for p in problems])
    contact = find_contact(state.pos, cloth.vertex_scene, step.obstacle)
    together = VelocityBaseOutput().base(StepProblem(cloth, state, step, contact))
    alone = torch.cat([VelocityBaseOutput().base(p) for p in problems])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-10)


def test_corrections_are_scaled() -> None:
    assert VelocityBaseOutput(scale=0.01).displacement(torch.ones(2, 3)).tolist() == [pytest.approx([0.01] * 3)] * 2


def test_accelerations_are_denormalised_by_what_was_observed() -> None:
    output = AccelerationOutput()
    raw = torch.randn(5, 3)
    torch.testing.assert_close(output.displacement(raw), raw)
    observed = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0)) * 0.002 + torch.tensor([0, -0.01, 0])
    for part in observed.split(100):
        output.observe(part)
    mean, std = observed.mean(dim=0), observed.std(dim=0)
    torch.testing.assert_close(output.displacement(torch.zeros(1, 3))[0], mean, rtol=0, atol=2e-4)
    torch.testing.assert_close(output.displacement(torch.ones(1, 3))[0], mean + std, rtol=0, atol=3e-4)


def test_acceleration_base_is_the_inertial_guess() -> None:
    problem = ball_problem(np.eye(3), np.zeros(3), vel=0.6)
    torch.testing.assert_close(AccelerationOutput().base(problem), problem.state.pos + 0.02)

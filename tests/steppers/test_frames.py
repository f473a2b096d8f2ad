"""Conventions about time, pinned vertices and velocities, one by one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, State, StepInput
from hood.contact.contact import find_contact
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.rollouts.loop import simulate, start_state
from hood.scene.scene import Scene
from hood.steppers.network import NetworkStepper, Prediction, build_simulator
from hood.steppers.protocol import FrameRules, Relaxing
from hood.testing import grid, sphere

DT = 1 / 30


def make_problem(dt: float = DT) -> StepProblem:
    """A sheet above a ball; the first row is pinned and its targets are 2 cm lower."""
    pos, faces = grid(5, 5, 0.2)
    cloth = build_cloth(pos, faces, Material(), np.arange(25) < 5, dtype=torch.float64)
    ball, ball_faces = sphere(2, 0.1)
    surface, scene = torch.as_tensor(ball - [0, 0.11, 0]), torch.zeros(len(ball), dtype=torch.int64)
    faces_scene = torch.zeros(len(ball_faces), dtype=torch.int64)
    obstacle = Obstacle(surface, surface, surface, torch.as_tensor(ball_faces), scene, faces_scene, scene.bool())
    target = cloth.rest_pos - torch.tensor([0, 0.02, 0]).double()
    vel = torch.ones_like(cloth.rest_pos)
    state = State(cloth.rest_pos, vel, torch.zeros(1, 3).double())
    step = StepInput(torch.tensor([dt]).double(), obstacle, target)
    return StepProblem(cloth, state, step, find_contact(state.pos, cloth.vertex_scene, obstacle))


def test_the_defaults_change_nothing() -> None:
    problem = make_problem(1 / 60)
    assert FrameRules().enter(problem) is problem
    acc = torch.ones_like(problem.state.pos)
    expected = problem.state.vel + problem.vertex_dt * acc
    assert torch.equal(FrameRules().next_velocity(problem, acc), expected)


def test_pinned_vertices_stand_at_their_targets() -> None:
    problem = make_problem()
    pinned = problem.cloth.pinned
    seen = FrameRules(pins_ahead=True).enter(problem)
    assert torch.equal(seen.state.pos[pinned], problem.step.pin_target[pinned])
    assert torch.equal(seen.state.pos[~pinned], problem.state.pos[~pinned])
    torch.testing.assert_close(seen.state.vel[pinned] * DT, (problem.step.pin_target - problem.state.pos)[pinned])
    assert torch.equal(seen.state.vel[~pinned], problem.state.vel[~pinned])
    there = torch.cdist(seen.state.pos, problem.step.obstacle.pos)
    nearest = tiny(body_radius=10.0).nearest(problem, seen)
    torch.testing.assert_close(nearest.dist, there.min(dim=1).values)
    torch.testing.assert_close(there.gather(1, nearest.vertex.unsqueeze(1)).squeeze(1), nearest.dist)
    assert not torch.equal(nearest.dist[pinned], problem.contact.vertex_dist[pinned])
    carried = FrameRules(pins_ahead=True, velocity="carried")
    assert torch.equal(carried.enter(problem).state.vel, problem.state.vel)
    following = carried.next_velocity(problem, torch.ones_like(problem.state.pos))
    assert not bool(following[pinned].any())
    assert bool((following[~pinned] > 1).all())


@pytest.mark.parametrize("dt", [DT, 1 / 3])
def test_a_step_in_frames_lasts_a_frame_whatever_its_dt(dt: float) -> None:
    """x_{t+1} − x_t = (v + a) frames, and that is the next velocity; the acceleration still is that of the step's own dt."""
    problem, rules = make_problem(dt), FrameRules(frame_dt=DT, velocity="carried")
    seen = rules.enter(problem)
    assert seen.vertex_dt.unique().item() == pytest.approx(DT)
    displacement = torch.full_like(problem.state.pos, 3e-3)
    acc = rules.acceleration(problem, displacement)
    moved = problem.state.vel * DT + displacement
    torch.testing.assert_close(problem.vertex_dt * problem.state.vel + problem.vertex_dt**2 * acc, moved)
    expected = torch.where(problem.cloth.pinned.unsqueeze(1), 0.0, moved)
    torch.testing.assert_close(rules.next_velocity(problem, acc) * DT, expected)


def test_differences_of_positions_drop_the_relaxing_displacement() -> None:
    """The velocity after the relaxing step is 0, in its scene alone; the displacement itself stays."""
    rules, acc = FrameRules(frame_dt=DT), torch.ones(25, 3).double()
    relaxed, regular = (rules.next_velocity(make_problem(dt), acc) for dt in (1 / 3, DT))
    assert not bool(relaxed.any())
    torch.testing.assert_close(regular, 1 + DT * acc)
    slow = FrameRules(frame_dt=1 / 3)  # frames as long as a relaxing step: nothing tells them apart, and nothing is dropped
    assert bool(slow.next_velocity(make_problem(1 / 3), acc).all())


@pytest.mark.parametrize(
    "options, relaxing",
    [
        ({}, Relaxing.SETTLE),
        ({"velocity": "carried"}, Relaxing.SETTLE),
        ({"frame_dt": DT, "velocity": "carried"}, Relaxing.CARRY),
        ({"frame_dt": DT}, Relaxing.RESTART),
    ],
)
def test_what_becomes_of_the_relaxing_step(options: dict, relaxing: Relaxing) -> None:
    assert FrameRules(**options).relaxing is relaxing
    assert tiny(**options).relaxing is relaxing


def test_another_frame_rate_is_refused() -> None:
    with pytest.raises(ValueError, match=r"frames of 1/30 s, the step of scene 0 lasts 0\.0166667 s; use fps=30"):
        FrameRules(frame_dt=DT).enter(make_problem(1 / 60))


@pytest.mark.parametrize(
    "options, words",
    [
        ({"frame_dt": 0.0}, "model.frame_dt is 0.0"),
        ({"velocity": "carry"}, "model.velocity is 'carry'; choose displacement or carried"),
        ({"embedded_levels": 0}, "model.embedded_levels is 0"),
        ({"coarse_encoders": 0}, "model.coarse_encoders is 0"),
        ({"divisor_floor": 0.0}, "divisor_floor is 0.0"),
        ({"body_velocity": "now"}, "body is 'now'"),
    ],
)
def test_wrong_conventions_are_named(options: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        build_simulator(latent_dim=4, **options)


def tiny(**options: object) -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator(schedule="1x(mesh)", latent_dim=4, output_init=0.01, **options).eval()


@torch.no_grad()
def test_the_relaxing_step_of_a_model_in_frames_is_kept(skirt_scene: Scene) -> None:
    simulator = tiny(frame_dt=DT, pins_ahead=True, velocity="carried")
    start = skirt_scene.start(0, relaxed=False, thorough=True)
    state = start_state(simulator, skirt_scene, default_potential(), 1)
    moved = state.pos - start.pos
    pinned = skirt_scene.cloth.pinned
    assert float(moved[~pinned].abs().max()) > 1e-4
    torch.testing.assert_close(state.vel[~pinned] * DT, moved[~pinned], rtol=0, atol=1e-6)
    assert not bool(state.vel[pinned].any())
    unrelaxed = start_state(simulator, skirt_scene, default_potential(), 0)
    assert torch.equal(unrelaxed.vel, skirt_scene.start_velocity(0))


@torch.no_grad()
def test_a_restart_relaxes_on_the_way_to_the_first_frame(skirt_scene: Scene) -> None:
    """Frame 0 is the settled start; the step to frame 1 moves body and pins, sees 1/3 s, and ends at rest."""
    simulator = tiny(frame_dt=DT, pins_ahead=True, body_velocity="next")
    steps: list[tuple[StepProblem, torch.Tensor]] = []

    def keep(frame: int, problem: StepProblem, prediction: Prediction) -> None:
        steps.append((problem, simulator.next_velocity(problem, prediction)))

    frames = list(simulate(simulator, skirt_scene, default_potential(), 3, observe=keep))
    start = skirt_scene.start(0, relaxed=False, thorough=True)
    assert torch.equal(frames[0].state.pos, start.pos)
    assert not bool(frames[0].state.vel.any())
    (relaxing, after), (regular, _) = steps
    assert [float(problem.step.dt) for problem in (relaxing, regular)] == pytest.approx([1 / 3, DT])
    assert not torch.equal(relaxing.step.obstacle.pos, relaxing.step.obstacle.next_pos)
    pinned = skirt_scene.cloth.pinned
    assert torch.equal(frames[1].state.pos[pinned], relaxing.step.pin_target[pinned])
    assert not bool(after.any())
    assert torch.equal(regular.state.vel, after)
    assert bool((frames[1].state.pos[~pinned] != frames[0].state.pos[~pinned]).all())
    unrelaxed = list(simulate(simulator, skirt_scene, default_potential(), 2, relaxing_steps=0, observe=keep))
    assert torch.equal(unrelaxed[0].state.vel, skirt_scene.start_velocity(0))
    assert float(steps[-1][0].step.dt) == pytest.approx(DT)
    twice = next(simulate(simulator, skirt_scene, default_potential(), 1, relaxing_steps=2))
    assert not torch.equal(twice.state.pos, start.pos)
    assert not bool(twice.state.vel.any())


def test_the_level_feature_asks_for_its_levels() -> None:
    assert tiny(embedded_levels=4).num_coarse == 3
    assert tiny().num_coarse == 0
    shared = build_simulator(schedule="1x(coarse0+coarse1)", latent_dim=4, coarse_encoders=1)
    assert shared.network.edge_encoder("coarse0") is shared.network.edge_encoder("coarse1")
    spare = build_simulator(schedule="1x(mesh+coarse0)", latent_dim=4, coarse_encoders=3)
    assert list(spare.network.edge_encoders) == ["mesh", "coarse0", "coarse1", "coarse2", "body"]

"""The learned step: what holds for any weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from small_simulators import KINDS, SCHEDULE, make, take

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence, turn_world
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import State, StepInput, concatenate_states, concatenate_step_inputs
from hood.energies.problem import StepProblem
from hood.model.graph.hierarchy import build_hierarchy
from hood.scene.scene import Scene, build_scene
from hood.steppers.network import build_simulator
from hood.testing import grid


@pytest.mark.parametrize("kind", KINDS)
def test_same_seed_same_result(kind: str, tank_scene: Scene) -> None:
    first, second, other = (take(make(kind, seed), tank_scene)[1] for seed in (0, 0, 1))
    assert torch.equal(first.pos, second.pos)
    assert torch.equal(first.vel, second.vel)
    assert not torch.equal(first.pos, other.pos)


@pytest.mark.parametrize("kind", KINDS)
def test_step_writes_nothing_into_its_input(kind: str, skirt_scene: Scene) -> None:
    simulator = make(kind)
    state = skirt_scene.start(0)
    step = skirt_scene.step_input(0, state)
    before = [state.pos.clone(), state.vel.clone(), step.obstacle.pos.clone(), step.pin_target.clone()]
    weights = {name: value.clone() for name, value in simulator.state_dict().items()}
    with torch.no_grad():
        simulator.step(skirt_scene.cloth, simulator.prepare(skirt_scene.cloth, skirt_scene.garment.rest_pos), state, step)
    for old, new in zip(before, (state.pos, state.vel, step.obstacle.pos, step.pin_target), strict=True):
        assert torch.equal(old, new)
    assert all(torch.equal(value, weights[name]) for name, value in simulator.state_dict().items())


@pytest.mark.parametrize("kind", KINDS)
def test_pinned_vertices_reach_their_targets_bit_by_bit(kind: str, skirt_scene: Scene) -> None:
    state, after = take(make(kind), skirt_scene)
    target = skirt_scene.step_input(0, state).pin_target
    pinned = skirt_scene.cloth.pinned
    assert torch.equal(after.pos[pinned], target[pinned])
    assert not torch.equal(after.pos[~pinned], target[~pinned])
    # Their velocity is that of the motion they made.
    made = (after.pos - state.pos)[pinned] * 30
    torch.testing.assert_close(after.vel[pinned], made, rtol=0, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_velocity_is_the_displacement_over_dt(kind: str, tank_scene: Scene) -> None:
    state, after = take(make(kind), tank_scene)
    torch.testing.assert_close(after.vel, (after.pos - state.pos) * 30, rtol=0, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_gives_what_its_members_give(kind: str, tank_scene: Scene, skirt_scene: Scene) -> None:
    simulator = make(kind)
    scenes = (tank_scene, skirt_scene, tank_scene)
    frames = (0, 2, 5)
    states = [scene.start(frame) for scene, frame in zip(scenes, frames, strict=True)]
    steps = [s.step_input(frame, state) for s, frame, state in zip(scenes, frames, states, strict=True)]
    prepared = [simulator.prepare(s.cloth, s.garment.rest_pos) for s in scenes]
    counts = [s.cloth.num_vertices for s in scenes]
    cloth = concatenate_cloths([s.cloth for s in scenes])
    with torch.no_grad():
        alone = [
            simulator.step(s.cloth, p, state, step) for s, p, state, step in zip(scenes, prepared, states, steps, strict=True)
        ]
        together = simulator.step(
            cloth,
            simulator.concatenate(cloth, prepared, counts),
            concatenate_states(states),
            concatenate_step_inputs(steps, counts),
        )
    assert float((together.pos - torch.cat([s.pos for s in alone])).abs().max()) < 1e-5
    assert float((together.vel - torch.cat([s.vel for s in alone])).abs().max()) < 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_a_translated_world_gives_the_translated_step(
    kind: str, body: Body, garments: dict[str, Garment], walk: PoseSequence
) -> None:
    near = walk.window(60, 63)
    shift = np.array([100.0, 2.0, -50.0])
    simulator = make(kind)
    results = []
    for sequence in (near, replace(near, transl=near.transl + shift)):
        _, after = take(simulator, build_scene(garments["tank"], body, sequence))
        results.append(after.pos.double() + after.origin)
    assert float((results[1] - results[0] - torch.as_tensor(shift)).abs().max()) < 2e-5


@pytest.mark.parametrize("kind", KINDS)
def test_a_turned_world_turns_the_base(kind: str, body: Body, garments: dict[str, Garment], walk: PoseSequence) -> None:
    """Zero output: what the physics around the network contributes has no preferred direction."""
    near = walk.window(60, 63)
    turn = Rotation.from_rotvec([0.0, 1.2, 0.0]).as_matrix()
    simulator = make(kind, output_init=0.0)
    results = []
    for sequence in (near, turn_world(near, turn)):
        scene = build_scene(garments["tank"], body, sequence, dtype=torch.float64)
        _, after = take(simulator.double(), scene)
        results.append((after.pos + after.origin).numpy())
    np.testing.assert_allclose(results[1], results[0] @ turn.T, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_no_body_at_all(kind: str) -> None:
    pos, faces = grid(6, 6, 0.3)
    cloth = build_cloth(pos, faces, Material())
    simulator = make(kind)
    state = State(cloth.rest_pos, torch.zeros_like(cloth.rest_pos), torch.zeros(1, 3).double())
    step = StepInput(dt=torch.tensor([1 / 30]))
    assert simulator.search(StepProblem(cloth, state, step)).contact is None
    with torch.no_grad():
        after = simulator.step(cloth, simulator.prepare(cloth, pos), state, step)
    assert bool(torch.isfinite(after.pos).all())
    assert not torch.equal(after.pos, state.pos)


@pytest.mark.parametrize("kind", KINDS)
def test_a_massless_isolated_vertex_stays_put(kind: str) -> None:
    pos, faces = grid(5, 5, 0.3)
    pos = np.concatenate([pos, [[0.1, 0.2, 0.1]]])
    cloth = build_cloth(pos, faces, Material())
    simulator = make(kind)
    state = State(cloth.rest_pos, torch.ones_like(cloth.rest_pos), torch.zeros(1, 3).double())
    with torch.no_grad():
        after = simulator.step(cloth, simulator.prepare(cloth, pos), state, StepInput(dt=torch.tensor([1 / 30])))
    assert torch.equal(after.pos[-1], state.pos[-1])
    assert float(after.vel[-1].abs().max()) < 1e-6
    assert bool(torch.isfinite(after.pos).all())


def test_pins_without_targets_stay() -> None:
    pos, faces = grid(4, 4, 0.3)
    pinned = np.arange(16) < 4
    cloth = build_cloth(pos, faces, Material(), pinned)
    simulator = make("paper")
    state = State(cloth.rest_pos, torch.zeros_like(cloth.rest_pos), torch.zeros(1, 3).double())
    with torch.no_grad():
        after = simulator.step(cloth, simulator.prepare(cloth, pos), state, StepInput(dt=torch.tensor([1 / 30])))
    assert torch.equal(after.pos[:4], state.pos[:4])


def test_acceleration_and_position_of_a_prediction_agree(tank_scene: Scene) -> None:
    """In float64, where the difference of positions is exact enough to compare with."""
    for kind in KINDS:
        simulator = make(kind).double()
        garment = tank_scene.garment
        cloth = build_cloth(garment.rest_pos, garment.faces, Material(), dtype=torch.float64)
        vel = 0.1 * torch.ones_like(cloth.rest_pos)
        state = State(cloth.rest_pos, vel, torch.zeros(1, 3).double())
        problem = StepProblem(cloth, state, StepInput(dt=torch.tensor([1 / 30]).double()), None, simulator.gravity)
        with torch.no_grad():
            prediction = simulator.predict(problem, simulator.prepare(cloth, garment.rest_pos))
        torch.testing.assert_close(prediction.acc, problem.acceleration(prediction.next_pos), rtol=0, atol=1e-8)


def test_garments_that_share_their_vertices_do_not_share_a_graph() -> None:
    """The hierarchy is kept per array of vertices; other faces on the same array need their own."""
    pos, faces = grid(7, 7, 0.3)
    simulator = make("paper")
    whole = simulator.prepare(build_cloth(pos, faces, Material()), pos)
    half = simulator.prepare(build_cloth(pos, faces[::2], Material()), pos)
    assert not torch.equal(whole.hierarchy.node_level, half.hierarchy.node_level)
    again = simulator.prepare(build_cloth(pos, faces, Material()), pos)
    assert torch.equal(again.hierarchy.node_level, whole.hierarchy.node_level)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"features": "papper"}, ("model.features", "'papper'", "paper or physical")),
        ({"output": "velocity"}, ("model.output", "'velocity'", "velocity_base")),
        ({"features": "physical", "output": "acceleration"}, ("model.features=physical", "model.output=velocity_base")),
        ({"features": "paper", "output": "edges"}, ("model.output=edges", "model.features=physical")),
        ({"features": "physical", "output": "edges", "schedule": "1x(coarse0)"}, ("mesh", "1x(mesh)")),
        ({"features": "local", "output": "edges", "schedule": "1x(mesh) | 1x(mesh)"}, ("several passes", "not edges")),
        ({"schedule": "ourz"}, ("'ourz'", "did you mean 'ours'")),
        ({"schedule": "3x(mehs)"}, ("'mehs'", "did you mean 'mesh'")),
        ({"aggregation": "max"}, ("aggregation", "'max'")),
        ({"latent_dim": 0}, ("model.latent_dim", "> 0")),
        ({"body_radius": -0.1}, ("model.body_radius", "> 0")),
        ({"output_scale": 0.0}, ("model.output_scale", "> 0")),
        ({"coarse_edge": 0.0}, ("model.coarse_edge", "> 0")),
        ({"coarse_edge": "wide"}, ("model.coarse_edge is 'wide'", "a number")),
        ({"normalizer_decay": 1.5}, ("decay", "1.5")),
    ],
)
def test_wrong_arguments_are_named(options: dict, words: tuple[str, ...]) -> None:
    with pytest.raises(ValueError) as error:
        build_simulator(**{"schedule": SCHEDULE, "latent_dim": 4, **options})
    assert all(word in str(error.value) for word in words), str(error.value)


def test_a_clone_is_equal_and_independent(tank_scene: Scene) -> None:
    simulator = make("paper")
    generator = torch.get_rng_state()
    clone = simulator.clone()
    assert torch.equal(torch.get_rng_state(), generator)
    with torch.no_grad():
        next(clone.parameters()).add_(1.0)
    assert not torch.equal(next(clone.parameters()), next(simulator.parameters()))


@pytest.mark.parametrize("kind", KINDS)
def test_levels_finer_than_the_coarse_edge_are_passed_over(kind: str, tank_scene: Scene) -> None:
    cloth, rest_pos = tank_scene.cloth, tank_scene.garment.rest_pos
    usual, wide = make(kind), make(kind, coarse_edge=3.0 * cloth.mean_edge)
    assert "coarse_edge" not in usual.config
    (taken,) = wide.prepare(cloth, rest_pos).hierarchy.coarse_edges
    (second,) = build_hierarchy(cloth.num_vertices, cloth.edges.numpy(), rest_pos, 1, passed_over=1).coarse_edges
    assert torch.equal(taken, second)
    assert len(taken) < len(usual.prepare(cloth, rest_pos).hierarchy.coarse_edges[0])
    (_, one), (_, other) = take(usual, tank_scene), take(wide, tank_scene)
    assert torch.isfinite(other.pos).all()
    assert not torch.equal(one.pos, other.pos)
    # Meshes whose edges are long enough keep all levels.
    assert torch.equal(take(make(kind, coarse_edge=2.0 * cloth.mean_edge), tank_scene)[1].pos, one.pos)

"""Scenes: start, prescribed steps, moving frames, batches of steps."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.state import Attachments, State, StepInput, concatenate_step_inputs
from hood.scene.scene import RELAXING_DT, Scene, build_scene, recentre


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 3e-8), (torch.float64, 1e-9)])
def test_recentre_keeps_world_positions(dtype: torch.dtype, tolerance: float) -> None:
    """Float32 allows half a unit in the last place of a metre."""
    generator = torch.Generator().manual_seed(0)
    pos = torch.rand(60, 3, dtype=dtype, generator=generator) + torch.tensor([1.3, -0.2, 2.7], dtype=dtype)
    scene = torch.arange(60) // 20
    origin = torch.tensor([[0.0, 0, 0], [5000.25, 0, -3.5], [1e4, 1, 2]], dtype=torch.float64)
    state = State(pos, torch.zeros_like(pos), origin)
    moved = recentre(state, scene)
    assert not torch.equal(moved.origin, origin)
    before, after = (s.origin[scene] + s.pos.double() for s in (state, moved))
    assert float((before - after).abs().max()) <= tolerance
    # The cloth is now near its origin, and stays there.
    assert float(moved.pos.reshape(3, 20, 3).mean(dim=1).abs().max()) <= 0.26
    assert recentre(moved, scene) is moved


def test_recentre_leaves_a_broken_cloth_where_it_is() -> None:
    pos = torch.full((4, 3), float("nan"))
    state = recentre(State(pos, pos, torch.ones(1, 3).double()), torch.zeros(4).long())
    assert state.origin.tolist() == [[1.0, 1.0, 1.0]]


def test_velocity_of_the_start_is_the_skinned_garments(tank_scene: Scene) -> None:
    origin = tank_scene.motion.translation[3]
    before, after = (tank_scene.motion.skinned(tank_scene.garment, frame, origin) for frame in (3, 4))
    state = tank_scene.start(3)
    torch.testing.assert_close(state.vel, (after - before) * 30.0, rtol=0, atol=1e-4)
    assert not bool(tank_scene.start(3, relaxed=False).vel.any())
    # At the last frame there is no next one.
    assert not bool(tank_scene.start_velocity(tank_scene.num_frames - 1).any())


def test_pins_follow_the_skinned_garment(skirt_scene: Scene) -> None:
    pinned = skirt_scene.cloth.pinned
    assert bool(pinned.any())
    state = skirt_scene.start(0)
    origin = state.origin[0].numpy()
    torch.testing.assert_close(state.pos[pinned], skirt_scene.motion.skinned(skirt_scene.garment, 0, origin)[pinned])
    relaxing = skirt_scene.step_input(0, state, relaxing=True)
    torch.testing.assert_close(relaxing.pin_target[pinned], state.pos[pinned])
    regular = skirt_scene.step_input(0, state)
    expected = skirt_scene.motion.skinned(skirt_scene.garment, 1, origin)
    torch.testing.assert_close(regular.pin_target[pinned], expected[pinned])
    assert not torch.equal(regular.pin_target[pinned], relaxing.pin_target[pinned])


def test_relaxing_step_freezes_the_body_and_takes_a_long_dt(tank_scene: Scene) -> None:
    state = tank_scene.start(5)
    relaxing, regular = (tank_scene.step_input(5, state, relaxing=value) for value in (True, False))
    assert relaxing.dt.tolist() == pytest.approx([RELAXING_DT])
    assert regular.dt.tolist() == pytest.approx([1 / 30])
    assert torch.equal(relaxing.obstacle.pos, relaxing.obstacle.next_pos)
    assert not torch.equal(regular.obstacle.pos, regular.obstacle.next_pos)
    assert regular.pin_target is None


def test_size_changes_the_rest_shape_only(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    plain, larger = (build_scene(garments["tank"], body, walk.window(0, 3), size=size) for size in (1.0, 1.1))
    torch.testing.assert_close(larger.cloth.rest_pos, plain.cloth.rest_pos * 1.1)
    torch.testing.assert_close(larger.cloth.mass, plain.cloth.mass * 1.21, rtol=1e-5, atol=0)
    origin = np.zeros(3)
    torch.testing.assert_close(larger.motion.skinned(larger.garment, 0, origin), plain.motion.skinned(plain.garment, 0, origin))


def test_shape_grows_garment_and_body(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    betas = np.array([2.0])
    tall = build_scene(garments["tank"], body, walk.window(0, 3), betas=betas)
    plain = build_scene(garments["tank"], body, walk.window(0, 3))
    assert float(tall.cloth.mass.sum()) > 1.02 * float(plain.cloth.mass.sum())
    assert np.ptp(tall.motion.surface(0, np.zeros(3)).numpy()[:, 1]) > np.ptp(
        plain.motion.surface(0, np.zeros(3)).numpy()[:, 1]
    )


def test_batched_steps(skirt_scene: Scene, tank_scene: Scene) -> None:
    scenes = (tank_scene, skirt_scene)
    states = [scene.start(0, relaxed=False) for scene in scenes]
    steps = [scene.step_input(0, state) for scene, state in zip(scenes, states, strict=True)]
    counts = [scene.cloth.num_vertices for scene in scenes]
    batch = concatenate_step_inputs(steps, counts)
    assert len(batch.dt) == 2
    assert batch.pin_target.shape == (sum(counts), 3)
    torch.testing.assert_close(batch.pin_target[counts[0] :], steps[1].pin_target)
    body_size = len(steps[0].obstacle.pos)
    torch.testing.assert_close(batch.obstacle.next_pos[body_size:], steps[1].obstacle.next_pos)
    assert int(batch.obstacle.faces[len(steps[0].obstacle.faces) :].min()) >= body_size
    assert concatenate_step_inputs(steps[:1], counts[:1]) is steps[0]


def test_batched_attachments_are_shifted() -> None:
    dt = torch.ones(1)
    button = Attachments(torch.tensor([[0, 1], [2, 3]]), torch.tensor([True, False]))
    steps = [StepInput(dt), StepInput(dt, attachments=button), StepInput(dt, attachments=button)]
    batch = concatenate_step_inputs(steps, [10, 5, 5])
    assert batch.attachments.edges.tolist() == [[10, 11], [12, 13], [15, 16], [17, 18]]
    assert batch.attachments.active.tolist() == [True, False, True, False]
    assert concatenate_step_inputs(steps[:1] * 2, [10, 10]).attachments is None


def test_scenes_with_and_without_a_body_do_not_mix(tank_scene: Scene) -> None:
    state = tank_scene.start(0, relaxed=False)
    with pytest.raises(ValueError, match="with and without a body"):
        concatenate_step_inputs([tank_scene.step_input(0, state), StepInput(torch.ones(1))], [3, 3])

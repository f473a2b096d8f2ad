"""Vertices that are held and let go."""

from __future__ import annotations

from dataclasses import replace

import torch

from hood.cloth.state import State
from hood.scene.holding import Grasp, Holding
from hood.scene.scene import Scene


def some(scene: Scene, *vertices: int) -> torch.Tensor:
    mask = torch.zeros(scene.cloth.num_vertices, dtype=torch.bool)
    mask[list(vertices)] = True
    return mask


def test_the_cloth_is_one_object_from_event_to_event(tank_scene: Scene) -> None:
    grasps = (Grasp(2, some(tank_scene, 0, 1), True), Grasp(5, some(tank_scene, 1), False))
    scene = replace(tank_scene, holding=Holding(grasps))
    assert scene.cloth_of_step(1) is scene.cloth
    assert scene.cloth_of_step(2) is scene.cloth_of_step(4)
    assert scene.cloth_of_step(3).pinned.nonzero().squeeze(1).tolist() == [0, 1]
    assert scene.cloth_of_step(5).pinned.nonzero().squeeze(1).tolist() == [0]
    assert scene.cloth_of_step(5).faces is scene.cloth.faces
    assert tank_scene.cloth_of_step(5) is tank_scene.cloth


def test_what_is_taken_hold_of_comes_at_its_speed_beside_the_body(tank_scene: Scene) -> None:
    scene = replace(tank_scene, holding=Holding((Grasp(2, some(tank_scene, 0, 1), True, 0.3),)))
    state = scene.start()
    origin = state.origin[0].numpy()
    here, there = (scene.motion.skinned(scene.garment, frame, origin) for frame in (2, 3))
    pos = here.clone()
    pos[0, 1] += 0.05
    pos[1, 1] += 0.004
    pos[2, 1] += 0.05
    target = scene.step_input(2, State(pos, state.vel, state.origin)).pin_target
    assert target is not None
    torch.testing.assert_close((target - there)[0], torch.tensor([0.0, 0.04, 0.0]), rtol=0, atol=1e-6)
    assert torch.equal(target[1:], there[1:])
    assert scene.step_input(1, State(pos, state.vel, state.origin)).pin_target is None
    assert torch.equal(scene.step_input(2, State(pos, state.vel, state.origin), jumping=True).pin_target, there)


def test_what_is_taken_hold_of_is_there_by_its_frame(tank_scene: Scene) -> None:
    """All arrive together, wherever a rollout begins."""
    scene = replace(tank_scene, holding=Holding((Grasp(2, some(tank_scene, 0, 1), True, by=12),)))
    state = scene.start()
    origin = state.origin[0].numpy()
    for frame, share in ((2, 7 / 8), (5, 4 / 5), (9, 0.0), (10, 0.0)):
        here, there = (scene.motion.skinned(scene.garment, at, origin) for at in (frame, frame + 1))
        pos = here.clone()
        pos[0, 1] += 0.04
        pos[1, 2] -= 0.02
        target = scene.step_input(frame, State(pos, state.vel, state.origin)).pin_target
        assert target is not None
        torch.testing.assert_close((target - there)[:2], share * (pos - here)[:2], rtol=0, atol=1e-6)


def test_pins_that_were_there_are_where_they_were(skirt_scene: Scene) -> None:
    hem = int(skirt_scene.cloth.rest_pos[:, 1].argmin())
    scene = replace(skirt_scene, holding=Holding((Grasp(3, some(skirt_scene, hem), True, 0.3),)))
    state = scene.start()
    for frame in (1, 4):
        found, usual = (one.step_input(frame, state).pin_target for one in (scene, skirt_scene))
        pinned = skirt_scene.cloth.pinned
        assert torch.equal(found[pinned], usual[pinned])

"""The body in motion: local precision far from the origin, obstacles of a step."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.scene.body_motion import motion as module
from hood.scene.body_motion.motion import body_motion
from hood.scene.scene import build_scene

FAR = np.array([1e4, 0.0, -1e4])


def test_ten_kilometres_away_local_surfaces_are_the_same(body: Body, walk: PoseSequence) -> None:
    near = walk.window(0, 4)
    far = replace(near, transl=near.transl + FAR)
    betas = np.zeros(10)
    motions = [body_motion(body, sequence, betas) for sequence in (near, far)]
    for frame in range(3):
        origins = [motion.translation[0] for motion in motions]
        first, second = (m.obstacle(frame, origin) for m, origin in zip(motions, origins, strict=True))
        for name in ("pos", "next_pos", "prev_pos"):
            assert float((getattr(first, name) - getattr(second, name)).abs().max()) <= 1e-6


def test_ten_kilometres_away_the_start_is_the_same(body: Body, walk: PoseSequence, garments: dict[str, Garment]) -> None:
    near = walk.window(0, 3)
    scenes = [build_scene(garments["tank"], body, s) for s in (near, replace(near, transl=near.transl + FAR))]
    first, second = (scene.start(0) for scene in scenes)
    # Both origins are snapped to the same grid: 10 km is a multiple of its cells.
    torch.testing.assert_close(second.origin - first.origin, torch.as_tensor(FAR)[None])
    assert float((first.pos - second.pos).abs().max()) <= 1e-6
    assert float((first.vel - second.vel).abs().max()) <= 1e-4


def test_static_obstacle_does_not_move(body: Body, walk: PoseSequence) -> None:
    motion = body_motion(body, walk.window(60, 64), np.zeros(10))
    still = motion.obstacle(1, motion.translation[1], static=True)
    assert torch.equal(still.pos, still.next_pos)
    assert torch.equal(still.pos, still.prev_pos)
    moving = motion.obstacle(1, motion.translation[1])
    assert torch.equal(moving.pos, still.pos)
    assert not torch.equal(moving.pos, moving.next_pos)
    assert not torch.equal(moving.pos, moving.prev_pos)


def test_frames_connect_over_chunks(body: Body, walk: PoseSequence) -> None:
    """The step's next surface is the following step's surface, also where a new chunk of frames is posed."""
    motion = body_motion(body, walk.window(0, 80), np.zeros(10))
    origin = motion.translation[0]
    for frame in (14, 15, 16, 62, 63, 64):
        here, there = motion.obstacle(frame, origin), motion.obstacle(frame + 1, origin)
        assert torch.equal(here.next_pos, there.pos)
        assert torch.equal(there.prev_pos, here.pos)
        alone = body.surface(walk.window(frame, frame + 1), np.zeros(10), torch.float64)[0]
        torch.testing.assert_close(motion.local_surface(frame), alone, rtol=0, atol=1e-12)


def test_the_first_frame_has_no_past(body: Body, walk: PoseSequence) -> None:
    first = body_motion(body, walk.window(0, 3), np.zeros(10)).obstacle(0, np.zeros(3))
    assert torch.equal(first.prev_pos, first.pos)


def test_skinned_skin_is_the_skin(body: Body, walk: PoseSequence) -> None:
    """A garment that is a piece of the body follows it exactly, shape included."""
    faces = body.faces[:200]
    used, local = np.unique(faces, return_inverse=True)
    skin = Garment(
        "skin", body.v_template[used], local.reshape(-1, 3), np.zeros(len(used), dtype=bool), body.weights[used],
        body.shapedirs[used],
    )  # fmt: skip
    motion = body_motion(body, walk.window(50, 53), np.linspace(-1, 1, 10))
    origin = motion.translation[1]
    skinned = motion.skinned(skin, 2, origin)
    torch.testing.assert_close(skinned, motion.surface(2, origin)[used], rtol=0, atol=2e-6)


def test_omitted_vertices_travel_with_the_obstacle(body: Body, walk: PoseSequence) -> None:
    obstacle = body_motion(body, walk.window(0, 2), np.zeros(10)).obstacle(0, np.zeros(3))
    assert int(obstacle.omitted.sum()) == pytest.approx(int(body.omitted.sum()))


def test_a_body_that_is_gone_leaves_nothing_behind(body: Body, walk: PoseSequence) -> None:
    """Programs may meet thousands of bodies."""
    before = set(module._TENSORS)
    for _ in range(3):
        other = replace(body)
        body_motion(other, walk.window(0, 2), np.zeros(10)).obstacle(0, np.zeros(3))
        assert len(set(module._TENSORS) - before) == 1
        del other
        gc.collect()
        assert set(module._TENSORS) <= before


def test_some_points_are_those_of_the_surface(body: Body, walk: PoseSequence) -> None:
    """In the world, of frames in any order, and nothing is posed or kept for them."""
    motion = body_motion(body, walk.window(0, 40), np.linspace(-1, 1, 10), torch.float64)
    frames = np.array([33, 2, 17])
    found = motion.some_points(frames, 100)
    assert not motion.posed
    whole = [motion.surface(int(frame), np.zeros(3)).numpy()[::100] for frame in frames]
    np.testing.assert_allclose(found, whole, rtol=0, atol=1e-12)

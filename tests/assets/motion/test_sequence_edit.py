"""Parts, repetitions and lead-ins of motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hood.assets.body.body import Body
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import PoseSequence, turn_world
from hood.assets.motion.sequence_edit import blend_in, frame_at, loop, standing_pose, trim


def joints(body: Body, sequence: PoseSequence) -> np.ndarray:
    """(T, J, 3) m, world."""
    transforms = body.transforms(sequence, np.zeros(10), torch.float64).numpy()
    rest = body.shaped(np.zeros(10))[1]
    posed = np.einsum("tjab,jb->tja", transforms[..., :3], rest) + transforms[..., 3]
    return posed + body.translation(sequence, np.zeros(10))[:, None]


def test_trim_in_seconds_and_frames(walk: PoseSequence) -> None:
    part = trim(walk, 1.0, 2.0)
    assert part.num_frames == 31
    np.testing.assert_array_equal(part.poses, walk.poses[30:61])
    np.testing.assert_array_equal(trim(walk, "30f", "60f").transl, walk.transl[30:61])
    np.testing.assert_array_equal(trim(walk, start="1.0s").poses, walk.poses[30:])
    assert trim(walk) is walk
    assert trim(walk, stop=1e5).num_frames == walk.num_frames


def test_trim_counts_frames_of_the_file() -> None:
    whole, part = load_sequence("walk_proud", 25.0), load_sequence("walk_proud", 25.0, start=2.0, stop=4.0)
    assert part.num_frames == 51
    np.testing.assert_allclose(part.transl, whole.transl[50:101], atol=1e-9)


@pytest.mark.parametrize("start, stop", [(5.0, 4.0), ("9999f", None), (1.0, 1.0)])
def test_nothing_left(walk: PoseSequence, start: object, stop: object) -> None:
    with pytest.raises(ValueError, match="walk_proud: with start=.* fewer than two"):
        trim(walk, start, stop)


@pytest.mark.parametrize("value", [-1, "x", "3g", float("nan"), 1e9, "-3f"])
def test_no_moment(value: object) -> None:
    with pytest.raises(ValueError, match="start=.*give seconds"):
        frame_at("start", value, 30.0)


def test_loop_goes_on_from_where_it_ended(walk: PoseSequence, body: Body) -> None:
    """No step between plays is larger than the motion's own steps; the last play is the motion itself, moved."""
    part = walk.window(10, 60)
    looped = loop(part, 3)
    assert looped.num_frames == 3 * 50 - 2
    own, steps = (np.linalg.norm(np.diff(joints(body, s), axis=0), axis=2).max(axis=1) for s in (part, looped))
    assert steps.max() < 1.5 * own.max()
    assert steps[45:55].max() < 1.5 * own.max()
    # The last play is the recorded motion after a turn about the vertical and a shift along the ground.
    last = looped.window(looped.num_frames - 49, looped.num_frames)
    turn = Rotation.from_rotvec(last.poses[0, 0]) * Rotation.from_rotvec(part.poses[1, 0]).inv()
    assert abs(turn.as_rotvec()[[0, 2]]).max() < 1e-9
    np.testing.assert_allclose(last.poses[:, 1:], part.poses[1:, 1:], atol=1e-12)
    np.testing.assert_allclose(np.diff(last.transl, axis=0), turn.apply(np.diff(part.transl[1:], axis=0)), atol=1e-9)
    np.testing.assert_allclose(last.transl[:, 1], part.transl[1:, 1], atol=1e-12)
    travelled = [np.linalg.norm(s.transl[-1, [0, 2]] - s.transl[0, [0, 2]]) for s in (part, looped)]
    assert travelled[1] > 2.5 * travelled[0]
    # Every play begins in the first pose, wherever it is and faces.
    for start in (49, 98):
        np.testing.assert_allclose(looped.poses[start, 1:], part.poses[0, 1:], atol=1e-9)


def test_a_loop_follows_the_heading(walk: PoseSequence) -> None:
    """A motion that turns by 90° comes back to its place after four plays."""
    angle = np.linspace(0, np.pi / 2, 31)
    place = 1.5 * np.stack([1 - np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    poses = np.zeros((31, 24, 3))
    poses[:, 0, 1] = angle
    quarter = replace(walk, poses=poses, transl=place)
    whole = loop(quarter, 4)
    np.testing.assert_allclose(whole.transl[-1], whole.transl[0], atol=1e-9)
    radius = np.linalg.norm(whole.transl - [1.5, 0, 0], axis=1)
    np.testing.assert_allclose(radius, 1.5, atol=1e-9)


def test_blend_in_stands_and_ends_in_the_first_pose(walk: PoseSequence, body: Body) -> None:
    turned = turn_world(walk.window(0, 20), Rotation.from_rotvec([0, 0.7, 0]).as_matrix())
    for kind in ("t", "a"):
        blended = blend_in(turned, 1.0, kind)
        assert blended.num_frames == 50
        np.testing.assert_array_equal(blended.poses[30:], turned.poses)
        standing = standing_pose(kind)
        np.testing.assert_allclose(blended.poses[0, 1:], standing[1:], atol=1e-12)
        np.testing.assert_allclose(blended.poses[0, 0, [0, 2]], 0.0, atol=1e-12)  # upright, facing as the motion does
        ahead = [Rotation.from_rotvec(s.poses[0, 0]).apply([0, 0, 1.0])[[0, 2]] for s in (blended, turned)]
        assert np.linalg.det(ahead) == pytest.approx(0, abs=1e-9)
        where = joints(body, blended)
        np.testing.assert_allclose(where[:30, 0], np.repeat(where[30:31, 0], 30, axis=0), atol=1e-9)  # the pelvis stays
        assert np.linalg.norm(np.diff(where[:31], axis=0), axis=2).max() < 0.06  # smooth: arms come down in a second
    assert blend_in(turned, 0.0) is turned


def test_the_a_pose_lowers_both_arms(body: Body) -> None:
    poses = np.stack([standing_pose("t"), standing_pose("a")])
    sequence = PoseSequence("stand", poses, np.zeros((2, 3)), 30.0, np.zeros(10), np.eye(3))
    t_pose, a_pose = joints(body, sequence)
    for shoulder, wrist in ((16, 20), (17, 21)):
        arm = a_pose[wrist] - a_pose[shoulder]
        before = t_pose[wrist] - t_pose[shoulder]
        angle = np.degrees(np.arctan2(-arm[1], abs(arm[0])) - np.arctan2(-before[1], abs(before[0])))
        assert angle == pytest.approx(45, abs=0.1)
    with pytest.raises(ValueError, match="blend_from=x: give t"):
        standing_pose("x")


def test_options_out_of_range(walk: PoseSequence) -> None:
    with pytest.raises(ValueError, match="loop=0"):
        loop(walk, 0)
    with pytest.raises(ValueError, match="loop="):
        loop(walk, 10**7)
    with pytest.raises(ValueError, match="blend_in=-1"):
        blend_in(walk, -1)
    with pytest.raises(ValueError, match="hands=x: give flat, or file"):
        load_sequence("walk_proud", hands="x")


def test_fingers_take_part(walk: PoseSequence) -> None:
    fingers = np.random.default_rng(0).normal(scale=0.3, size=(20, 30, 3))
    sequence = replace(walk.window(0, 20), fingers=fingers)
    assert loop(sequence, 2).fingers.shape == (39, 30, 3)
    blended = blend_in(sequence, 0.5)
    assert not blended.fingers[0].any()
    np.testing.assert_array_equal(blended.fingers[15:], fingers)

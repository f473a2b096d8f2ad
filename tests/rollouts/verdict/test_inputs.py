"""Doubts about bodies in motion and fabrics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.app.settings.rollout_settings import RolloutSettings
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import build_cloth
from hood.rollouts.verdict.doubts import doubt_body, doubt_fabric
from hood.scene.body_motion.load import MotionOptions, load_motion
from hood.scene.body_motion.motion import BodyMotion


def performed(name: str, frames: int = 40) -> BodyMotion:
    motion = load_motion("default", name, MotionOptions(num_frames=frames))
    assert isinstance(motion, BodyMotion)
    return motion


def changed(motion: BodyMotion, transl: np.ndarray | None = None, poses: np.ndarray | None = None) -> BodyMotion:
    old = motion.sequence
    sequence: PoseSequence = replace(
        old, transl=old.transl if transl is None else transl, poses=old.poses if poses is None else poses
    )
    translation = motion.body.translation(sequence, motion.betas)
    return replace(motion, sequence=sequence, translation=translation, _cache={}, _bones={}, _placed={})


def kinds(motion: BodyMotion, frames: int = 40) -> list[str]:
    return [doubt.kind for doubt in doubt_body(motion, frames)]


def turned(motion: BodyMotion, axis: str, degrees: float) -> BodyMotion:
    """The whole motion turned about an axis through the first frame's root."""
    turn, poses = Rotation.from_euler(axis, degrees, degrees=True), motion.sequence.poses.copy()
    poses[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    start = motion.sequence.transl[0]
    return changed(motion, start + turn.apply(motion.sequence.transl - start), poses)


@pytest.mark.parametrize("name", ["walk_proud", "jumps", "dance_mixed", "kicks"])
def test_ordinary_motions_are_not_doubted(name: str) -> None:
    assert kinds(performed(name, 150), 150) == []


def test_a_body_that_hangs_head_down_is_told_with_the_way_out() -> None:
    found = {doubt.kind: doubt for doubt in doubt_body(turned(performed("walk_proud"), "x", 180.0), 40)}
    assert found["orientation"].value == 1.0
    assert "up=-y" in str(found["orientation"])


def test_a_body_that_stands_on_its_hands_is_not_head_down() -> None:
    motion = performed("stand_sway")
    poses = motion.sequence.poses.copy()
    poses[:, 16], poses[:, 17] = [0.0, 0.0, 1.5], [0.0, 0.0, -1.5]  # arms up beside the head
    motion = turned(changed(motion, poses=poses), "x", 180.0)
    lowest = motion.some_points(np.array([0]), 1)[0, :, 1].min()
    motion = changed(motion, motion.sequence.transl - [0.0, lowest, 0.0])
    assert "orientation" not in kinds(motion)


def test_a_body_that_lies_is_not_head_down() -> None:
    """On a floor; in the air it should probably stand."""
    lying = turned(performed("stand_sway"), "x", 88.0)
    assert "orientation" in kinds(lying)
    lowest = lying.some_points(np.array([0]), 1)[0, :, 1].min()
    assert kinds(changed(lying, lying.sequence.transl - [0.0, lowest, 0.0])) == []


@pytest.mark.parametrize("height", [-0.9, 3.0])
def test_a_body_far_from_the_floor_is_told(height: float) -> None:
    motion = performed("walk_proud")
    (doubt,) = doubt_body(changed(motion, motion.sequence.transl + [0.0, height, 0.0]), 40)
    assert doubt.kind == "floor"
    assert doubt.value == pytest.approx(height, abs=0.02)


def test_a_body_that_sinks_through_its_own_floor_is_told_with_the_frames() -> None:
    motion = performed("walk_proud")
    sinking = motion.sequence.transl - np.clip(np.arange(motion.num_frames) - 30, 0, None)[:, None] * [0.0, 0.1, 0.0]
    (doubt,) = doubt_body(changed(motion, sinking), 40)
    assert doubt.kind == "floor"
    assert min(doubt.frames) in (34, 35)


def test_nobody_runs_at_twenty_metres_a_second() -> None:
    motion = performed("walk_proud")
    running = motion.sequence.transl + np.arange(motion.num_frames)[:, None] * [20.0 / 30.0, 0.0, 0.0]
    (doubt,) = doubt_body(changed(motion, running), 40)
    assert doubt.kind == "speed"
    assert doubt.value == pytest.approx(20.0, abs=1.5)


@pytest.mark.parametrize("way", [2.0, 0.25])
def test_a_jump_is_told_with_its_frame(way: float) -> None:
    motion = performed("walk_proud")
    there = motion.sequence.transl + (np.arange(motion.num_frames) > 20)[:, None] * [way, 0.0, 0.0]
    (doubt,) = doubt_body(changed(motion, there), 40)
    assert (doubt.kind, doubt.frames) == ("jump", (20,))
    assert doubt.value == pytest.approx(way, abs=0.05)


def test_arms_in_the_trunk_are_told() -> None:
    motion = performed("stand_sway")
    poses = motion.sequence.poses.copy()
    poses[:, 16], poses[:, 17] = [0.0, 0.0, -1.6], [0.0, 0.0, 1.6]
    (doubt,) = doubt_body(changed(motion, poses=poses), 40)
    assert doubt.kind == "body_overlap"
    assert doubt.value is not None
    assert doubt.value > 0.03


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"density": 2000.0}, "density is 2e+03 kg/m²"),
        ({"density": 2e-4}, "density is 0.0002 kg/m²"),
        ({"lame_mu": 23600e6}, "shear stiffness"),
        ({"bending_stiffness": 40.0}, "bending stiffness"),
        ({"warp": 0.03, "weft": 0.9}, "stretch stiffness"),
    ],
)
def test_fabrics_of_another_unit_are_told(changes: dict[str, float], what: str) -> None:
    pos = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    assert doubt_fabric(build_cloth(pos, faces, Material()), "shirt") == []
    (doubt,) = doubt_fabric(build_cloth(pos, faces, Material(**changes)), "shirt")
    assert doubt.kind == "fabric"
    assert what in str(doubt)


def test_the_fabrics_that_ship_are_cloth() -> None:
    from hood.app.settings.compose import build

    pos = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    for name in ("chiffon", "nappa_leather", "wool_felt", "silk_habotai", "denim"):
        material = build(RolloutSettings.from_words([f"material={name}"]).material)
        assert doubt_fabric(build_cloth(pos, faces, material), "shirt") == []

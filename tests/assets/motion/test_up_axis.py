"""The up axis by the poses: what stands is found, what lies on a floor is asked about, the own motions are left alone."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.assets.files.library import locate, names
from hood.assets.files.said import Doubt
from hood.assets.motion.load import bearing_notice, find_bearing, head_down_doubt, load_sequence
from hood.assets.motion.recording import Recording, read_recording
from hood.assets.motion.skeleton import UP_AXES, Z_UP_TO_Y_UP, joints_about_pelvis


@pytest.fixture(scope="module")
def walk() -> Recording:
    return read_recording(locate("motions", "walk_proud"))


def turned(recording: Recording, matrix: np.ndarray) -> Recording:
    poses = recording.poses.copy()
    poses[:, 0] = (Rotation.from_matrix(matrix) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return replace(recording, poses=poses, transl=recording.transl @ matrix.T)


def test_the_own_motions_are_left_alone() -> None:
    for name in names("motions"):
        recording = read_recording(locate("motions", name))
        assert find_bearing(recording) == (recording.up, True), name


def test_a_body_that_stands_along_the_other_axis(walk: Recording) -> None:
    assert find_bearing(turned(walk, Z_UP_TO_Y_UP)) == ("y", True)
    assert find_bearing(replace(walk, up="y")) == ("z", True)


def test_lying_on_the_floor_is_asked_about(walk: Recording) -> None:
    """Asleep on a z-up floor with the head towards +y: that is what a body looks like that stands in a y-up world."""
    lying = turned(walk, Z_UP_TO_Y_UP)
    lying.transl[:] = [0.3, 5.0, 0.15]
    assert find_bearing(lying) == ("y", False)


def test_a_roll_does_not_count(walk: Recording) -> None:
    """Cartwheels and crawling: up along y for half of the frames."""
    half = len(walk.poses) // 2
    mixed = turned(walk, Z_UP_TO_Y_UP).poses
    mixed[half:] = walk.poses[half:]
    assert find_bearing(replace(walk, poses=mixed)) == ("z", True)


# ---- six axes, and bodies that are not to be turned over ----------------------------------------------------------------


@pytest.mark.parametrize("up", UP_AXES)
def test_a_walk_stands_up_along_every_axis(walk: Recording, up: str, tmp_path: Path) -> None:
    """Whatever the custom of its keys is; and as it is performed it is the same walk."""
    found = turned(walk, UP_AXES[up].T @ Z_UP_TO_Y_UP)
    assert [find_bearing(replace(found, up=custom)) for custom in ("y", "z", "-y")] == [(up, True)] * 3
    path = tmp_path / "m.npz"
    np.savez(path, poses=found.poses.reshape(-1, 72), trans=found.transl, mocap_framerate=found.fps)
    with warnings.catch_warnings():
        warnings.simplefilter("error", Doubt)
        sequence = load_sequence(path, found.fps)
    np.testing.assert_allclose(sequence.transl, load_sequence("walk_proud", found.fps).transl, atol=1e-9)


def test_no_own_motion_is_taken_for_sure_along_a_wrong_axis() -> None:
    for name in ("arm_raises", "jumps", "squats", "walk_tired"):
        recording = read_recording(locate("motions", name))
        for up, matrix in UP_AXES.items():
            found = find_bearing(turned(recording, matrix.T @ Z_UP_TO_Y_UP))
            assert found.axis == up or not found.sure, (name, up)


TIME = np.linspace(0.0, 4.0, 120)


def posed(root: np.ndarray, arms_up: float = 0.0) -> np.ndarray:
    """(120, 24, 3): a body with straight limbs whose root is turned by ``root`` (120, 3) from upright in a world with z up."""
    poses = np.zeros((len(TIME), 24, 3))
    poses[:, 16, 2], poses[:, 17, 2] = arms_up, -arms_up
    poses[:, 0] = (Rotation.from_rotvec(root) * Rotation.from_matrix(Z_UP_TO_Y_UP.T)).as_rotvec()
    return poses


def swing(about: float, angle: float) -> np.ndarray:
    """(120, 3) rad about x."""
    return np.outer(about + angle * np.sin(2.0 * TIME), [1.0, 0.0, 0.0])


def held_at(poses: np.ndarray, joints: list[int], height: float) -> np.ndarray:
    """The translation that keeps the mean of ``joints`` at one place."""
    return [0.0, 0.0, height] - joints_about_pelvis(poses)[:, joints].mean(axis=1)


def awkward() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Poses and translations, z up, of bodies that do not stand."""
    hand = posed(swing(np.pi, 0.03), arms_up=1.4)
    feet, arms = posed(swing(np.pi, 0.4)), posed(swing(0.0, 0.4), arms_up=1.4)
    wheel = posed(np.outer(np.pi * TIME, [0.0, 1.0, 0.0]), arms_up=1.4)
    low = joints_about_pelvis(wheel)[:, :, 2].min(axis=1)
    crawl = np.zeros((len(TIME), 24, 3))
    crawl[:, 0] = [0.0, np.pi, 0.0]
    crawl[:, 1, 0], crawl[:, 2, 0] = -1.4 + 0.25 * np.sin(4 * TIME), -1.4 - 0.25 * np.sin(4 * TIME)
    ahead = np.outer(0.3 * TIME, [0.0, 1.0, 0.0])
    cases = {
        "handstand": (hand, held_at(hand, [20, 21], 0.0)),
        "hanging by the feet": (feet, held_at(feet, [10, 11], 2.5)),
        "hanging by the hands": (arms, held_at(arms, [20, 21], 2.5)),
        "cartwheels": (wheel, np.stack([0.8 * TIME, 0 * TIME, -low], axis=1)),
        "crawling": (crawl, ahead + np.outer(-joints_about_pelvis(crawl)[:, :, 2].min(axis=1), [0.0, 0.0, 1.0])),
        "swimming": (crawl, 4.0 * ahead + [0.0, 0.0, 1.0]),
    }
    for axis, turn in (
        ("y", [-np.pi / 2, 0, 0]),
        ("-y", [np.pi / 2, 0, 0]),
        ("x", [0, np.pi / 2, 0]),
        ("-x", [0, -np.pi / 2, 0]),
    ):
        for height in (0.12, 0.6):
            cases[f"lying along {axis}, {height} m"] = posed(np.tile(turn, (120, 1))), np.tile([0.3, 5.0, height], (120, 1))
    return cases


#: Those of which the custom of the layout is sure.
PLAIN = ("hanging by the hands", "crawling", "swimming", "lying along x, 0.12 m", "lying along -x, 0.12 m")


@pytest.mark.parametrize("name", awkward())
def test_who_does_not_stand_is_not_turned_over(walk: Recording, name: str) -> None:
    poses, transl = awkward()[name]
    recording = replace(walk, poses=poses, transl=transl, fps=30.0)
    axis, notice = bearing_notice(Path("m.npz"), recording)
    assert axis == "z"
    assert notice is None or (isinstance(notice, Doubt) and "up=" in str(notice))
    assert (notice is None) == (name in PLAIN)


def test_standing_head_down_is_offered_its_turn(walk: Recording) -> None:
    """A camera's world, and a body that sways on the spot: the same as one that hangs by its feet."""
    sway = read_recording(locate("motions", "stand_sway"))
    recording = replace(turned(sway, UP_AXES["-y"].T @ Z_UP_TO_Y_UP), up="y")
    axis, notice = bearing_notice(Path("m.pkl"), recording)
    assert axis == "y"
    assert isinstance(notice, Doubt)
    assert all(key in str(notice) for key in ("up=-y", "up=y"))
    # One that is head down half of the time is told as well.
    half = len(sway.poses) // 2 - 20
    poses = np.concatenate([sway.poses[:half], turned(sway, np.diag([1.0, -1.0, -1.0])).poses[half:]])
    doubt = head_down_doubt(Path("m.npz"), replace(sway, poses=poses), "z")
    assert isinstance(doubt, Doubt)
    assert doubt.kind == "orientation"
    assert "head down in 53% of its frames" in str(doubt)
    assert head_down_doubt(Path("m.npz"), sway, "z") is None


def test_a_single_pose_stands_where_its_layout_says(walk: Recording) -> None:
    one = replace(walk, poses=walk.poses[:1], transl=walk.transl[:1])
    assert find_bearing(one) == ("z", True)
    assert find_bearing(turned(one, UP_AXES["-y"].T @ Z_UP_TO_Y_UP)) == ("-y", False)

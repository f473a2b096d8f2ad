import json
from pathlib import Path

import numpy as np
import pytest
import torch

from hood.assets.body.body import axis_angle_to_matrix, joint_transforms
from tools.assets.choreography import Motion, all_motions, perform, write_motions
from tools.assets.gait import ease
from tools.assets.puppet import Controls, Skeleton, solve
from tools.assets.recipes import sway

DATA = Path(__file__).parents[3] / "hood" / "data"
BODY = DATA / "body" / "default.npz"
MOTIONS = {motion.name: motion for motion in all_motions()}
AIRBORNE = {"jumps", "jog", "run_on_spot"}


@pytest.fixture(scope="module")
def skeleton() -> Skeleton:
    return Skeleton.from_body(BODY)


@pytest.fixture(scope="module")
def parents() -> list[int]:
    with np.load(BODY) as body:
        return [-1, *body["kintree_table"][0][1:].astype(int).tolist()]


def world_joints(arrays: dict, skeleton: Skeleton, parents: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Posed joints (N, 24, 3), z up, and joint transforms (N, 24, 3, 4) before the translation."""
    poses = torch.zeros(len(arrays["poses"]), 24, 3, dtype=torch.float64)
    poses[:, :22] = torch.tensor(np.asarray(arrays["poses"][:, :66], dtype=np.float64)).reshape(-1, 22, 3)
    joints = torch.tensor(skeleton.joints)
    transforms = joint_transforms(axis_angle_to_matrix(poses), joints, parents).numpy()
    posed = np.einsum("tjab,jb->tja", transforms[..., :3], skeleton.joints) + transforms[..., 3]
    return posed + np.asarray(arrays["trans"], dtype=np.float64)[:, None], transforms


@pytest.fixture(scope="module")
def performed(skeleton: Skeleton) -> dict[str, dict]:
    return {
        name: perform(motion, skeleton, np.random.default_rng([0, index]))
        for index, (name, motion) in enumerate(MOTIONS.items())
    }


@pytest.mark.parametrize("name", MOTIONS)
def test_layout_is_amass(name: str, performed: dict) -> None:
    arrays, motion = performed[name], MOTIONS[name]
    count = round(motion.seconds * motion.fps)
    assert arrays["poses"].shape == (count, 156)
    assert arrays["trans"].shape == (count, 3)
    assert arrays["betas"].shape == (16,)
    assert not arrays["betas"].any()
    assert not arrays["poses"][:, 66:].any()
    assert np.isfinite(arrays["poses"]).all()
    assert float(arrays["mocap_framerate"]) == motion.fps
    assert str(arrays["gender"]) == "neutral"


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_is_humanly_possible(name: str, performed: dict, skeleton: Skeleton, parents: list[int]) -> None:
    arrays, fps = performed[name], MOTIONS[name].fps
    joints, transforms = world_joints(arrays, skeleton, parents)
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=2) * fps
    assert speed[:, 0].max() < 3.0
    assert speed.max() < 6.0
    acceleration = np.linalg.norm(np.diff(joints, n=2, axis=0), axis=2) * fps**2
    assert acceleration.max() < 300.0

    poses = np.degrees(arrays["poses"][:, :66].reshape(-1, 22, 3))
    knees, elbows = poses[:, [4, 5], 0], np.stack([-poses[:, 18, 1], poses[:, 19, 1]])
    assert knees.min() > 0.0
    assert knees.max() < 130.0
    assert elbows.min() > -6.0
    assert elbows.max() < 125.0
    spine = np.linalg.norm(poses[:, [3, 6, 9]], axis=2)
    assert spine.max() < 25.0

    elbow, shoulder = joints[:, [18, 19]], joints[:, [16, 17]]
    down = np.einsum("tab,b->ta", transforms[:, 9, :, :3], [0.0, -1.0, 0.0])
    upper_arm = (elbow - shoulder) / np.linalg.norm(elbow - shoulder, axis=2, keepdims=True)
    assert np.degrees(np.arccos(np.einsum("tsa,ta->ts", upper_arm, down).max())) > 12.0


@pytest.mark.parametrize("name", MOTIONS)
def test_feet_stand_on_the_floor(name: str, performed: dict, skeleton: Skeleton, parents: list[int]) -> None:
    arrays, fps = performed[name], MOTIONS[name].fps
    _, transforms = world_joints(arrays, skeleton, parents)
    contacts = []
    for point, joints in ((skeleton.heel, (7, 8)), (skeleton.ball, (7, 8)), (skeleton.ball, (10, 11))):
        for side, joint in enumerate(joints):
            place = transforms[:, joint, :, :3] @ point[side] + transforms[:, joint, :, 3]
            contacts.append(place + np.asarray(arrays["trans"], dtype=np.float64))
    sole = np.stack(contacts, axis=1)
    assert sole[..., 2].min() > -0.01
    lowest = sole[..., 2].min(axis=1)
    assert lowest.max() < (0.35 if name in AIRBORNE else 0.01)
    if name not in AIRBORNE:
        index = sole[1:, :, 2].argmin(axis=1)
        step = np.diff(sole, axis=0)[np.arange(len(index)), index, :2]
        assert np.median(np.linalg.norm(step, axis=1)) * fps < 0.06


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_starts_still_with_arms_half_lowered(name: str, performed: dict, skeleton: Skeleton) -> None:
    arrays, fps = performed[name], MOTIONS[name].fps
    first = arrays["poses"][0, :66].reshape(22, 3)
    lowered = np.degrees([-first[16, 2], first[17, 2]])
    assert (lowered > 40).all()
    assert (lowered < 65).all()
    moved = np.abs(np.diff(arrays["poses"][: round(0.1 * fps)], axis=0)).max() * fps
    assert moved < 0.25


def test_jumps_fall_freely(performed: dict, skeleton: Skeleton, parents: list[int]) -> None:
    fps = MOTIONS["jumps"].fps
    joints, _ = world_joints(performed["jumps"], skeleton, parents)
    height = joints[:, 0, 2]
    top = np.argmax(height)
    flight = height[top - 12 : top + 13]
    curvature = 2 * np.polyfit(np.arange(25) / fps, flight, 2)[0]
    assert curvature == pytest.approx(-9.81, rel=0.05)


def test_arms_swing_against_the_legs(performed: dict, skeleton: Skeleton, parents: list[int]) -> None:
    joints, _ = world_joints(performed["walk_steady"], skeleton, parents)
    relative = joints[300:] - joints[300:, :1]
    # Without turns the walk heads for -y in a z-up world.
    ankle, wrist = (relative[:, k, 1] - relative[:, k, 1].mean() for k in (7, 20))
    assert np.corrcoef(ankle, wrist)[0, 1] < -0.8
    assert joints[-1, 0, 1] < -8.0


def test_planted_feet_ignore_the_pelvis(skeleton: Skeleton, parents: list[int]) -> None:
    controls = Controls.standing(60, 60.0, skeleton)
    controls.pelvis[:, 1] -= 0.3 * ease(controls.time, 0.1, 0.6)
    controls.pelvis_turn[:, 1] += 15.0 * ease(controls.time, 0.1, 0.6)
    local, pelvis = solve(controls, skeleton)
    transforms = joint_transforms(
        torch.tensor(np.concatenate([local, np.tile(np.eye(3), (60, 2, 1, 1))], axis=1)),
        torch.tensor(skeleton.joints),
        parents,
    ).numpy()
    posed = np.einsum("tjab,jb->tja", transforms[..., :3], skeleton.joints) + transforms[..., 3]
    ankles = (posed + (pelvis - skeleton.joints[0])[:, None])[:, [7, 8]]
    assert np.ptp(pelvis[:, 1]) > 0.25
    np.testing.assert_allclose(ankles, np.broadcast_to(ankles[:1], ankles.shape), atol=1e-9)


def test_split_is_by_motion_and_long_enough() -> None:
    training = [m for m in all_motions() if not m.validation]
    validation = [m for m in all_motions() if m.validation]
    assert len(MOTIONS) == len(training) + len(validation)
    assert len(validation) >= 4
    assert sum(motion.seconds for motion in all_motions()) >= 240.0
    assert {motion.fps for motion in all_motions()} == {60.0, 100.0, 120.0}


def test_shipped_files_are_what_the_code_writes(performed: dict) -> None:
    folder = DATA / "motions"
    split = json.loads((folder / "split.json").read_text())
    assert set(split["train"]) | set(split["validation"]) == set(MOTIONS)
    assert not set(split["train"]) & set(split["validation"])
    assert sum(file.stat().st_size for file in folder.iterdir()) < 2.5e6
    for name in ("walk_steady", "dance_mixed"):
        with np.load(folder / f"{name}.npz", allow_pickle=False) as shipped:
            np.testing.assert_allclose(shipped["poses"], performed[name]["poses"], atol=3e-4)
            np.testing.assert_allclose(shipped["trans"], performed[name]["trans"], atol=3e-4)


def test_same_seed_same_files(tmp_path: Path, skeleton: Skeleton, monkeypatch: pytest.MonkeyPatch) -> None:
    few = [Motion("stand", sway, seconds=1.0), Motion("stand_again", sway, seconds=1.0, validation=True)]
    monkeypatch.setattr("tools.assets.choreography.all_motions", lambda: few)
    for folder, seed in (("a", 3), ("b", 3), ("c", 4)):
        write_motions(tmp_path / folder, BODY, seed)
    read = {folder: np.load(tmp_path / folder / "stand.npz")["poses"] for folder in "abc"}
    np.testing.assert_array_equal(read["a"], read["b"])
    assert (read["a"] != read["c"]).any()
    names = sorted(file.name for file in (tmp_path / "a").iterdir())
    assert names == ["split.json", "stand.npz", "stand_again.npz"]

"""Motions of every layout and frame rate against a direct evaluation; what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hood.assets.body.body import Body
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import Z_UP_TO_Y_UP, resample, turn_world


def recorded(fps: float, seconds: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Smooth body poses (N, 22, 3) and translations (N, 3), z up."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * fps) + 1)[:, None, None] / fps
    size, speed, phase = (rng.uniform(*span, size=(1, 22, 3)) for span in ((0, 0.4), (0.5, 2), (0, 6)))
    transl = np.concatenate([1.3 * time[..., 0], 0.1 * np.sin(3 * time[..., 0]), 0.9 + 0.02 * time[..., 0]], axis=1)
    return size * np.sin(speed * time + phase), transl


def write_amass(path: Path, poses: np.ndarray, transl: np.ndarray, fps: float, layout: str = "smplh") -> Path:
    flat, count = poses.reshape(len(poses), 66), len(poses)
    fingers = np.full((count, 90), 0.3)
    if layout == "smplh":
        arrays = {"poses": np.concatenate([flat, fingers], axis=1), "mocap_framerate": fps, "betas": np.zeros(16)}
    else:
        arrays = {
            "root_orient": flat[:, :3],
            "pose_body": flat[:, 3:],
            "pose_hand": fingers,
            "pose_jaw": np.ones((count, 3)),
            "mocap_frame_rate": fps,
            "betas": np.zeros(16),
        }
    np.savez(path, trans=transl, gender="neutral", **arrays)
    return path


def place(body: Body, poses: np.ndarray, transl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints (T, 24, 3) and a sample of the vertices [m], z up, by a direct float64 evaluation of the file's data."""
    rest, joints = body.shaped(np.zeros(10))
    world = np.zeros((len(poses), 24, 3, 3))
    position = np.zeros((len(poses), 24, 3))
    for joint, parent in enumerate(body.parents):
        local = np.eye(3)[None]
        if joint < 22:
            local = Rotation.from_rotvec(poses[:, joint]).as_matrix()
        if parent < 0:
            world[:, joint], position[:, joint] = local, joints[joint]
        else:
            world[:, joint] = world[:, parent] @ local
            position[:, joint] = position[:, parent] + world[:, parent] @ (joints[joint] - joints[parent])
    sample = slice(None, None, 97)
    by_joint = np.einsum("tjab,vjb->tvja", world, rest[sample, None] - joints[None]) + position[:, None]
    vertices = np.einsum("vj,tvja->tva", body.weights[sample], by_joint)
    return position + transl[:, None], vertices + transl[:, None]


def loaded_places(body: Body, sequence) -> tuple[np.ndarray, np.ndarray]:
    translation = body.translation(sequence, np.zeros(10))[:, None]
    transforms = body.transforms(sequence, np.zeros(10), torch.float64).numpy()
    rest_joints = body.shaped(np.zeros(10))[1]
    joints = np.einsum("tjab,jb->tja", transforms[..., :3], rest_joints) + transforms[..., 3]
    surface = body.surface(sequence, np.zeros(10), torch.float64).numpy()[:, ::97]
    return joints + translation, surface + translation


@pytest.mark.parametrize("layout", ["smplh", "smplx"])
@pytest.mark.parametrize("fps", [120.0, 100.0, 60.0])
def test_places_at_common_time_stamps(tmp_path: Path, body: Body, fps: float, layout: str) -> None:
    """Joints and vertices in metres, pelvis offset of the axis change included."""
    poses, transl = recorded(fps, 1.0)
    sequence = load_sequence(write_amass(tmp_path / "m.npz", poses, transl, fps, layout), fps=30.0, up="z")
    assert sequence.num_frames == 31
    assert sequence.fps == 30.0
    # Frames whose time stamp k / 30 is one of the file's.
    stamps = np.arange(31) * fps / 30
    common = np.flatnonzero(np.abs(stamps - stamps.round()) < 1e-9)
    assert len(common) >= 4
    source = stamps[common].round().astype(int)
    for own, direct in zip(loaded_places(body, sequence), place(body, poses[source], transl[source]), strict=True):
        np.testing.assert_allclose(own[common], direct @ Z_UP_TO_Y_UP.T, rtol=0, atol=1e-6)


def test_y_up_files_are_left_alone(tmp_path: Path, body: Body) -> None:
    poses, transl = recorded(30.0, 0.3)
    sequence = load_sequence(write_amass(tmp_path / "m.npz", poses, transl, 30.0), up="y")
    for own, direct in zip(loaded_places(body, sequence), place(body, poses, transl), strict=True):
        np.testing.assert_allclose(own, direct, rtol=0, atol=1e-6)


def test_between_time_stamps_rotations_take_the_short_arc(tmp_path: Path) -> None:
    poses, transl = np.zeros((2, 22, 3)), np.array([[0, 0, 0], [1.0, 0, 0]])
    poses[:, 4, 0] = [3.0, -3.0]  # 6 rad apart in coordinates, 0.28 rad apart as rotations
    sequence = load_sequence(write_amass(tmp_path / "m.npz", poses, transl, 1.0), fps=2.0)
    assert np.linalg.norm(sequence.poses[1, 4]) == pytest.approx(np.pi, abs=1e-9)
    assert sequence.transl[1, 0] == pytest.approx(0.5)


def test_no_drift_from_100_to_30_fps_after_60_seconds(tmp_path: Path) -> None:
    poses, transl = recorded(100.0, 60.0)
    transl[:, 0] = np.arange(len(transl)) / 100.0  # the clock
    sequence = load_sequence(write_amass(tmp_path / "m.npz", poses, transl, 100.0), fps=30.0, up="y")
    assert sequence.num_frames == 1801
    np.testing.assert_allclose(sequence.transl[:, 0], np.arange(1801) / 30.0, rtol=0, atol=1e-9)
    last = Rotation.from_rotvec(sequence.poses[-1, :22]) * Rotation.from_rotvec(poses[-1]).inv()
    assert last.magnitude().max() < 1e-9


def test_upsampling_keeps_the_recorded_frames(tmp_path: Path) -> None:
    poses, transl = recorded(30.0, 0.5)
    sequence = load_sequence(write_amass(tmp_path / "m.npz", poses, transl, 30.0), fps=120.0, up="y")
    np.testing.assert_allclose(sequence.poses[::4, :22], poses, rtol=0, atol=1e-9)
    np.testing.assert_allclose(sequence.transl[::4], transl, rtol=0, atol=1e-12)


def test_fingers_do_not_become_hands(tmp_path: Path) -> None:
    """Columns 66:72 of SMPL+H are fingers, SMPL's joints 22 and 23 are hands."""
    sequence = load_sequence(write_amass(tmp_path / "m.npz", *recorded(30.0, 0.2), 30.0))
    assert sequence.poses.shape[1:] == (24, 3)
    assert not sequence.poses[:, 22:].any()
    assert sequence.poses[:, :22].any()


def test_turning_the_world_turns_the_body_about_the_world_axis(body: Body, tmp_path: Path) -> None:
    sequence = load_sequence(write_amass(tmp_path / "m.npz", *recorded(30.0, 0.2), 30.0))
    turn = Rotation.from_rotvec([0.0, 1.1, 0.0]).as_matrix()
    for before, after in zip(loaded_places(body, sequence), loaded_places(body, turn_world(sequence, turn)), strict=True):
        np.testing.assert_allclose(after, before @ turn.T, rtol=0, atol=1e-9)


def test_file_without_betas_and_with_extra_objects(tmp_path: Path) -> None:
    poses, transl = recorded(30.0, 0.2)
    labels = np.array([{"a": 1}], dtype=object)
    np.savez(tmp_path / "m.npz", poses=poses.reshape(-1, 66), trans=transl, mocap_framerate=30, labels=labels)
    assert load_sequence(tmp_path / "m.npz").num_frames == len(poses)


def test_frame_rate_of_one_element_array(tmp_path: Path) -> None:
    poses, transl = recorded(60.0, 0.5)
    np.savez(tmp_path / "m.npz", poses=poses.reshape(-1, 66), trans=transl, mocap_framerate=np.array([60.0]))
    assert load_sequence(tmp_path / "m.npz").num_frames == 16


Damage = Callable[[dict], None]
REFUSED: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "not finite pose": (lambda a: a["poses"].__setitem__((5, 7), np.nan), ("poses", "frame 5")),
    "not finite translation": (lambda a: a["trans"].__setitem__((3, 0), np.inf), ("trans", "frame 3")),
    "no frames": (lambda a: a.update(poses=a["poses"][:0], trans=a["trans"][:0]), ("poses has no frames", "at least one")),
    "lengths differ": (lambda a: a.update(trans=a["trans"][:-1]), ("agree",)),
    "no translation": (lambda a: a.pop("trans"), ("'trans'",)),
    "no poses": (lambda a: a.pop("poses"), ("not an AMASS motion",)),
    "few columns": (lambda a: a.update(poses=a["poses"][:, :63]), ("poses", "(N, 66)")),
    "no frame rate": (lambda a: a.pop("mocap_framerate"), ("mocap_framerate",)),
    "zero frame rate": (lambda a: a.update(mocap_framerate=0.0), ("mocap_framerate", "positive")),
    "text frame rate": (lambda a: a.update(mocap_framerate="fast"), ("mocap_framerate", "positive")),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_files_name_file_and_reason(tmp_path: Path, case: str) -> None:
    damage, words = REFUSED[case]
    poses, transl = recorded(30.0, 0.3)
    arrays = {"poses": poses.reshape(-1, 66), "trans": transl, "mocap_framerate": 30.0}
    damage(arrays)
    np.savez(tmp_path / "broken.npz", **arrays)
    with pytest.raises(ValueError) as error:
        load_sequence(tmp_path / "broken.npz")
    message = str(error.value)
    assert "broken.npz" in message
    assert all(word in message for word in words), message
    assert "\n" not in message


def test_wrong_smplx_shapes_name_the_file(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "m.npz", root_orient=np.zeros((4, 3)), pose_body=np.zeros((4, 60)), trans=np.zeros((4, 3)),
        mocap_frame_rate=30.0,
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"m\.npz.*pose_body"):
        load_sequence(tmp_path / "m.npz")


def test_files_that_are_no_archives(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("hello")
    np.save(tmp_path / "single.npy", np.zeros(3))
    (tmp_path / "single.npz").write_bytes((tmp_path / "single.npy").read_bytes())
    for name in ("text.npz", "single.npz"):
        with pytest.raises(ValueError, match=f"{name}: not a readable AMASS motion"):
            load_sequence(tmp_path / name)
    (tmp_path / "walk.bvh").write_text("HIERARCHY")
    with pytest.raises(ValueError, match=r"walk\.bvh.*AMASS"):
        load_sequence(tmp_path / "walk.bvh")


def test_unknown_up_axis() -> None:
    with pytest.raises(ValueError, match="up=w: give z"):
        load_sequence("walk_proud", up="w")


def test_too_short_for_the_asked_rate(tmp_path: Path) -> None:
    path = write_amass(tmp_path / "m.npz", *recorded(120.0, 3 / 120), 120.0)
    with pytest.raises(ValueError, match="less than two at 30"):
        resample(load_sequence(path, fps=120.0), 30.0)

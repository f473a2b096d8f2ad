"""Motion files of every layout: the same motion comes out, and what is refused names the file, the key and the fix."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.assets.files.library import read_arrays
from hood.assets.motion.load import load_sequence
from hood.assets.motion.recording import read_recording
from hood.assets.motion.sequence import Z_UP_TO_Y_UP

COUNT = 9


def recorded() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses (N, 24, 3), fingers (N, 30, 3), translations (N, 3)."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(COUNT, 24, 3)), rng.normal(size=(COUNT, 30, 3)), rng.normal(size=(COUNT, 3))


def layouts() -> dict[str, tuple[str, dict[str, Any]]]:
    poses, fingers, transl = recorded()
    body, hand = poses[:, :22].reshape(COUNT, 66), fingers.reshape(COUNT, 90)
    amass = {"trans": transl, "gender": np.array("male"), "betas": np.arange(16.0)}
    return {
        "amass smpl+h": (".npz", {"poses": np.c_[body, hand], "mocap_framerate": 30.0, **amass}),
        "amass smpl": (".npz", {"poses": poses.reshape(COUNT, 72), "mocap_framerate": 30, **amass}),
        "amass smpl-x": (
            ".npz",
            {
                "root_orient": body[:, :3], "pose_body": body[:, 3:], "pose_hand": hand, "pose_jaw": np.ones((COUNT, 3)),
                "mocap_frame_rate": np.array([30.0]), "surface_model_type": np.array("smplx"), **amass,
            },
        ),
        "amass smpl-x, poses": (
            ".npz", {"poses": np.c_[body, np.ones((COUNT, 9)), hand], "mocap_frame_rate": 30.0, **amass},
        ),
        "body_pose": (
            ".pkl",
            {
                "body_pose": poses[:, 1:].reshape(COUNT, 69), "global_orient": poses[:, 0], "transl": transl,
                "betas": np.tile(np.arange(10.0), (COUNT, 1)),
            },
        ),
        "vto": (".pkl", {"pose": poses.reshape(COUNT, 72), "translation": transl, "shape": np.arange(10.0)}),
        "amass pickled": (".pkl", {"poses": np.c_[body, hand], "mocap_framerate": 30.0, **amass}),
    }  # fmt: skip


def write(path: Path, fields: dict[str, Any]) -> Path:
    if path.suffix == ".npz":
        np.savez(path, **fields)
    else:
        path.write_bytes(pickle.dumps(fields, 2))
    return path


@pytest.mark.parametrize("name", layouts())
def test_every_layout_is_the_same_motion(name: str, tmp_path: Path) -> None:
    suffix, fields = layouts()[name]
    poses, fingers, transl = recorded()
    path = write(tmp_path / f"m{suffix}", fields)
    found = read_recording(path)
    np.testing.assert_array_equal(found.poses[:, :22], poses[:, :22])
    np.testing.assert_array_equal(found.transl, transl)
    assert found.fps == 30.0
    assert found.up == ("y" if name in ("body_pose", "vto") else "z")
    smpl = name in ("amass smpl", "body_pose", "vto")
    assert found.family == ("smpl" if smpl else "smplx" if "smpl-x" in name else "smplh")
    if smpl:
        np.testing.assert_array_equal(found.poses[:, 22:], poses[:, 22:])
        assert found.fingers is None
    else:
        assert not found.poses[:, 22:].any()
        np.testing.assert_array_equal(found.fingers, fingers)
    count = 16 if "amass" in name else 10
    np.testing.assert_array_equal(found.betas, np.arange(float(count)))
    assert found.gender == ("male" if "amass" in name else None)
    # As it is performed: y up, hands flat unless asked for.
    turn = np.eye(3) if found.up == "y" else Z_UP_TO_Y_UP
    flat, full = load_sequence(path), load_sequence(path, hands="file")
    np.testing.assert_allclose(flat.transl, transl @ turn.T, atol=1e-12)
    assert not flat.poses[:, 22:].any()
    assert flat.fingers is None
    assert full.poses[:, 22:].any() == smpl
    assert (full.fingers is not None) != smpl


def test_fingers_are_resampled_and_cut_with_the_body(tmp_path: Path) -> None:
    _, fields = layouts()["amass smpl+h"]
    path = write(tmp_path / "m.npz", fields)
    sequence = load_sequence(path, 60.0, hands="file", start="2f")
    assert sequence.fingers.shape == (2 * (COUNT - 3) + 1, 30, 3)
    assert sequence.window(3, 5).fingers.shape == (2, 30, 3)
    # Rotations, not their coordinates, are the same.
    own, recorded_ = (Rotation.from_rotvec(x.reshape(-1, 3)) for x in (sequence.fingers[::2], recorded()[1][2:]))
    assert (own.inv() * recorded_).magnitude().max() < 1e-9


def test_frame_rate_given_by_the_caller(tmp_path: Path) -> None:
    _, fields = layouts()["vto"]
    path = write(tmp_path / "m.pkl", fields)
    assert read_recording(path, 50.0).fps == 50.0
    assert load_sequence(path, 25.0, file_fps=50.0).num_frames == 5
    assert read_recording(write(path, fields | {"fps": 60})).fps == 60.0
    with pytest.raises(ValueError, match=r"m\.pkl: file_fps=0"):
        read_recording(path, 0.0)
    fields = layouts()["amass smpl"][1]
    del fields["mocap_framerate"]
    path = write(tmp_path / "m.npz", fields)
    with pytest.raises(ValueError, match="no mocap_framerate.*file_fps"):
        read_recording(path)
    assert read_recording(path, 120.0).fps == 120.0


def test_gender_of_old_files(tmp_path: Path) -> None:
    _, fields = layouts()["amass smpl"]
    for text, gender in ((b"female", "female"), ("b'male'", "male"), ("Neutral", "neutral"), ("other", None)):
        path = write(tmp_path / "m.npz", fields | {"gender": np.array(text)})
        assert read_recording(path).gender == gender


REFUSED = {
    "shape over time": ("body_pose", {"betas": np.arange(90.0).reshape(9, 10)}, "betas changes in frame 1"),
    "no numbers": ("vto", {"pose": np.array(["a"] * 9)}, "pose holds <U1"),
    "ragged": ("vto", {"translation": np.zeros((9, 2))}, r"translation has shape \(9, 2\)"),
    "not finite": ("vto", {"translation": np.full((9, 3), np.nan)}, "translation is not finite in frame 0"),
    "absurd": ("vto", {"translation": np.full((9, 3), 1e200)}, r"translation is beyond ±1e\+06 in frame 0"),
    "rates": ("amass smpl", {"mocap_framerate": np.ones((2, 2))}, "mocap_framerate is"),
    "fingers": ("amass smpl-x", {"pose_hand": np.zeros((4, 90))}, "pose_hand has 4 frames"),
    "frames": ("body_pose", {"global_orient": np.zeros((3, 3))}, "global_orient and body_pose have"),
    "rate": ("amass smpl", {"mocap_framerate": 1e9}, "mocap_framerate is 1000000000"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_file_and_key(case: str, tmp_path: Path) -> None:
    name, change, words = REFUSED[case]
    suffix, fields = layouts()[name]
    with pytest.raises(ValueError, match=rf"m{suffix}: {words}") as error:
        read_recording(write(tmp_path / f"m{suffix}", fields | change))
    assert "\n" not in str(error.value)


def test_other_contents_say_what_they_are(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds a mesh.*body="):
        read_recording(write(tmp_path / "m.npz", {"verts": np.zeros((2, 3, 3)), "faces": np.zeros((1, 3))}))
    with pytest.raises(ValueError, match="body model"):
        read_recording(write(tmp_path / "m.npz", {"v_template": np.zeros((2, 3))}))
    with pytest.raises(ValueError, match="holds a list"):
        read_recording(write(tmp_path / "m.pkl", ["a"]))
    with pytest.raises(ValueError, match="holds a str"):
        read_recording(write(tmp_path / "m.pkl", "a"))
    with pytest.raises(ValueError, match="unknown motion format '.bvh'"):
        read_recording(tmp_path / "m.bvh")


def test_absurd_counts_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    """A header of 100 GB over a few bytes, and a member that unpacks to more than the limit."""
    path = tmp_path / "m.npz"
    header = str({"descr": "<f8", "fortran_order": False, "shape": (10**8, 156)}).encode()
    header += b" " * (64 - (len(header) + 11) % 64) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("poses.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 64)
    with pytest.raises(ValueError, match=r"m\.npz.*'poses' claims shape \(100000000, 156\)"):
        read_recording(path)
    np.savez_compressed(path, trans=np.zeros((1000, 3)))
    with pytest.raises(ValueError, match="unpacks to .* the limit is 20000"):
        read_arrays(path, (), "AMASS motion", size_limit=20_000)

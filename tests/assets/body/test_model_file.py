"""Body models of the family from every kind of file; SMPL-H and SMPL-X motions on them against a direct evaluation."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from imitations import evaluate, model_arrays, write_official_pickle

from hood.assets.body.body import Body
from hood.assets.body.load import choose_model, load_body, model_gender, read_model
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import Z_UP_TO_Y_UP, PoseSequence

SKELETONS = {"smpl": 24, "smplh": 52, "smplx": 55}


def write_model(path: Path, family: str, **extra: np.ndarray) -> dict[str, np.ndarray]:
    arrays = model_arrays(SKELETONS[family]) | extra
    np.savez(path, **arrays)
    return arrays


def random_poses(num_frames: int, num_joints: int, seed: int = 3) -> np.ndarray:
    """Smooth (N, J, 3)."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, num_frames)[:, None, None]
    return rng.normal(scale=0.4, size=(1, num_joints, 3)) + rng.normal(scale=0.3, size=(1, num_joints, 3)) * np.sin(5 * time)


def world(body: Body, sequence: PoseSequence, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints and vertices in the world, float64."""
    translation = body.translation(sequence, betas)[:, None]
    transforms = body.transforms(sequence, betas, torch.float64).numpy()
    rest = body.shaped(betas)[1]
    joints = np.einsum("tjab,jb->tja", transforms[..., :3], rest) + transforms[..., 3]
    return joints + translation, body.surface(sequence, betas, torch.float64).numpy() + translation


@pytest.mark.parametrize("family", SKELETONS)
@pytest.mark.parametrize("hands", ["flat", "file"])
def test_amass_on_the_model_that_recorded_it(family: str, hands: str, tmp_path: Path) -> None:
    """Joints and vertices to 1e-6 m at common time stamps: resampled, turned y up about the world's origin, with the
    subject's shape and the pose blend shapes."""
    arrays = write_model(tmp_path / "model.npz", family)
    num_joints = SKELETONS[family]
    poses, rng = random_poses(41, num_joints), np.random.default_rng(5)
    transl, betas = rng.normal(size=(41, 3)), rng.normal(size=16)
    if family == "smplx":
        fields = {
            "root_orient": poses[:, 0], "pose_body": poses[:, 1:22].reshape(41, -1), "pose_jaw": poses[:, 22],
            "pose_eye": poses[:, 23:25].reshape(41, -1), "pose_hand": poses[:, 25:].reshape(41, -1),
            "surface_model_type": "smplx", "mocap_frame_rate": 120.0,
        }  # fmt: skip
    else:
        fields = {"poses": poses.reshape(41, -1), "mocap_framerate": 120.0}
    np.savez(tmp_path / "walk.npz", trans=transl, betas=betas, gender="female", **fields)

    sequence = load_sequence(tmp_path / "walk.npz", 30.0, hands=hands)
    body = load_body(tmp_path / "model.npz")
    assert (sequence.family, body.family, sequence.gender) == (family, family, "female")
    subject = body.subject_betas(sequence)
    np.testing.assert_array_equal(subject, betas)

    shown = np.zeros_like(poses)
    driven = 22 if hands == "flat" or family == "smplx" else num_joints
    shown[:, :driven] = poses[:, :driven]
    if hands == "file" and family == "smplx":
        shown[:, 25:] = poses[:, 25:]  # jaw and eyes play no role for cloth
    expected = evaluate(arrays, betas, shown[::4], transl[::4])
    for own, direct in zip(world(body, sequence, subject), expected, strict=True):
        np.testing.assert_allclose(own, direct @ Z_UP_TO_Y_UP.T, rtol=0, atol=1e-6)
    # The same in single precision, and the double result again after it.
    single = body.surface(sequence, subject, torch.float32)
    assert single.dtype == torch.float32
    np.testing.assert_allclose(
        single.numpy() + body.translation(sequence, subject)[:, None], expected[1] @ Z_UP_TO_Y_UP.T, atol=2e-6
    )
    np.testing.assert_allclose(world(body, sequence, subject)[1], expected[1] @ Z_UP_TO_Y_UP.T, rtol=0, atol=1e-9)


def test_betas_of_another_model_are_not_applied(tmp_path: Path) -> None:
    write_model(tmp_path / "smplx.npz", "smplx")
    np.savez(tmp_path / "m.npz", poses=np.zeros((3, 156)), trans=np.zeros((3, 3)), betas=np.ones(16), mocap_framerate=30.0)
    sequence = load_sequence(tmp_path / "m.npz")
    assert sequence.family == "smplh"
    assert not load_body(tmp_path / "smplx.npz").subject_betas(sequence).any()
    assert not load_body().subject_betas(sequence).any()


@pytest.mark.parametrize("protocol", [0, 2])
def test_official_pickles_without_chumpy(tmp_path: Path, protocol: int) -> None:
    arrays = model_arrays(24, 10)
    np.savez(tmp_path / "a.npz", **arrays)
    write_official_pickle(tmp_path / "b.pkl", arrays, protocol)
    first, second = load_body(tmp_path / "a.npz"), load_body(tmp_path / "b.pkl")
    assert second.parents == first.parents == tuple(arrays["kintree_table"][0])
    for name in ("v_template", "shapedirs", "posedirs", "joint_regressor", "weights", "faces"):
        np.testing.assert_allclose(getattr(second, name), getattr(first, name), rtol=0, atol=1e-15)


def test_a_file_that_changes_is_read_again(tmp_path: Path) -> None:
    arrays = model_arrays(24, 10)
    np.savez(tmp_path / "a.npz", **arrays)
    first = load_body(tmp_path / "a.npz")
    assert load_body(tmp_path / "a.npz") is first
    np.savez(tmp_path / "a.npz", **{**arrays, "v_template": 2.0 * arrays["v_template"]})
    np.testing.assert_array_equal(load_body(tmp_path / "a.npz").v_template, 2.0 * first.v_template)


def test_expression_directions_are_no_shapes(tmp_path: Path) -> None:
    for columns, shapes in ((400, 16), (20, 10), (12, 12)):
        np.savez(tmp_path / "x.npz", **model_arrays(55, columns, num_vertices=40))
        assert load_body(tmp_path / "x.npz").shapedirs.shape[2] == shapes


def test_gender_chooses_among_the_files_of_a_folder(tmp_path: Path) -> None:
    for family in ("flat", "nested"):
        (tmp_path / family).mkdir()
    arrays = model_arrays(24, 10, num_vertices=30)
    for number, gender in enumerate(("NEUTRAL", "MALE", "FEMALE")):
        own = arrays | {"v_template": arrays["v_template"] + number}
        np.savez(tmp_path / "flat" / f"SMPL_{gender}.npz", **own)
        (tmp_path / "nested" / gender.lower()).mkdir()
        np.savez(tmp_path / "nested" / gender.lower() / "model.npz", **own)
    for folder in ("flat", "nested"):
        for number, gender in enumerate((None, "male", "female")):
            chosen = load_body(tmp_path / folder, gender)
            np.testing.assert_allclose(chosen.v_template, arrays["v_template"] + number)
    assert model_gender(Path("basicModel_f_lbs_10_207_0_v1.0.0.pkl")) == "female"
    assert model_gender(Path("basicmodel_m_lbs.pkl")) == "male"
    assert model_gender(Path("smpl.pkl")) is None
    (tmp_path / "flat" / "SMPL_FEMALE.npz").unlink()
    with pytest.raises(ValueError, match=r"no female model among SMPL_MALE\.npz.*gender="):
        choose_model(tmp_path / "flat", "female")
    with pytest.raises(ValueError, match="gender 'x'"):
        choose_model(tmp_path / "flat", "x")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="no body model"):
        load_body(tmp_path / "empty")
    (tmp_path / "flat" / "SMPL_MALE.npz").unlink()
    assert choose_model(tmp_path / "flat", "male").name == "SMPL_NEUTRAL.npz"  # the only one


DAMAGE = {
    "weights": (lambda a: a.update(weights=a["weights"][0]), "weights has shape"),
    "no weight": (lambda a: a["weights"].__setitem__(4, 0.0), "weights of vertex 4"),
    "template": (lambda a: a.update(v_template=a["v_template"][:-1]), r"v_template has shape \(29, 3\)"),
    "posedirs": (lambda a: a.update(posedirs=a["posedirs"][..., :-1]), r"posedirs has shape.*\(30, 3, 207\)"),
    "faces": (lambda a: a["f"].__setitem__((0, 0), 30), "f refers to vertices outside 0 … 29"),
    "parents": (lambda a: a["kintree_table"].__setitem__((0, 5), 7), "joint 5 the parent 7"),
    "text": (lambda a: a.update(shapedirs=np.array("no")), "shapedirs holds"),
    "infinite": (lambda a: a["shapedirs"].__setitem__((0, 0, 0), np.inf), "shapedirs is not finite"),
    "joints": (lambda a: a.update(model_arrays(24, 10, 30) | cut(20)), "20 joints; SMPL has 24"),
}


def cut(joints: int) -> dict[str, np.ndarray]:
    arrays = model_arrays(24, 10, 30)
    return {
        "weights": arrays["weights"][:, :joints], "J_regressor": arrays["J_regressor"][:joints],
        "kintree_table": arrays["kintree_table"][:, :joints], "posedirs": np.ones((30, 3, 9 * (joints - 1))),
    }  # fmt: skip


@pytest.mark.parametrize("case", DAMAGE)
def test_damaged_models_name_file_and_key(case: str, tmp_path: Path) -> None:
    change, words = DAMAGE[case]
    arrays = model_arrays(24, 10, 30)
    change(arrays)
    np.savez(tmp_path / "model.npz", **arrays)
    with pytest.raises(ValueError, match=rf"model\.npz: .*{words}") as error:
        load_body(tmp_path / "model.npz")
    assert "\n" not in str(error.value)


class Call:
    """Pickles as a call of ``os.system``."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {self.marker}",)


def test_harmful_pickles_run_nothing(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    harmful = tmp_path / "smpl.pkl"
    harmful.write_bytes(pickle.dumps({"v_template": Call(marker), "pose": Call(marker)}))
    for read in (load_body, load_sequence):
        with pytest.raises(ValueError, match=r"smpl\.pkl: names .*system"):
            read(harmful)
    assert not marker.exists()


def test_other_files(tmp_path: Path) -> None:
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1]))
    with pytest.raises(ValueError, match="holds a list, not a body model"):
        read_model(tmp_path / "list.pkl")
    (tmp_path / "body.other").write_text("x")
    with pytest.raises(ValueError, match="unknown body model format"):
        load_body(tmp_path / "body.other")
    (tmp_path / "body.fbx").write_text("x")
    with pytest.raises(ValueError, match=r"body\.fbx: FBX files are not read; export .* as GLB"):
        load_body(tmp_path / "body.fbx")

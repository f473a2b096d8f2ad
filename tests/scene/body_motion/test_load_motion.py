"""What a body's name means, and which options reach it."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.scene.body_motion.load import MotionOptions, load_motion
from hood.scene.body_motion.mesh_motion import MeshMotion, NoBody
from hood.scene.body_motion.motion import BodyMotion
from hood.testing import sphere


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory, body: Body) -> Path:
    """A folder with a male and a female SMPL-like model, one of them 10 cm taller."""
    folder = tmp_path_factory.mktemp("models")
    rng = np.random.default_rng(0)
    for gender, height in (("MALE", 0.1), ("FEMALE", 0.0)):
        np.savez(
            folder / f"SMPL_{gender}.npz", v_template=body.v_template + [0, height, 0], shapedirs=body.shapedirs,
            posedirs=rng.normal(scale=1e-3, size=(6890, 3, 207)).astype(np.float32), J_regressor=body.joint_regressor,
            weights=body.weights, kintree_table=np.array([body.parents, range(24)]), f=body.faces,
        )  # fmt: skip
    return folder


def recording(path: Path, **fields: object) -> Path:
    base = {"poses": np.zeros((90, 72)), "trans": np.zeros((90, 3)), "mocap_framerate": 30.0, "betas": np.full(10, 0.5)}
    np.savez(path, **(base | fields))
    return path


def test_gender_and_shape_come_from_the_motion(models: Path, tmp_path: Path) -> None:
    motion = load_motion(models, recording(tmp_path / "m.npz", gender="female"))
    assert isinstance(motion, BodyMotion)
    assert motion.body.name == "SMPL_FEMALE"
    np.testing.assert_array_equal(motion.betas, np.full(10, 0.5))
    options = MotionOptions(gender="male", betas=[1.0, -2.0])
    motion = load_motion(models, tmp_path / "m.npz", options)
    assert motion.body.name == "SMPL_MALE"
    np.testing.assert_array_equal(motion.betas, [1, -2, 0, 0, 0, 0, 0, 0, 0, 0])
    # The embedded body has shapes of its own.
    assert not load_motion("default", tmp_path / "m.npz").betas.any()


def test_options_of_motions(tmp_path: Path) -> None:
    path = recording(tmp_path / "m.npz")
    motion = load_motion("default", path, MotionOptions(fps=15.0, start=1.0, stop=2.0, loop=2, blend_in=1.0, file_fps=45.0))
    assert motion.fps == 15.0
    # Seconds 1 to 2 of the file's 90 frames (cut to its end at 45 fps) are 15 at 15 fps, two plays share a frame, and a
    # second of standing comes first.
    assert motion.num_frames == 15 + 2 * 15 - 1


def test_shapes_beyond_those_of_people_are_doubted() -> None:
    with pytest.warns(UserWarning, match=r"^betas\[1\]=15 is beyond .*-5 to 5.*if a point is missing, give 1.5$"):
        load_motion("default", "walk_proud", MotionOptions(betas=[0.0, 15.0]))
    with pytest.warns(UserWarning, match=r"^betas\[0\]=-100 is beyond .*may not fit it$"):
        load_motion("default", "walk_proud", MotionOptions(betas=[-100.0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_motion("default", "walk_proud", MotionOptions(betas=[5.0, -5.0]))


@pytest.mark.parametrize("betas", [[np.nan], list(range(11))])
def test_shapes_that_are_none(betas: list) -> None:
    with pytest.raises(ValueError, match="betas="):
        load_motion("default", "walk_proud", MotionOptions(betas=betas))


def test_meshes_and_no_body(tmp_path: Path) -> None:
    points, faces = sphere(1, 0.5)
    np.savez(tmp_path / "ball.npz", verts=np.stack([points, points + 0.1, points]), faces=faces, fps=10.0)
    motion = load_motion(tmp_path / "ball.npz", "none", MotionOptions(fps=20.0, loop=2))
    assert isinstance(motion, MeshMotion)
    assert motion.num_frames == 9
    np.savez(tmp_path / "rock.npz", verts=points, faces=faces)
    assert load_motion(tmp_path / "rock.npz", "none", MotionOptions(num_frames=33)).num_frames == 33
    nothing = load_motion("none", "none", MotionOptions(num_frames=12, fps=50.0))
    assert isinstance(nothing, NoBody)
    assert (nothing.num_frames, nothing.fps) == (12, 50.0)


def test_a_body_without_a_motion_is_refused() -> None:
    with pytest.raises(ValueError, match="body=default has no motion of its own and sequence=none; give a motion"):
        load_motion("default", "none")

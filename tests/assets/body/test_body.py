"""Bodies from files: the embedded one, SMPL-like ones with pose blend shapes, skeletons with fingers, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.assets.garment.binding import bind_garment
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.scene.scene import build_scene


@pytest.fixture(scope="module")
def arrays(body_file: Path) -> dict[str, np.ndarray]:
    with np.load(body_file) as archive:
        return dict(archive)


@pytest.fixture(scope="module")
def smpl_file(tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, np.ndarray]) -> Path:
    """The default body with random pose blend shapes of millimetres."""
    path = tmp_path_factory.mktemp("smpl") / "smpl.npz"
    rng = np.random.default_rng(0)
    np.savez(path, **{**arrays, "posedirs": rng.normal(scale=2e-3, size=(6890, 3, 207)).astype(np.float32)})
    return path


@pytest.fixture(scope="module")
def fingered_file(tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, np.ndarray]) -> Path:
    """A file in SMPL-H layout: the default body's hands given to the first of 15 finger joints a side."""
    path = tmp_path_factory.mktemp("smplh") / "smplh.npz"
    rng = np.random.default_rng(1)
    parents = [*arrays["kintree_table"][0, :22]]
    for wrist, first in ((20, 22), (21, 37)):
        for finger in range(5):
            base = first + 3 * finger
            parents += [wrist, base, base + 1]
    weights, regressor = np.zeros((6890, 52)), np.zeros((52, 6890))
    weights[:, :22], weights[:, [22, 37]] = arrays["weights"][:, :22], arrays["weights"][:, 22:]
    regressor[:22] = arrays["J_regressor"][:22]
    regressor[22:37], regressor[37:] = arrays["J_regressor"][22], arrays["J_regressor"][23]
    np.savez(
        path,
        **{key: arrays[key] for key in ("v_template", "shapedirs", "f")},
        weights=weights,
        J_regressor=regressor,
        kintree_table=np.stack([np.array(parents, dtype=np.int64), np.arange(52)]),
        posedirs=rng.normal(scale=2e-3, size=(6890, 3, 459)).astype(np.float32),
        **{f"hands_{name}{side}": np.zeros(45) for name in ("mean",) for side in "lr"},
        **{f"hands_components{side}": np.eye(45) for side in "lr"},
    )
    return path


def bent(num_frames: int = 2, seed: int = 2) -> PoseSequence:
    poses = np.zeros((num_frames, 24, 3))
    poses[:, :22] = np.random.default_rng(seed).normal(scale=0.3, size=(num_frames, 22, 3))
    return PoseSequence("bent", poses, np.zeros((num_frames, 3)), 30.0, np.zeros(10), np.eye(3))


def test_betas_move_surface_and_joints_linearly(body: Body) -> None:
    rng = np.random.default_rng(0)
    betas = rng.normal(size=10)
    rest, joints = body.shaped(betas)
    half_rest, half_joints = body.shaped(betas / 2)
    np.testing.assert_allclose(rest + body.v_template, 2 * half_rest, atol=1e-12)
    assert np.abs(rest - body.v_template).max() > 0.01
    assert np.abs(joints - half_joints).max() > 0.001
    np.testing.assert_allclose(body.shaped(np.zeros(0))[0], body.v_template)
    np.testing.assert_allclose(body.shaped(betas[:3])[0], body.shaped(np.r_[betas[:3], np.zeros(7)])[0])


def test_surface_in_both_precisions(body: Body) -> None:
    betas = np.linspace(-1, 1, 10)
    single, double = (body.surface(bent(), betas, dtype) for dtype in (torch.float32, torch.float64))
    assert single.dtype == torch.float32
    assert float((single - double).abs().max()) < 2e-6


def test_omitted_vertices_are_the_hands(body: Body) -> None:
    omitted = body.omitted
    assert 100 < omitted.sum() < 3000
    wrists = body.shaped(np.zeros(10))[1][[20, 21], 0]
    reach = np.abs(body.v_template[:, 0])
    assert reach[omitted].min() > 0.9 * np.abs(wrists).min()
    assert omitted[reach.argmax()]


def test_pose_blend_shapes_go_through_smplx(smpl_file: Path, body: Body) -> None:
    smplx = pytest.importorskip("smplx")
    licensed = load_body(smpl_file)
    betas = np.linspace(-1.5, 1.5, 10)
    sequence = bent()
    surface = licensed.surface(sequence, betas, torch.float64)
    with np.load(smpl_file) as archive:
        model = smplx.SMPL("", data_struct=smplx.utils.Struct(**dict(archive)), dtype=torch.float64).double()
    poses = torch.as_tensor(sequence.poses).flatten(1)
    with torch.no_grad():
        expected = model(
            betas=torch.as_tensor(betas).expand(2, 10), global_orient=poses[:, :3], body_pose=poses[:, 3:]
        ).vertices
    assert float((surface - expected).abs().max()) < 1e-6
    assert float((surface - body.surface(sequence, betas, torch.float64)).abs().max()) > 1e-3
    assert float((licensed.surface(sequence, betas, torch.float32) - surface).abs().max()) < 1e-5


def test_skeleton_with_fingers(fingered_file: Path, smpl_file: Path, walk: PoseSequence, body: Body) -> None:
    licensed = load_body(fingered_file)
    assert licensed.num_joints == 52
    np.testing.assert_array_equal(licensed.omitted, body.omitted)
    # Garments are skinned by the own function: its joints must be those of the surface.
    sequence, betas = bent(), np.linspace(-1, 1, 10)
    own = licensed.transforms(sequence, betas, torch.float64)[:, :22]
    torch.testing.assert_close(own, body.transforms(sequence, betas, torch.float64)[:, :22], rtol=0, atol=1e-6)
    surface = licensed.surface(sequence, betas)
    assert surface.shape == (2, 6890, 3)
    plain = body.surface(sequence, betas)
    # Blend shapes of 459 random directions of 2 mm each: near, not equal.
    assert 1e-3 < float((surface - plain).norm(dim=2).mean()) < 0.1


def test_a_garment_is_dressed_on_a_licensed_body(fingered_file: Path, garments: dict[str, Garment], walk: PoseSequence) -> None:
    licensed = load_body(fingered_file)
    assert bind_garment(garments["tank"], licensed).lbs_weights.shape[1] == 52
    scene = build_scene(garments["tank"], licensed, walk.window(0, 2))
    assert bool(torch.isfinite(scene.motion.skinned(scene.garment, 0, scene.motion.translation[0])).all())


def test_broken_pickles_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    path.write_bytes(b"\x80\x04.")
    with pytest.raises(ValueError, match=r"SMPL_NEUTRAL\.pkl: not a readable pickle"):
        load_body(path)


def test_incomplete_and_mismatched_files(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    small = {key: value for key, value in arrays.items() if key != "posedirs"}
    np.savez(tmp_path / "a.npz", **{key: value for key, value in small.items() if key != "J_regressor"})
    with pytest.raises(ValueError, match=r"a\.npz: not a body model file: key 'J_regressor'"):
        load_body(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **{**small, "v_template": small["v_template"][:-1]})
    with pytest.raises(ValueError, match=r"b\.npz: v_template"):
        load_body(tmp_path / "b.npz")

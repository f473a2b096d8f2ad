"""Motions and garments beyond the ordinary are what they say, and files like any other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.assets.body.load import load_body
from hood.assets.formats.mesh_file import read_mesh_file
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import PoseSequence
from hood.mesh.topology import connected_components, unique_edges
from hood.studies.envelope.extreme_files import CALM, MOTIONS, write_garment, write_motion, write_still_body


def motion(folder: Path, name: str) -> PoseSequence:
    path = folder / "m.npz"
    write_motion(path, name, 2.0)
    return load_sequence(path, fps=60.0)


def test_a_teleport_is_one_step_after_a_calm(tmp_path: Path) -> None:
    moved = np.linalg.norm(np.diff(motion(tmp_path, "teleport:0.5").transl, axis=0), axis=1)
    assert np.flatnonzero(moved > 1e-9).tolist() == [round(60 * CALM)]
    assert moved.max() == pytest.approx(0.5)


def test_a_spin_turns_the_body_about_the_upright_axis(tmp_path: Path) -> None:
    poses = motion(tmp_path, "spin:2").poses[:, 0]
    turns = Rotation.from_rotvec(poses[40:]) * Rotation.from_rotvec(poses[39:-1]).inv()
    np.testing.assert_allclose(turns.as_rotvec(), np.tile([0.0, 2 * np.pi * 2 / 60, 0.0], (len(turns), 1)), atol=1e-6)


def test_a_stop_takes_so_many_g(tmp_path: Path) -> None:
    speed = 60.0 * np.linalg.norm(np.diff(motion(tmp_path, "stop:1").transl, axis=0), axis=1)
    assert speed.max() == pytest.approx(3.0)
    assert -60.0 * np.diff(speed).min() == pytest.approx(9.81, rel=1e-3)
    assert speed[-1] == pytest.approx(0.0, abs=1e-6)


def test_far_away_and_at_rest(tmp_path: Path) -> None:
    assert np.linalg.norm(motion(tmp_path, "offset:10000").transl[0]) > 1e4
    still = motion(tmp_path, "rest")
    assert float(np.ptp(still.transl, axis=0).max()) == 0.0


def test_a_turn_happens_at_once(tmp_path: Path) -> None:
    root = Rotation.from_rotvec(motion(tmp_path, "turn:90").poses[:, 0])
    steps = (root[1:] * root[:-1].inv()).magnitude()
    assert np.flatnonzero(steps > 1e-6).tolist() == [round(60 * CALM)]
    np.testing.assert_allclose((root[-1] * root[0].inv()).as_rotvec(), [0.0, np.pi / 2, 0.0], atol=1e-6)


def test_a_fall_is_free_and_ends_at_once(tmp_path: Path) -> None:
    height = motion(tmp_path, "fall:2").transl[:, 1]
    assert height[0] - height[-1] == pytest.approx(2.0)
    speed = -60.0 * np.diff(height)
    np.testing.assert_allclose(60.0 * np.diff(speed)[31:60], 9.81, rtol=1e-3)
    assert speed.max() == pytest.approx(np.sqrt(2 * 9.81 * 2.0), rel=0.03)
    assert speed[-1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("name", ["through:130", "crossed:110", "crouch:110", "split:45", "reach:80", "handstand:180"])
def test_a_pose_is_taken_within_a_second_without_a_jump_and_held(tmp_path: Path, name: str) -> None:
    write_motion(tmp_path / "m.npz", name, 2.5)
    poses = load_sequence(tmp_path / "m.npz", fps=60.0).poses
    turned = Rotation.from_rotvec(poses[1:].reshape(-1, 3)) * Rotation.from_rotvec(poses[:-1].reshape(-1, 3)).inv()
    steps = turned.magnitude().reshape(len(poses) - 1, -1).max(axis=1)
    assert steps[: round(60 * CALM) - 1].max() < 1e-9
    assert steps[round(60 * (CALM + 1.0)) :].max() < 1e-6
    assert 0.0 < steps.max() < 0.1


def posed(tmp_path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Joints (24, 3) of the default body and its surface (W, 3) at the end of a motion."""
    body, sequence = load_body(), motion(tmp_path, name)
    last = sequence.window(sequence.num_frames - 1, sequence.num_frames)
    betas = np.zeros(10)
    moved, away = body.transforms(last, betas)[0].numpy(), body.translation(last, betas)[0]
    joints = body.shaped(betas)[1]
    at = np.einsum("jab,jb->ja", moved[:, :, :3], joints[: len(moved)]) + moved[:, :, 3] + away
    return at, body.surface(last, betas)[0].numpy() + away


def test_poses_are_what_they_are_called(tmp_path: Path) -> None:
    standing, surface = posed(tmp_path, "rest")
    hip, knee, ankle, head, wrist = 1, 4, 7, 15, (20, 21)
    through, _ = posed(tmp_path, "through:130")
    assert through[wrist[0], 0] < through[hip, 0] - 0.05  # the left hand has passed into the trunk
    crossed, _ = posed(tmp_path, "crossed:110")
    assert crossed[wrist[0], 0] < 0.0 < crossed[wrist[1], 0]
    assert (crossed[list(wrist), 2] > standing[head, 2] + 0.1).all()
    crouch, low = posed(tmp_path, "crouch:110")
    assert crouch[hip, 1] < standing[hip, 1] - 0.4
    assert crouch[knee, 1] > crouch[hip, 1] - 0.2
    assert abs(low[:, 1].min() - surface[:, 1].min()) < 0.1
    split, _ = posed(tmp_path, "split:45")
    assert np.degrees(np.arctan2(split[ankle, 0] - split[hip, 0], split[hip, 1] - split[ankle, 1])) > 35.0
    reach, _ = posed(tmp_path, "reach:80")
    assert (reach[list(wrist), 1] > reach[head, 1] + 0.2).all()
    over, _ = posed(tmp_path, "handstand:180")
    assert over[head, 1] < over[hip, 1] < over[ankle, 1]
    assert (over[list(wrist), 1] < over[head, 1] - 0.2).all()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nan:poses", r"m\.npz: poses is not finite in frame"),
        ("inf:trans", r"m\.npz: trans is not finite in frame"),
        ("nan:betas", r"m\.npz: betas has shape \(16,\) or absurd values"),
        ("nan:mocap_framerate", r"m\.npz: mocap_framerate is nan"),
        ("empty", r"m\.npz: not a readable AMASS motion"),
        ("cut", r"m\.npz: not a readable AMASS motion"),
    ],
)
def test_broken_motions_are_refused_by_name(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        motion(tmp_path, name)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nan:rest_pos", r"g\.npz: vertex .* positions must be finite"),
        ("inf:uv", r"g\.npz: uv has row 527, which is not finite; repair it, or leave uv out"),
        ("nan:lbs_weights", r"g\.npz: lbs_weights of vertex 497 is not finite"),
        ("nan:shapedirs", r"g\.npz: shapedirs of vertex 497 is not finite"),
        ("faces:beyond", r"g\.npz: face 942 refers to vertices .* 1000000"),
        ("faces:negative", r"g\.npz: face 942 refers to vertices .* -1"),
        ("empty", r"g\.npz: not a readable garment"),
        ("cut", r"g\.npz: not a readable garment"),
    ],
)
def test_broken_garments_are_refused_by_name(tmp_path: Path, name: str, words: str) -> None:
    write_garment(tmp_path / "g.npz", "dress", name)
    with pytest.raises(ValueError, match=words):
        load_garment(tmp_path / "g.npz")


def test_names_that_are_not_known_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown motion 'spun': did you mean 'spin'"):
        write_motion(tmp_path / "x.npz", "spun", 1.0)
    with pytest.raises(ValueError, match="unknown fault 'hole': .*known are size"):
        write_garment(tmp_path / "x.npz", "tank", "hole")
    assert not list(tmp_path.iterdir())
    assert {"teleport", "turn", "handstand"} <= set(MOTIONS)


@pytest.mark.parametrize("fault", ["slivers:100", "duplicates:20", "isolated:10"])
def test_a_grown_garment_keeps_its_shape(tmp_path: Path, fault: str) -> None:
    whole = load_garment("tank")
    write_garment(tmp_path / "g.npz", "tank", fault)
    grown = load_garment(tmp_path / "g.npz")
    count, more = len(whole.rest_pos), len(grown.rest_pos) - len(whole.rest_pos)
    assert more == {"slivers:100": 10, "duplicates:20": 20, "isolated:10": 10}[fault]
    np.testing.assert_array_equal(grown.rest_pos[:count], whole.rest_pos)
    assert area(grown.rest_pos, grown.faces) == pytest.approx(area(whole.rest_pos, whole.faces), rel=1e-6)
    used = np.isin(np.arange(count, count + more), grown.faces)
    assert bool(used.any()) is (fault != "isolated:10")
    if fault == "duplicates:20":
        near = np.linalg.norm(grown.rest_pos[count:, None] - whole.rest_pos[None], axis=2).min(axis=1)
        assert near.max() < 2e-6
    if fault == "slivers:100":
        heights = 2.0 * areas(grown.rest_pos, grown.faces) / longest(grown.rest_pos, grown.faces)
        assert (longest(grown.rest_pos, grown.faces) / heights).max() > 50.0


def test_other_faults(tmp_path: Path) -> None:
    whole = load_garment("tank")
    write_garment(tmp_path / "small.npz", "tank", "size:0.5")
    small = load_garment(tmp_path / "small.npz")
    np.testing.assert_allclose(small.rest_pos, 0.5 * whole.rest_pos)
    assert small.skin_pos is not None
    np.testing.assert_allclose(small.skin_pos, whole.worn_pos)
    write_garment(tmp_path / "flipped.npz", "tank", "flipped:30")
    assert int((load_garment(tmp_path / "flipped.npz").faces != whole.faces).any(axis=1).sum()) == 30


def test_an_irregular_garment_has_the_same_faces_and_uneven_edges(tmp_path: Path) -> None:
    whole = load_garment("tank")
    write_garment(tmp_path / "g.npz", "tank", "irregular:0.6")
    moved = load_garment(tmp_path / "g.npz")
    np.testing.assert_array_equal(moved.faces, whole.faces)
    spread = [np.std(longest(g.rest_pos, g.faces)) / np.mean(longest(g.rest_pos, g.faces)) for g in (whole, moved)]
    assert spread[1] > 1.3 * spread[0]
    assert moved.lbs_weights is not None
    np.testing.assert_allclose(moved.lbs_weights.sum(axis=1), 1.0)


def test_components_are_so_many_and_cover_the_same_cloth(tmp_path: Path) -> None:
    whole = load_garment("tank")
    write_garment(tmp_path / "g.npz", "tank", "components:10")
    torn = load_garment(tmp_path / "g.npz")
    assert area(torn.rest_pos, torn.faces) == pytest.approx(area(whole.rest_pos, whole.faces))
    assert len(np.unique(connected_components(len(torn.rest_pos), unique_edges(torn.faces)))) >= 10
    write_garment(tmp_path / "g.npz", "dress", "components:1")
    assert len(load_garment(tmp_path / "g.npz").rest_pos) == len(load_garment("dress").rest_pos)


def test_a_coarser_garment_covers_the_same_cloth_and_is_worn_alike(tmp_path: Path) -> None:
    whole = load_garment("dress")
    write_garment(tmp_path / "coarse.npz", "dress", "remesh:300")
    coarse = load_garment(tmp_path / "coarse.npz")
    assert len(coarse.rest_pos) == pytest.approx(300, rel=0.05)
    assert area(coarse.rest_pos, coarse.faces) == pytest.approx(area(whole.rest_pos, whole.faces), rel=0.03)
    assert whole.skin_pos is not None
    assert coarse.skin_pos is not None
    near = np.linalg.norm(coarse.skin_pos[:, None] - whole.skin_pos[None], axis=2).min(axis=1)
    assert near.max() < 0.6 * longest(whole.rest_pos, whole.faces).max()
    assert all(getattr(coarse, key) is not None for key in ("lbs_weights", "shapedirs", "rest_turn", "stiffness"))


def test_a_finer_garment_has_four_faces_for_one(tmp_path: Path) -> None:
    whole = load_garment("dress")
    write_garment(tmp_path / "fine.npz", "dress", "subdivide:1")
    fine = load_garment(tmp_path / "fine.npz")
    assert len(fine.faces) == 4 * len(whole.faces)
    assert area(fine.rest_pos, fine.faces) == pytest.approx(area(whole.rest_pos, whole.faces))
    assert longest(fine.rest_pos, fine.faces).max() == pytest.approx(longest(whole.rest_pos, whole.faces).max() / 2)


def test_a_sheet_hangs_over_the_body_that_stands_still(tmp_path: Path) -> None:
    write_garment(tmp_path / "sheet.npz", "tank", "sheet:2")
    sheet = load_garment(tmp_path / "sheet.npz")
    write_still_body(tmp_path / "body.obj")
    body = read_mesh_file(tmp_path / "body.obj")
    assert np.ptp(sheet.rest_pos[:, 1]) == 0.0
    assert sheet.rest_pos[0, 1] - body.pos[:, 1].max() == pytest.approx(2.0, abs=1e-5)
    assert area(sheet.rest_pos, sheet.faces) == pytest.approx(1.0)
    corners = sheet.rest_pos[sheet.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 1] > 0).all()


def areas(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (pos[faces[:, corner]] for corner in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def area(pos: np.ndarray, faces: np.ndarray) -> float:
    return float(areas(pos, faces).sum())


def longest(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = pos[faces]
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1))

"""Motions and garments beyond the ordinary are what they say, and files like any other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.assets.extremes import CALM, write_garment, write_motion
from hood.assets.garment import load_garment
from hood.assets.sequence import PoseSequence, load_sequence


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


def test_a_recording_that_is_not_finite_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"m\.npz: poses is not finite in frame"):
        motion(tmp_path, "nan")
    with pytest.raises(ValueError, match="motion 'jump': give one of teleport"):
        write_motion(tmp_path / "x.npz", "jump", 1.0)


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
    np.testing.assert_allclose(small.skin_pos, whole.rest_pos if whole.skin_pos is None else whole.skin_pos)
    write_garment(tmp_path / "flipped.npz", "tank", "flipped:30")
    assert int((load_garment(tmp_path / "flipped.npz").faces != whole.faces).any(axis=1).sum()) == 30
    write_garment(tmp_path / "nan.npz", "tank", "nan")
    with pytest.raises(ValueError, match=r"nan\.npz: vertex .* positions must be finite"):
        load_garment(tmp_path / "nan.npz")
    with pytest.raises(ValueError, match="garment 'hole': give one of size"):
        write_garment(tmp_path / "x.npz", "tank", "hole")


def areas(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (pos[faces[:, corner]] for corner in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def area(pos: np.ndarray, faces: np.ndarray) -> float:
    return float(areas(pos, faces).sum())


def longest(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = pos[faces]
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1))

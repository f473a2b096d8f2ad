"""Collections of motions: names, files, folders, globs, lists and tables."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hood.assets.motion.motion_files import find_motions


@pytest.fixture
def amass(tmp_path: Path) -> Path:
    for name in ("S2/b_poses.npz", "S1/a_poses.npz", "S1/shape.npz", "S1/neutral_stagei.npz", "S1/notes.txt", "S2/c.pkl"):
        (tmp_path / "amass" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "amass" / name).write_bytes(b"x")
    return tmp_path / "amass"


def names(files: list[str]) -> list[str]:
    return [Path(file).name for file in files]


def test_folders_hold_motions_and_other_things(amass: Path) -> None:
    assert names(find_motions([str(amass)])) == ["a_poses.npz", "b_poses.npz", "c.pkl"]


def test_names_files_and_globs_in_their_order_without_repetition(amass: Path) -> None:
    found = find_motions([f"{amass}/S2/c.pkl", "walk_proud", f"{amass}/**/*_poses.npz", str(amass)])
    assert names(found) == ["c.pkl", "walk_proud", "a_poses.npz", "b_poses.npz"]


def test_lists_start_from_their_own_folder(amass: Path) -> None:
    (amass / "split.txt").write_text("# comment\nS1/a_poses.npz\nwalk_proud\n")
    (amass / "split.json").write_text(json.dumps({"train": ["S1/*_poses.npz"], "validation": ["S2/c.pkl"]}))
    (amass / "split.csv").write_text("id,length,garment\nS2/b_poses,120,dress\nS2/c,90,dress\nS2/b_poses,10,shirt\n")
    assert names(find_motions([str(amass / "split.txt")])) == ["a_poses.npz", "walk_proud"]
    assert names(find_motions([str(amass / "split.json")])) == ["a_poses.npz"]
    assert names(find_motions([str(amass / "split.json")], "validation")) == ["c.pkl"]
    assert names(find_motions([str(amass / "split.csv")])) == ["b_poses.npz", "c.pkl"]


def test_what_is_not_found_is_named(amass: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="empty: no motions"):
        find_motions([str(tmp_path / "empty")])
    with pytest.raises(ValueError, match="no file matches"):
        find_motions([f"{amass}/*.bvh*"])
    (amass / "prod.txt").write_text("walk_prod")
    with pytest.raises(FileNotFoundError, match="did you mean 'walk_proud'"):
        find_motions([str(amass / "prod.txt")])
    with pytest.raises(FileNotFoundError, match="nothing"):
        find_motions([str(amass / "nothing.csv")])
    (amass / "bad.csv").write_text("id\nS1/a_poses\nS9/z\n")
    with pytest.raises(FileNotFoundError, match=r"bad\.csv, row 3: .*S9/z"):
        find_motions([str(amass / "bad.csv")])
    assert names(find_motions([str(amass / "bad.csv")], check=False)) == ["a_poses.npz", "z"]
    (amass / "bad.csv").write_text("id,length\n,3\n")
    with pytest.raises(ValueError, match=r"bad\.csv: row 2 names no motion in 'id'"):
        find_motions([str(amass / "bad.csv")])
    (amass / "bad.csv").write_text("id,length\n")
    with pytest.raises(ValueError, match=r"bad\.csv: an empty table"):
        find_motions([str(amass / "bad.csv")])

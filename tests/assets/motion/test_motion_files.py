"""Many motions: what names, globs and lists stand for; files read late, kept within a bound, refused by name."""

from __future__ import annotations

import json
import os
import pickle
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hood.assets.motion.load import load_sequence
from hood.assets.motion.motion_files import MotionFiles, find_motions, motion_lengths
from hood.assets.motion.sequence import PoseSequence

LOAD = partial(load_sequence, fps=30.0)


def write(path: Path, num_frames: int = 40, rate: float = 120.0, key: str = "mocap_framerate", **changes: object) -> Path:
    """An AMASS file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {"poses": np.zeros((num_frames, 156)), "trans": np.zeros((num_frames, 3)), key: rate, "betas": np.zeros(16)}
    np.savez(path, **(arrays | changes))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, frames in (("CMU/01/01_01_poses", 400), ("CMU/02/02_01_poses", 200), ("BML/a_poses", 100)):
        write(tmp_path / f"{name}.npz", frames)
    np.savez(tmp_path / "CMU" / "shape.npz", gender="female")
    return tmp_path


def test_globs_reach_into_folders_in_a_fixed_order(folder: Path) -> None:
    found = find_motions(["plie", f"{folder}/**/*_poses.npz", f"{folder}/BML/a_poses.npz"])
    names = ("BML/a_poses", "CMU/01/01_01_poses", "CMU/02/02_01_poses")
    assert found == ["plie", *(f"{folder}/{name}.npz" for name in names)]


def test_split_files(folder: Path) -> None:
    split = {"train": ["CMU/**/*_poses.npz", "walk_proud"], "validation": ["BML/a_poses.npz"]}
    (folder / "split.json").write_text(json.dumps(split))
    entry = [str(folder / "split.json")]
    assert find_motions(entry) == [*(f"{folder}/CMU/{n}_poses.npz" for n in ("01/01_01", "02/02_01")), "walk_proud"]
    assert find_motions(entry, "validation") == [f"{folder}/BML/a_poses.npz"]
    (folder / "list.txt").write_text("# ours\nBML/a_poses.npz  # short\n\nplie\n")
    assert find_motions([str(folder / "list.txt")]) == [f"{folder}/BML/a_poses.npz", "plie"]


@pytest.mark.parametrize(
    "name, text, words",
    [
        ("a.json", "{", "a.json: not readable as JSON"),
        ("a.json", '{"train": []}', "a.json: has no 'validation' \\(found \\['train'\\]\\)"),
        ("a.json", "[3]", "a.json: must hold a list"),
        ("a.txt", "none/*.npz", "no file matches .*none"),
    ],
)
def test_lists_that_say_nothing_are_named(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=words):
        find_motions([str(tmp_path / name)], "validation")


@pytest.mark.parametrize(
    "name, text, words",
    [
        ("a.txt", "plie\n\nwalk_prud  # fast\n", r"a\.txt, line 3: unknown sequence 'walk_prud': did you mean 'walk_proud'\?"),
        ("a.txt", "BML/a_pose.npz", r"a\.txt, line 1: .*BML/a_pose\.npz: no such file; did you mean 'a_poses\.npz'\?"),
        ("a.txt", "GONE/zzz.npz", r"a\.txt, line 1: .*GONE/zzz\.npz: no such file; check the path"),
        ("a.txt", "plie\nempty", r"a\.txt, line 2: .*empty: no motions"),
        ("a.json", '["plie", "pliee"]', r"a\.json, list\[1\]: unknown sequence 'pliee': did you mean 'plie'\?"),
        (
            "a.json",
            '{"train": ["walk_prud"]}',
            r"a\.json, train\[0\]: unknown sequence 'walk_prud': did you mean 'walk_proud'\?",
        ),
    ],
)
def test_a_list_with_a_misspelt_name_is_refused_with_its_place(folder: Path, name: str, text: str, words: str) -> None:
    (folder / name).write_text(text)
    (folder / "empty").mkdir(exist_ok=True)
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        find_motions([str(folder / name)])


def test_lists_are_not_checked_where_missing_motions_are_left_out(folder: Path) -> None:
    (folder / "a.txt").write_text("plie\nwalk_prud\nGONE/zzz.npz\n")
    found = find_motions([str(folder / "a.txt")], check=False)
    assert found == ["plie", "walk_prud", f"{folder}/GONE/zzz.npz"]
    files = MotionFiles(found, LOAD, 30.0, skip=True)
    assert files.names == ["plie"]
    assert ["walk_prud" in files.skipped[0], "zzz.npz" in files.skipped[1]] == [True, True]


def test_globs_without_a_match_folders_and_missing_files_are_named(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"no file matches .*\*\* stands for any folders"):
        find_motions([f"{folder}/**/*_stagei.npz"])
    assert find_motions([f"{folder}/BML"]) == [f"{folder}/BML/a_poses.npz"]
    with pytest.raises(FileNotFoundError, match=r"gone\.json"):
        find_motions([f"{folder}/gone.json"])
    with pytest.raises(FileNotFoundError, match=r"gone\.npz: no such file"):
        MotionFiles([f"{folder}/gone.npz"], LOAD, 30.0)


@pytest.mark.parametrize(
    "frames, rate, key", [(400, 120.0, "mocap_framerate"), (101, 59.94, "mocap_frame_rate"), (77, 30.0, "fps")]
)
def test_lengths_by_header_are_those_of_the_motion(tmp_path: Path, frames: int, rate: float, key: str) -> None:
    path = str(write(tmp_path / "a.npz", frames, rate, key))
    assert list(MotionFiles([path], LOAD, 30.0).lengths) == [load_sequence(path, 30.0).num_frames]


@pytest.mark.parametrize("key", ["mocap_framerate", "nothing"])
def test_a_given_frame_rate_holds_for_lengths_as_well(tmp_path: Path, key: str) -> None:
    path = str(write(tmp_path / "a.npz", 200, 120.0, key))
    motions = MotionFiles([path], partial(LOAD, file_fps=60.0), 30.0, file_fps=60.0)
    assert motions.lengths[0] == motions[0].num_frames == 100


def test_files_are_read_when_they_are_used_and_kept_within_a_bound(folder: Path) -> None:
    reads: list[str] = []

    def load(name: str) -> PoseSequence:
        reads.append(Path(name).stem)
        return LOAD(name)

    files = MotionFiles(find_motions([f"{folder}/**/*_poses.npz"]), load, 30.0, kept_frames=130)
    assert list(files.lengths) == [25, 100, 50] == list(motion_lengths(files))
    assert reads == []
    assert [files[i].num_frames for i in (0, 1, 1, 0)] == [25, 100, 100, 25]
    assert reads == ["a_poses", "01_01_poses"]
    assert files[2].num_frames == 50  # 01_01 was used longest ago
    assert files[0].num_frames == 25
    assert files[1].num_frames == 100
    assert reads[2:] == ["02_01_poses", "01_01_poses"]


def test_another_process_gets_the_names_only(folder: Path) -> None:
    files = MotionFiles(find_motions([f"{folder}/**/*_poses.npz"]), LOAD, 30.0)
    empty = len(pickle.dumps(files))
    _ = files[1]
    assert len(pickle.dumps(files)) == empty < 2000
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(files))[1].poses, files[1].poses)


def test_short_and_unreadable_motions_are_refused_by_name_or_skipped_and_counted(folder: Path) -> None:
    short = str(write(folder / "short.npz", 20))
    broken = folder / "broken.npz"
    broken.write_bytes(b"PK\x03\x04 not an archive")
    names = [short, str(broken), str(folder / "CMU" / "shape.npz"), str(folder / "BML" / "a_poses.npz")]
    for name, words in zip(
        names, (r"short\.npz: 5 frames at 30 fps, at least 10", r"broken\.npz", r"shape\.npz"), strict=False
    ):
        with pytest.raises(ValueError, match=words + r".*data\.unusable=skip"):
            MotionFiles([names[3], name], LOAD, 30.0, min_frames=10)
    files = MotionFiles(names, LOAD, 30.0, min_frames=10, skip=True)
    assert files.names == names[3:]
    assert [Path(text.split(":")[0]).stem for text in files.skipped] == ["short", "broken", "shape"]
    with pytest.raises(ValueError, match=r"none of 2 motions can be used: .*short"):
        MotionFiles(names[:2], LOAD, 30.0, min_frames=10, skip=True)


def test_faults_behind_a_sound_header(folder: Path) -> None:
    poses = np.zeros((400, 156))
    poses[7, 3] = np.nan
    names = [str(write(folder / "nan.npz", 400, poses=poses)), str(folder / "BML" / "a_poses.npz")]
    with pytest.raises(ValueError, match=r"nan\.npz: poses is not finite in frame 7"):
        MotionFiles(names, LOAD, 30.0).usable(0)
    files = MotionFiles(names, LOAD, 30.0, skip=True)
    with pytest.warns(UserWarning, match=r"skipped motion .*nan\.npz"):
        assert files.usable(0) is None
    assert files.usable(0) is None
    assert files.usable(1) is not None


def test_a_file_that_changes_is_noticed(folder: Path) -> None:
    path = folder / "BML" / "a_poses.npz"
    files = MotionFiles([str(path)], LOAD, 30.0)
    write(path, 60)
    with pytest.raises(ValueError, match=r"a_poses\.npz: 15 frames, 25 by its header"):
        _ = files[0]


def test_thousands_of_files_are_listed_without_being_read(tmp_path: Path) -> None:
    source = write(tmp_path / "a.npz")
    for index in range(300):
        os.link(source, tmp_path / f"{index}_poses.npz")
    names = find_motions([f"{tmp_path}/*_poses.npz"])
    files = MotionFiles(names * 4, lambda name: pytest.fail(f"read {name}"), 30.0)
    assert len(files) == 1200
    assert set(files.lengths) == {10}

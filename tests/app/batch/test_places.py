"""Many motions in several calls with one output folder: nothing of one call is lost to another."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from hood.app.batch.batch import find_jobs
from hood.app.settings.compose import ConfigError
from hood.cli.main import main

QUICK = ["rollout", "stepper=guess", "garment=tank", "num_frames=2", "settle=paper", "metrics=none", "guard=off",
         "cloth_contact=off", "video=none", "sheet=false", "fail_on=nothing", "output=out"]  # fmt: skip


@pytest.fixture
def subjects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two subjects whose motions have the same names, as in AMASS, and a list of each."""
    monkeypatch.chdir(tmp_path)
    for index, subject in enumerate(("01", "02")):
        for name in ("walk", "run"):
            write(tmp_path / "amass" / subject / f"{name}.npz", index + 0.1 * len(name))
        (tmp_path / f"{subject}.txt").write_text(f"amass/{subject}/walk.npz\namass/{subject}/run.npz\n")
    return tmp_path


def write(path: Path, angle: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    poses = np.zeros((4, 156))
    poses[:, 0], poses[:, 50] = np.pi / 2, 0.1 * angle  # z is up
    np.savez(path, poses=poses, trans=np.zeros((4, 3)), mocap_framerate=30.0, betas=np.zeros(16), gender="neutral")


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def overview(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def test_two_lists_below_one_root_lose_no_file(subjects: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*QUICK, "sequence=01.txt", "root=amass"]) == 0
    assert f"2 motions, their folders in out are named from {subjects / 'amass'} (root)" in capsys.readouterr().out
    before = files(subjects / "out")
    assert {"01/walk/rollout.h5", "01/run/rollout.h5"} <= {*before}
    assert main([*QUICK, "sequence=02.txt", "root=amass"]) == 0
    after = files(subjects / "out")
    before.pop("summary.json")
    assert {name: after.get(name) for name in before} == before
    assert {"02/walk/rollout.h5", "02/run/rollout.h5"} <= {*after}
    both = overview(subjects / "out")
    assert both["num_motions"] == len(both["motions"]) == 4
    assert [*both["folders"].values()] == ["01/walk", "01/run", "02/walk", "02/run"]


def test_a_list_whose_folders_are_those_of_another_is_refused_before_any_work(
    subjects: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*QUICK, "sequence=01.txt"]) == 0
    before = files(subjects / "out")
    capsys.readouterr()
    assert main([*QUICK, "sequence=02.txt"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    theirs, ours = (subjects / "amass" / subject / "walk.npz" for subject in ("01", "02"))
    assert f"out/walk: holds the rollout of {theirs}, which that of {ours} would replace; " in told
    assert f"name the folders from one that holds both, root={subjects / 'amass'}, or choose another output" in told
    assert main([*QUICK, "sequence=02.txt", "resume=true"]) == 2
    assert files(subjects / "out") == before
    assert main([*QUICK, "sequence=02.txt", f"root={subjects / 'amass'}"]) == 0
    after = files(subjects / "out")
    before.pop("summary.json")
    assert {name: after.get(name) for name in before} == before
    assert len(overview(subjects / "out")["motions"]) == 4


def test_the_same_motions_again_replace_their_own(subjects: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By other words, from another folder and after they have been moved."""
    assert main([*QUICK, "sequence=01.txt"]) == 0
    for entry in ("amass/01", str(subjects / "amass" / "01"), "amass/01/*.npz"):
        assert find_jobs(entry, Path("out"))
    (subjects / "elsewhere").mkdir()
    (subjects / "amass" / "01").rename(subjects / "elsewhere" / "01")
    monkeypatch.chdir(subjects / "elsewhere")
    assert find_jobs("01", Path("../out"))
    write(subjects / "elsewhere" / "01" / "walk.npz", 7.0)
    with pytest.raises(ConfigError, match="holds the rollout of"):
        find_jobs("01", Path("../out"))


def test_a_file_with_the_name_of_an_embedded_motion_is_another_one(subjects: Path) -> None:
    (subjects / "one.txt").write_text("walk_proud\n")
    assert main([*QUICK, "sequence=one.txt"]) == 0
    write(subjects / "own" / "walk_proud.npz", 1.0)
    with pytest.raises(ConfigError, match=r"out/walk_proud: holds the rollout of walk_proud, .*; choose another output$"):
        find_jobs("own", Path("out"))


@pytest.mark.parametrize(
    ("sequence", "root", "told"),
    [
        ("01.txt", "gone", "root=gone: no such folder"),
        ("01.txt", "amass/02", "root=amass/02: amass/01/walk.npz is not below it; give a folder that holds all the motions"),
        ("walk_proud", "amass", "root=amass: names the folders of many motions, and sequence=walk_proud is one; drop root"),
    ],
)
def test_roots_that_name_nothing_are_refused(
    sequence: str, root: str, told: str, subjects: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*QUICK, f"sequence={sequence}", f"root={root}"]) == 2
    said = capsys.readouterr().err
    assert told in said
    assert said.count("\n") == 1


def test_a_root_behind_a_link_is_one(subjects: Path) -> None:
    (subjects / "link").symlink_to(subjects / "amass")
    for entry, root in (("01.txt", "link"), ("link/01", "amass"), ("link/01", "link")):
        jobs = find_jobs(entry, Path("out"), root)
        assert jobs is not None
        assert {str(job.folder) for job in jobs} == {"out/01/walk", "out/01/run"}


def forget_the_motion(path: Path, **asked: object) -> None:
    """The rollout file as earlier versions wrote it: of its motion it knows what the command said."""
    with h5py.File(path, "r+") as file:
        del file.attrs["motion_file"], file.attrs["motion_sha256"]
        before = json.loads(file.attrs["asked"])
        del before["root"]
        file.attrs["asked"] = json.dumps(before | asked)


def test_finished_folders_of_earlier_versions_are_known(subjects: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*QUICK, "sequence=01.txt"]) == 0
    for name in ("walk", "run"):
        forget_the_motion(subjects / "out" / name / "rollout.h5")
    content = overview(subjects / "out")
    del content["folders"]
    (subjects / "out" / "summary.json").write_text(json.dumps(content))
    before = files(subjects / "out")
    capsys.readouterr()
    assert main([*QUICK, "sequence=01.txt", "resume=true"]) == 0
    assert "2 of them finished before and skipped now" in capsys.readouterr().out
    before.pop("summary.json")
    assert {name: files(subjects / "out")[name] for name in before} == before
    assert len(overview(subjects / "out")["motions"]) == 2
    assert main([*QUICK, "sequence=02.txt"]) == 2
    assert "out/walk: holds the rollout of amass/01/walk.npz, which that of" in capsys.readouterr().err


def test_one_motion_that_is_finished_stays(subjects: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [*QUICK, "sequence=amass/01/walk.npz", "resume=true"]
    assert main(command) == 0
    before = files(subjects / "out")
    capsys.readouterr()
    assert main(command) == 0
    assert "resume=true: out holds this rollout, finished with the same settings; it stays" in capsys.readouterr().out
    assert files(subjects / "out") == before
    assert main([*command, "gravity=5.0"]) == 0
    told = capsys.readouterr().out
    assert "resume=true: out was made with other settings and is made again (gravity is 9.81 there, 5 in this command)" in told
    assert files(subjects / "out") != before


def test_one_rollout_and_those_of_many_do_not_share_a_folder(subjects: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*QUICK, "sequence=01.txt"]) == 0
    assert main([*QUICK, "sequence=amass/02/walk.npz", "output=one"]) == 0
    before = {name: files(subjects / name) for name in ("out", "one")}
    capsys.readouterr()
    assert main([*QUICK, "sequence=amass/02/walk.npz"]) == 2
    assert "output=out: holds the rollouts of 2 motions and their summary; give a folder of its own" in capsys.readouterr().err
    assert main([*QUICK, "sequence=01.txt", "output=one"]) == 2
    assert "output=one: holds one rollout, whose summary that of many would replace" in capsys.readouterr().err
    assert {name: files(subjects / name) for name in ("out", "one")} == before

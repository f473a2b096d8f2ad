"""Many motions in one command: files, folders, what an interruption leaves, what is not done twice."""

from __future__ import annotations

import errno
import importlib.util
import json
import re
from pathlib import Path

import numpy as np
import pytest

from hood.app import rollout
from hood.app.batch.batch import Job, find_jobs, share
from hood.app.settings.compose import ConfigError
from hood.cli.main import main
from hood.rollouts.file.reader import read_rollout

UNTRAINED = ["checkpoint=untrained", "model=small", "model.latent_dim=4", "model.schedule='1x(mesh)'"]
ROLLOUT = ["rollout", *UNTRAINED, "garment=tank", "num_frames=2", "video=none", "sheet=false", "sequence=motions", "output=out"]
NAMES = ["a", "b", "deep/c"]


@pytest.fixture
def motions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in NAMES:
        write(tmp_path / "motions" / f"{name}.npz")
    return tmp_path / "motions"


def write(path: Path, broken: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    poses = np.full((4, 156), np.nan) if broken else np.zeros((4, 156))
    np.savez(path, poses=poses, trans=np.zeros((4, 3)), mocap_framerate=30.0, betas=np.zeros(16), gender="neutral")


def times(folder: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in folder.rglob("rollout.h5")}


def test_names_of_folders(motions: Path) -> None:
    for entry in ("motions", "motions/**/*.npz"):
        jobs = find_jobs(entry, Path("out"))
        assert jobs is not None
        assert [str(job.folder) for job in jobs] == [f"out/{name}" for name in NAMES]
        assert [Path(job.sequence).resolve() for job in jobs] == [motions / f"{name}.npz" for name in NAMES]
    (motions / "list.txt").write_text("a.npz\nwalk_proud\ndeep/c.npz\n")
    jobs = find_jobs("motions/list.txt", Path("out"))
    assert jobs is not None
    assert [str(job.folder) for job in jobs] == ["out/a", "out/walk_proud", "out/deep/c"]
    assert find_jobs("walk_proud", Path("out")) is None
    assert find_jobs("motions/a.npz", Path("out")) is None
    with pytest.raises(ValueError, match="no file matches"):
        find_jobs("motions/*.pkl", Path("out"))


def test_two_motions_do_not_share_a_folder(motions: Path) -> None:
    (motions / "a.pkl").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"a\.npz and .*a\.pkl would both go to out/a"):
        find_jobs("motions/a.*", Path("out"))


def test_one_folder_each_and_one_summary(motions: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(ROLLOUT) == 0
    out = motions.parent / "out"
    for name in NAMES:
        assert len(read_rollout(out / name / "rollout.h5").cloth_pos) == 2
        assert {path.name for path in (out / name).iterdir() if path.is_file()} == {
            "config.yaml", "rollout.h5", "summary.json", "versions.json",
        }  # fmt: skip
    summary = json.loads((out / "summary.json").read_text())
    assert summary["num_motions"] == 3
    assert [Path(name).stem for name in summary["motions"]] == ["a", "b", "c"]
    for name, row in zip(NAMES, summary["motions"].values(), strict=True):
        assert row == json.loads((out / name / "summary.json").read_text())
    assert "3 of 3 motions simulated" in capsys.readouterr().out


def test_a_motion_that_cannot_be_used_stops_no_other(motions: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(motions / "b.npz", broken=True)
    assert main(ROLLOUT) == 2
    printed = capsys.readouterr().out
    assert "2 of 3 motions simulated, 1 failed" in printed
    rows = json.loads((motions.parent / "out" / "summary.json").read_text())["motions"]
    errors = [row["error"] for row in rows.values() if "error" in row]
    assert len(errors) == 1
    assert "b.npz" in errors[0]
    (line,) = [line for line in printed.splitlines() if "b.npz" in line]
    assert line.count("b.npz") == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (ROLLOUT, "motions/list.txt, line 2: unknown sequence 'walk_prud': did you mean 'walk_proud'?"),
        (["evaluate", "models=[guess]", "garments=[tank]"], "line 2: unknown sequence 'walk_prud': did you mean 'walk_proud'?"),
        (
            ["evaluate", "models=[guess]", "sequences=[plie,walk_prud]"],
            "sequences[1]: unknown sequence 'walk_prud': did you mean",
        ),
        (["tradeoff", "sequences=[plie,walk_prud]"], "sequences[1]: unknown sequence 'walk_prud': did you mean 'walk_proud'?"),
        (["tradeoff"], "motions/list.txt, line 2: unknown sequence 'walk_prud': did you mean 'walk_proud'?"),
        (["train", "model=small"], "motions/list.txt, line 2: unknown sequence 'walk_prud': did you mean 'walk_proud'?"),
    ],
)
def test_a_misspelt_motion_is_refused_before_any_work(
    words: list[str], told: str, motions: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (motions / "list.txt").write_text("a.npz\nwalk_prud\ndeep/c.npz\n")
    key = {"rollout": "sequence=", "train": "data.sequences="}.get(words[0], "sequences=")
    value = "motions/list.txt" if words[0] == "rollout" else "[motions/list.txt]"
    given = [] if "sequences[1]" in told else [f"{key}{value}"]
    assert main([*words, *given, "output=out"]) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert told in said.err
    assert not list((motions.parent / "out").rglob("*.h5"))
    assert not list((motions.parent / "out").rglob("*.jsonl"))


def test_an_interrupted_batch_goes_on_where_it_stopped(
    motions: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real, calls = rollout._simulate_to_disk, []

    def interrupted(*arguments: object) -> bool:
        calls.append(arguments)
        return real(*arguments) or len(calls) == 2  # type: ignore[arg-type]

    monkeypatch.setattr(rollout, "_simulate_to_disk", interrupted)
    assert main(ROLLOUT) == 130
    assert len(calls) == 2
    assert "resume=true goes on" in capsys.readouterr().err
    out = motions.parent / "out"
    (out / "b" / "summary.json").unlink()  # as after a kill while the pictures were drawn
    before = times(out)
    assert set(before) == {"a", "b"}
    monkeypatch.undo()
    monkeypatch.chdir(motions.parent)
    capsys.readouterr()
    assert main([*ROLLOUT, "resume=true"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"3 of 3 motions simulated(, \d doubtful)?; 1 of them finished before and skipped now\n", printed)
    assert printed.count("; finished before, skipped") == 1
    after = times(out)
    assert after["a"] == before["a"]
    assert after["b"] > before["b"]
    assert "c" in after
    assert len(json.loads((out / "summary.json").read_text())["motions"]) == 3
    # Other settings, and another command without resume=true, begin again.
    assert main([*ROLLOUT, "resume=true", "material.density=0.3"]) == 0
    assert all(times(out)[name] > after[name] for name in after)


def test_a_full_disk_ends_the_share_and_keeps_what_is_done() -> None:
    jobs = [Job(name, Path(name)) for name in "abc"]

    def work(job: Job) -> tuple[dict, bool]:
        if job.sequence == "b":
            raise OSError(errno.ENOSPC, "No space left on device", "b/rollout.h5")
        return {"num_frames": 1}, False

    outcome = share(jobs, work)
    assert outcome.rows == {"a": {"num_frames": 1}}
    assert outcome.hopeless is not None
    assert not outcome.interrupted


EVALUATE = ["evaluate", "models=[newton]", "garments=[tank]", "sequences=[motions]", "num_frames=4", "gap_states=0",
            "solver.max_iterations=1", "output=table"]  # fmt: skip


def test_an_evaluation_in_several_calls_ends_with_the_tables_of_one(motions: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*EVALUATE, "max_rollouts=2"]) == 0
    assert "2 of 3 rollouts are done" in capsys.readouterr().out
    assert not (motions.parent / "table" / "table.json").exists()
    assert main([*EVALUATE, "max_rollouts=2", "resume=true"]) == 0
    parts = json.loads((motions.parent / "table" / "table.json").read_text())
    assert main(EVALUATE) == 0
    whole = json.loads((motions.parent / "table" / "table.json").read_text())
    times = {"ms", "ms_p99", "fps"}
    for one, other in zip(parts, whole, strict=True):
        assert {k: v for k, v in one.items() if k.removesuffix("_low").removesuffix("_high") not in times} == {
            k: v for k, v in other.items() if k.removesuffix("_low").removesuffix("_high") not in times
        }


def test_finished_rollouts_of_an_evaluation_survive(
    motions: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from hood.cli import evaluate

    real, done = evaluate.measure, []

    def counted(candidate: object, scene: object, *rest: object) -> object:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(scene)
        return real(candidate, scene, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(evaluate, "measure", counted)
    assert main(EVALUATE) == 130
    assert not (motions.parent / "table" / "table.json").exists()
    monkeypatch.setattr(evaluate, "measure", lambda *a: done.append(a) or real(*a))
    assert main([*EVALUATE, "resume=true"]) == 0
    assert len(done) == 3
    printed = capsys.readouterr().out
    assert "2 of 3 rollouts were done before" in printed
    rows = json.loads((motions.parent / "table" / "table.json").read_text())
    assert [row["garment"] for row in rows] == ["tank", "all"]
    assert rows[0]["frames"] == rows[1]["frames"] == 3
    assert main([*EVALUATE, "resume=true", "num_frames=5"]) == 2
    assert "num_frames is 4 there, 5 in this command" in capsys.readouterr().err
    assert main(EVALUATE) == 0  # without resume=true: all over again
    assert len(done) == 6


def test_every_shape_performs_every_motion_and_is_drawn(motions: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = ["shapes=[[],[2]]", "drift_frames=3", "contact_sheets=true", "output=shapes"]
    assert main([*EVALUATE[:-1], *more]) == 0
    folder = motions.parent / "shapes"
    rows = json.loads((folder / "table.json").read_text())
    assert rows[0]["frames"] == 2 * 3
    assert 0.0 <= rows[0]["drift"] < 0.01
    sheets = sorted(path.name for path in (folder / "sheets").iterdir())
    assert len(sheets) == 6
    assert sheets[0].startswith("0_newton_tank_")
    lines = [json.loads(line) for path in folder.glob("rollouts.*.jsonl") for line in path.read_text().split("\n") if line]
    depths = {line["unit"][3]: line["measured"]["frames"][0]["energy_gravity"] for line in lines if line["measured"]["frames"]}
    assert depths[0] != depths[1]  # another body
    assert main([*EVALUATE[:-1], "shapes=[[0,x]]", "output=shapes2"]) == 2
    assert "shapes=[0,x]: give at most 10 finite shape coefficients" in capsys.readouterr().err


def test_refined_candidates(motions: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Refining lowers rg, and keeps steps and radius of the network."""
    command = ["evaluate", "models=[quickstart,quickstart+2,guess,guess+2]", "garments=[tank]", "sequences=[walk_proud]",
               "num_frames=6", "gap_states=0", "output=refined"]  # fmt: skip
    assert main(command) == 0
    rows = [row for row in json.loads((motions.parent / "refined" / "table.json").read_text()) if row["garment"] == "all"]
    assert [row["model"] for row in rows] == ["quickstart", "quickstart+2", "guess", "guess+2"]
    assert rows[1]["rg"] < rows[0]["rg"]
    assert rows[3]["rg"] < rows[2]["rg"]
    assert (rows[1]["steps"], rows[1]["radius"]) == (rows[0]["steps"], rows[0]["radius"])
    assert rows[3]["steps"] is None
    capsys.readouterr()
    assert main(["evaluate", "models=[newton+2]"]) == 2
    assert "guess+2 is the solver stopped early" in capsys.readouterr().err


@pytest.mark.parametrize("setting, library", [("contact_sheets=true", "Pillow"), ("spectrum=picture", "matplotlib")])
def test_pictures_without_the_picture_library_are_refused_before_any_work(
    setting: str, library: str, motions: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    given = [text for text in EVALUATE if not text.startswith(("gap_states", "output"))]
    assert main([*given, "gap_states=1", setting, "output=none"]) == 2
    assert f"{setting}: drawing needs {library}" in capsys.readouterr().err
    assert not (motions.parent / "none").exists()

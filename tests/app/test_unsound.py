"""Rollouts that ran to their end and cannot be trusted: what the commands print, write and return."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from belt import write_belt, write_walk

from hood.cli.main import main

#: A step that costs little: one iteration, and no search for contact but its own.
CHEAP = ["rollout", "stepper=refine", "refine=1", "metrics=strain", "garment=belt.obj", "video=none", "sheet=false",
         "output=out"]  # fmt: skip


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_belt(Path("belt.obj"))


def summary(folder: str = "out") -> dict[str, Any]:
    return json.loads((Path(folder) / "summary.json").read_text())


def test_a_trunk_that_turns_at_once_ends_with_3(capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(Path("twist.npz"), 32, twist_at=24)
    command = [*CHEAP, "sequence=twist.npz", "num_frames=32"]
    assert main(command) == 3
    found, shown = summary(), capsys.readouterr()
    assert found["sound"] is False
    assert found["strain_p99"] < 0.3
    worst = found["worst_frames"]["strain_p99"]
    assert worst["frame"] >= 24
    assert worst["value"] > 1.0
    reasons = [reason for reason in found["unsound_reasons"] if reason.startswith("strain p99 is beyond 50%")]
    assert "frames 24" in reasons[0]
    assert f"worst {worst['value']:.0%} in frame {worst['frame']}" in reasons[0]
    assert f"UNSOUND: {reasons[0]}\n" in shown.out
    assert f"(worst {100 * worst['value']:.1f}% in frame {worst['frame']})" in shown.out
    assert "exit code 3 (0 with fail_on=nothing)" in shown.err
    assert main(["inspect", "out/rollout.h5"]) == 1
    shown = capsys.readouterr()
    assert "! unsound: " in shown.out
    assert reasons[0] in shown.out
    assert "nothing to repair" not in shown.out


def test_a_study_may_allow_it(capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(Path("twist.npz"), 9, twist_at=7)
    command = [*CHEAP, "sequence=twist.npz", "num_frames=9"]
    assert main(command) == 3
    assert main([*command, "fail_on=nothing"]) == 0
    assert summary()["sound"] is False
    assert "unsound, which fail_on=nothing allows" in capsys.readouterr().err


def test_a_quiet_walk_is_sound(capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(Path("walk.npz"), 7)
    assert main([*CHEAP, "sequence=walk.npz", "refine=20"]) == 0
    assert summary()["sound"] is True
    assert summary()["unsound_reasons"] == []
    assert "\nsound\n" in capsys.readouterr().out
    assert main(["inspect", "out/rollout.h5"]) == 0
    assert "sound: True" in capsys.readouterr().out


@pytest.mark.parametrize("metrics", ["strain", "none"])
def test_a_solver_that_misses_every_step(metrics: str, capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(Path("walk.npz"), 4)
    command = [*CHEAP, "sequence=walk.npz", "stepper=newton", "refine=0", "solver.max_iterations=0", f"metrics={metrics}"]
    assert main(command) == 3
    # Where it is measured how far it was from its minimum, that decides: a step of a walk is a few millimetres.
    assert main([*command, "metrics=all"]) == 0
    found = summary()
    assert found["solver_steps_not_converged"] == 3
    assert 1e-3 < found["worst_frames"]["distance_p99"]["value"] < 0.02
    assert "UNSOUND: the solver missed its target in 3 of 3 frames: frames 1–3\n" in capsys.readouterr().out


def test_what_nobody_measured_is_not_judged(capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(Path("walk.npz"), 7)
    command = [*CHEAP, "sequence=walk.npz", "refine=0.001ms"]  # nothing is refined, no gradient computed
    assert main(command) == 0
    assert summary()["sound"] is None
    assert "\nnot judged: how far the steps to frames 1–6 ended from their minimum was not measured" in capsys.readouterr().out


def test_batches_count_the_unsound(capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(Path("motions/calm.npz"), 8)
    write_walk(Path("motions/twist.npz"), 8, twist_at=6)
    command = [*CHEAP, "sequence=motions", "num_frames=8", "refine=5"]
    assert main(command) == 3
    shown = capsys.readouterr()
    assert "2 of 2 motions simulated, 1 unsound" in shown.out
    assert "; UNSOUND: 'belt' has come off: from frame " in shown.out
    # What is finished is not simulated again, and as unsound as before.
    before = Path("out/twist/rollout.h5").stat().st_mtime_ns
    assert main([*command, "resume=true"]) == 3
    assert main([*command, "resume=true", "fail_on=nothing"]) == 0
    forgetful = {key: value for key, value in summary("out/twist").items() if key not in ("sound", "unsound_reasons")}
    Path("out/twist/summary.json").write_text(json.dumps(forgetful))  # as earlier versions wrote it
    assert main([*command, "resume=true"]) == 3
    assert Path("out/twist/rollout.h5").stat().st_mtime_ns == before
    Path("motions/broken.npz").write_bytes(b"no motion")
    assert main([*command, "resume=true"]) == 2
    assert "2 of 3 motions simulated, 1 failed, 1 unsound" in capsys.readouterr().out


def test_doubts_are_told_kept_and_refused_where_that_is_asked(capsys: pytest.CaptureFixture[str]) -> None:
    """A fabric as stiff as a plate; the result is what it is."""
    write_walk(Path("walk.npz"), 7)
    command = [*CHEAP, "sequence=walk.npz", "refine=20", "material.bending_stiffness=0.2"]
    assert main(command) == 0
    found, shown = summary(), capsys.readouterr()
    assert found["sound"] is True
    (doubt,) = found["doubts"]
    assert (doubt["kind"], doubt["value"], doubt["unit"], doubt["frames"]) == ("fabric", pytest.approx(0.2), "N·m", [])
    assert found["warnings"].count(doubt["sentence"]) == 1
    assert f"doubt: {doubt['sentence']}\nsound, with 1 doubt\n" in shown.out
    assert main(["inspect", "out/rollout.h5"]) == 1
    assert "! doubt: garment 'belt': its bending stiffness is 0.2 N·m" in capsys.readouterr().out
    assert main([*command, "fail_on=doubts"]) == 3
    assert "the rollout is doubtful; exit code 3, as fail_on=doubts asks" in capsys.readouterr().err
    assert main([*command, "fail_on=never"]) == 2


def test_batches_count_and_refuse_the_doubtful(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        write_walk(Path("motions") / f"{name}.npz", 7)
    command = [*CHEAP, "sequence=motions", "num_frames=7", "refine=20", "material.bending_stiffness=0.2"]
    assert main(command) == 0
    shown = capsys.readouterr().out
    assert "2 of 2 motions simulated, 2 doubtful" in shown
    assert "; doubt: garment 'belt': its bending" in shown
    # What is finished is judged by the exit code that is asked for now.
    assert main([*command, "resume=true", "fail_on=doubts"]) == 3

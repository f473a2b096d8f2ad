"""``guard=…`` of ``hood rollout``: the file, the summary, the sentence and the exit code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from belt import write_belt, write_walk

from hood.app.stepping.guarding import guard_sentence
from hood.cli.main import main
from hood.rollouts.checks.guard import CUT, FORCE, INSIDE, STRAIN, TURN, Alarm
from hood.rollouts.checks.step_repair import LEFT, REFINED
from hood.rollouts.file.reader import read_rollout

CHEAP = ["rollout", "stepper=refine", "refine=20", "metrics=none", "garment=belt.obj", "sequence=walk.npz", "video=none",
         "sheet=false", "output=out"]  # fmt: skip
#: Few iterations: after the body has turned at once, forces are far out of balance.
HASTY = [*CHEAP, "refine=1"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_belt(Path("belt.obj"))


def summary() -> dict[str, Any]:
    return json.loads(Path("out/summary.json").read_text())


def positions() -> np.ndarray:
    return read_rollout(Path("out/rollout.h5")).cloth_pos


def test_a_quiet_rollout_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(Path("walk.npz"), 5)
    assert main([*CHEAP, "guard=off"]) == 0
    plain = positions()
    with h5py.File("out/rollout.h5") as file:
        assert "guard" not in file
    assert "guard" not in summary()
    for mode in ("report", "repair", "strict"):
        assert main([*CHEAP, f"guard={mode}"]) == 0
        assert np.array_equal(positions(), plain)
        assert summary()["guard"] == {
            "mode": mode, "frames": 0, "causes": {}, "repairs": {"refined": 0, "solved": 0, "left": 0}, "stopped": None,
            "sentence": "", "alarms": [],
        }  # fmt: skip
        assert "guard:" not in capsys.readouterr().err
    with h5py.File("out/rollout.h5") as file:
        assert int(file.attrs["num_alarms"]) == 0
        assert (file["guard/frame"][:] == -1).all()


def test_a_turn_is_told_and_mended(capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(Path("walk.npz"), 8, twist_at=4)
    main([*HASTY, "guard=off"])
    plain = positions()
    main(HASTY)
    assert np.array_equal(positions(), plain)
    told = summary()["guard"]
    assert told["alarms"][0]["frame"] == 4
    assert told["repairs"] == {"refined": 0, "solved": 0, "left": 0}
    assert told["sentence"] in summary()["warnings"]
    assert f"hood: warning: {told['sentence']}\n" in capsys.readouterr().err
    assert told["sentence"].endswith("guard=repair mends what it can")
    main([*HASTY, "guard=repair"])
    repaired = summary()["guard"]
    assert repaired["repairs"]["refined"] + repaired["repairs"]["solved"] > 0
    rows = read_rollout(Path("out/rollout.h5")).alarms
    assert [row["frame"] for row in rows] == [row["frame"] for row in repaired["alarms"]]
    for row in rows:
        assert not row["rg_after"] > row["rg_before"]
    assert main(["inspect", "out/rollout.h5"]) in (0, 1)
    assert repaired["sentence"].removeprefix("guard: ") in capsys.readouterr().out


def test_strict_ends_before_the_first_alarm(capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(Path("walk.npz"), 8, twist_at=4)
    main([*HASTY, "guard=off"])
    plain = positions()
    capsys.readouterr()
    assert main([*HASTY, "guard=strict"]) == 3
    assert main([*HASTY, "guard=strict", "fail_on=nothing"]) == 3
    data = read_rollout(Path("out/rollout.h5"))
    assert np.array_equal(data.cloth_pos, plain[:4])
    assert data.attributes["complete"] == np.False_
    assert summary()["guard"]["stopped"] == 4
    assert summary()["num_frames"] == 4
    assert [row["frame"] for row in data.alarms] == [4]
    assert "guard=strict: the rollout ends before frame 4: " in capsys.readouterr().err
    main(["inspect", "out/rollout.h5"])
    assert "not finished" not in capsys.readouterr().out


def test_what_a_guard_cannot_do_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(Path("walk.npz"), 3)
    solver = [*CHEAP, "stepper=newton", "refine=0", "step=fixed", "cloth_contact=off"]
    assert main([*CHEAP, "guard=always"]) == 2
    assert main([*solver, "guard=repair"]) == 2
    assert "guard=repair: step=fixed has fixed shapes" in capsys.readouterr().err
    assert main([*solver, "guard=strict"]) == 2
    assert "guard=strict: step=fixed with metrics=none measures nothing" in capsys.readouterr().err
    assert main([*solver, "guard=report"]) == 0
    assert "guard=off: step=fixed with metrics=none" in capsys.readouterr().out
    assert "guard" not in summary()
    assert main([*solver, "guard=strict", "metrics=all"]) == 0
    assert summary()["guard"]["alarms"] == []


def test_the_sentence_names_frames_values_and_limits() -> None:
    alarms = [
        Alarm(3, FORCE, 80.0, 50.0, REFINED, 9, 80.0, 0.01),
        Alarm(4, FORCE, 120.0, 50.0, LEFT, 9, 120.0, 120.0),
        Alarm(4, CUT, 0.031, 0.02),
        Alarm(6, TURN, 24.2, 15.0),
    ]
    assert guard_sentence("repair", alarms, 11) == (
        "guard: 3 of 10 steps: forces out of balance, 120 times the weight at worst, beyond 50, in frames 3–4; the skin cuts "
        "3.1% of the cloth's triangles at worst, beyond 2.0%, in frame 4; the body turns by 24 degrees in a step, beyond 15 "
        "(less with a higher fps=…), in frame 6; 1 of 2 steps repaired"
    )
    assert guard_sentence("report", [], 11) == ""


def test_the_worst_is_that_of_all_steps_whatever_else_is_told_of_them() -> None:
    alarms = [
        Alarm(3, FORCE, 75.1, 50.0, strain=0.1, force=75.1, depth=0.02),
        Alarm(4, STRAIN, 0.9, 0.25, strain=0.9, force=3.9e6, depth=0.001),
        Alarm(5, INSIDE, 0.012, 0.01, strain=0.1, force=1.0, depth=0.012),
    ]
    said = guard_sentence("report", alarms, 11)
    assert "forces out of balance, 3.9e+06 times the weight at worst, beyond 50, in frame 3" in said
    assert "strain p99 beyond 25%, 90% at worst, in frame 4" in said
    assert "a vertex 0.02 m inside the body at worst" in said
    assert "75.1 times" in guard_sentence("strict", alarms, 11)


def test_alarms_of_a_damaged_file_are_refused() -> None:
    write_walk(Path("walk.npz"), 6, twist_at=4)
    main(HASTY)
    with h5py.File("out/rollout.h5", "r+") as file:
        file["guard/frame"][0] = 10**9
    with pytest.raises(ValueError, match="not a rollout file .guard/frame holds 1000000000, there are 6 frames"):
        read_rollout(Path("out/rollout.h5"))
    with h5py.File("out/rollout.h5", "r+") as file:
        del file["guard/value"]
        file["guard/value"] = np.array([b"much"] * 12)
    with pytest.raises(
        ValueError, match="not a rollout file .guard/value is 1-dimensional, of type .S4; it has to be a column"
    ):
        read_rollout(Path("out/rollout.h5"))

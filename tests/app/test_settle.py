"""``settle``: what the command says of the start, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hood.cli.main import main
from hood.rollouts.file.reader import read_rollout

QUICK = ["rollout", "stepper=newton", "garment=tank", "num_frames=2", "metrics=none", "video=none", "sheet=false",
         "fail_on=nothing", "output=run"]  # fmt: skip
UNTRAINED = [*(key for key in QUICK if not key.startswith("stepper")), "checkpoint=untrained", "model=small"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_the_summary_says_how_the_start_was_settled(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(QUICK) == 0
    entry = json.loads(Path("run/summary.json").read_text())["settled"]
    assert entry["reached"]
    assert entry["speed_m_per_s"] <= 1e-3
    assert f"({entry['steps']} steps), at rest: the cloth still moves by 0." in capsys.readouterr().out
    data = read_rollout(Path("run/rollout.h5"))
    assert data.metrics["settle_seconds"][0] == pytest.approx(entry["seconds"])
    assert np.isnan(data.metrics["settle_seconds"][1])


def test_networks_and_the_solver_start_from_the_same_state() -> None:
    """But for the precision that the two keep their states in."""
    starts = []
    for arguments in (QUICK, UNTRAINED):
        assert main(arguments) == 0
        starts.append(read_rollout(Path("run/rollout.h5")).cloth_pos[0])
    assert np.abs(starts[0] - starts[1]).mean() < 1e-3


def test_paper_leaves_no_trace(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*QUICK, "settle=0"]) == 0
    assert json.loads(Path("run/summary.json").read_text())["settled"] is None
    assert not any("settle" in name for name in read_rollout(Path("run/rollout.h5")).metrics)
    assert "settled in" not in capsys.readouterr().out


@pytest.mark.parametrize(
    "overrides, words",
    [
        (["settle=soon"], "unknown value for settle 'soon': known are equilibrium, paper"),
        (["settle=-1"], "settle=-1: give a number of relaxing steps, at least 0, or one of equilibrium, paper"),
    ],
)
def test_what_does_not_fit_is_refused(
    overrides: list[str], words: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main([*QUICK, *overrides]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []

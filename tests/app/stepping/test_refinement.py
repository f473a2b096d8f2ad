"""Refinement on the command line: what is refused, what is written, what is reported."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hood.app.settings.rollout_settings import RolloutSettings, overrides
from hood.app.stepping.refinement import chosen, describe_refinement, summarise_refinement
from hood.cli.main import main
from hood.rollouts.file.reader import read_rollout

UNTRAINED = ["checkpoint=untrained", "model=small", "model.latent_dim=4", "model.schedule='1x(mesh)'"]
SHORT = ["rollout", *UNTRAINED, "garment=tank", "num_frames=4", "video=none", "sheet=false", "output=run"]
REFUSED = {
    "another unit": (["refine=5kg"], "refine=5kg: give a whole number of iterations, or auto, or a goal such as 0.1rg"),
    "a key on the solver": (["stepper=newton", "refine=3"], "stepper=newton goes as far as solver.* says"),
    "refinement of nothing by nothing": (["stepper=refine"], "stepper=refine takes its steps by refinement alone"),
    "details without a key": (["refine={method:sweeps}"], "nothing is refined"),
    "a table for another key": (
        ["refine={goal:2,table:t.json}"],
        "says where refine=20ms and refine=5% begin; refine=2 needs none",
    ),
    "no such table": (["refine={goal:10%,table:t.json}"], "t.json: no such file"),
    "no such table of times": (["refine={goal:50ms,table:t.json}"], "t.json: no such file"),
    "misspelt method": (["refine={goal:2,method:sweep}"], "'sweeps'"),
    "zero budget": (["refine=0ms"], "refine=0ms: give a goal above 0, such as 20ms"),
    "negative count": (["refine=-1"], "refine is -1; give 0 or more iterations"),
    "a word": (["refine=lowrg"], "refine=lowrg: give a whole number of iterations"),
    "no iterations": (["refine={goal:0.1rg,most:0}"], "most is 0; it must be at least 1"),
    "unknown export": (["metrics={fields:[gamma]}"], "unknown field 'gamma'; give some of"),
    "unknown colour": (["colour=heat"], "unknown value for colour 'heat'"),
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_together_is_refused(case: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    overrides, words = REFUSED[case]
    assert main([*SHORT, *overrides]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_target_is_reported_frame_by_frame(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SHORT, "refine={goal:0.5rg,most:4}", "colour=rg", "sheet=true", "num_frames=3"]) == 0
    assert Path("run/contact_sheet.png").stat().st_size > 0
    data = read_rollout(Path("run/rollout.h5"))
    met, reached = data.metrics["refine_met"], data.metrics["refine_rg"]
    assert np.isnan(met[0])
    np.testing.assert_array_equal(met[1:], (reached <= 0.5)[1:])
    assert (data.metrics["refine_phi_after"] < data.metrics["refine_phi_before"])[1:].all()
    assert (data.metrics["refine_iterations"] <= 4)[1:].all()
    assert (data.metrics["ms_refine"] > 0)[1:].all()
    entry = json.loads(Path("run/summary.json").read_text())["refinement"]
    assert entry["asked"] == "refine=0.5rg"
    assert (entry["frames_met"], entry["frames_missed"]) == ((met == 1).sum(), (met == 0).sum())
    assert f"{entry['frames_met']} frames met it, {entry['frames_missed']} missed it\n" in capsys.readouterr().out
    assert data.fields["rg"].shape == data.cloth_pos.shape[:2]
    assert np.isfinite(data.fields["rg"][1:]).all()


def test_without_a_network() -> None:
    assert main([*SHORT, "stepper=refine", "refine=5", "num_frames=3"]) == 0
    data = read_rollout(Path("run/rollout.h5"))
    assert data.attributes["checkpoint_sha256"] == "none"
    assert "ms_network" not in data.metrics
    assert np.isfinite(data.cloth_pos).all()
    assert (data.metrics["energy_total"] < data.metrics["energy_inertial_guess"])[1:].all()


def test_off_is_off() -> None:
    """No trace in the file: nothing of a refinement was computed."""
    assert main([*SHORT, "num_frames=2"]) == 0
    first = read_rollout(Path("run/rollout.h5"))
    assert not any("refine" in name for name in first.metrics)
    assert "refinement" not in json.loads(Path("run/summary.json").read_text())
    assert first.fields == {}


@pytest.mark.parametrize(
    ("value", "goal", "unit"),
    [
        ("0.1rg", 0.1, "rg"),
        ("1e-3rg", 1e-3, "rg"),
        ("20ms", 20.0, "ms"),
        ("5%", 0.05, "%"),
        ("12.3 %", 0.123, "%"),
        (5, 5.0, ""),
    ],
)
def test_a_goal_is_a_value_with_its_unit(value: object, goal: float, unit: str) -> None:
    found = chosen({"refine": value})
    assert found is not None
    assert (found.value, found.unit) == (goal, unit)
    assert chosen(RolloutSettings.from_words(overrides({"refine": value}))) == found
    assert chosen(RolloutSettings.from_words([f"refine={value}"])) == found


def test_a_budget_counts_whole_frames() -> None:
    """Frame 0 has no step; what is not finite is not counted."""
    config = {"refine": "100ms"}
    times = np.array([np.nan, 90.0, 100.0, 110.0, np.nan])
    metrics = {"ms_total": times, "refine_iterations": np.array([np.nan, 3, 2, 4, np.nan]), "refine_rg": times / 100}
    entry = summarise_refinement(config, metrics)["refinement"]
    assert (entry["frames_met"], entry["frames_missed"]) == (2, 1)
    assert entry["budget_used_median"] == pytest.approx(1.0)
    assert entry["ms_p95"] == pytest.approx(109.0)
    assert entry["iterations_max"] == 4
    assert summarise_refinement({"refine": 0}, metrics) == {}


@pytest.mark.parametrize(
    ("iterations", "refining", "told"),
    [
        ([0, 0, 0], [0.1, 0.1, 0.1], "in 3 of 3 frames, which are not refined at all and take 10.0 ms; about refine=16ms has"),
        ([0, 0, 2], [0.1, 0.1, 8.0], "in 2 of 3 frames, which are not refined at all and take 10.0 ms; about refine=16ms has"),
        ([0, 1, 2], [0.1, 3.0, 8.0], None),
    ],
)
def test_a_budget_that_is_used_up_before_an_iteration_is_told(iterations: list, refining: list, told: str | None) -> None:
    config = {"refine": "3ms"}
    metrics = {
        "refine_iterations": np.array([np.nan, *iterations]), "refine_rg": np.full(4, np.nan),
        "ms_total": np.array([np.nan, 10.0, 10.0, 10.0]), "ms_refine": np.array([np.nan, *refining]),
    }  # fmt: skip
    lines = describe_refinement(summarise_refinement(config, metrics))
    assert len(lines) == (1 if told is None else 2)
    assert told is None or f"refine=3ms is used up before the first iteration {told} room for one" in lines[1]

"""``plan=auto|full|ACCURACY``: the same frames without shortcuts, and a plan that is made once."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import hood
from hood.app.plan_file import rollout_config
from hood.cli.main import main
from hood.mesh.closest_point import tree
from hood.studies.plan import plan as plan_auto

WORDS = ["garment=tank", "sequence=plie", "stepper=newton", "num_frames=6"]
QUIET = ["video=none", "sheet=false", "metrics=none", "guard=off"]


def test_full_begins_every_search_afresh(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr("hood.rollouts.loop.forget_searches", lambda: calls.append(len(tree._TREES)))
    for plan, times in (("auto", 0), ("full", 3)):
        list(hood.simulate("tank", "plie", stepper="newton", num_frames=3, metrics="none", settle="paper", plan=plan))
        assert len(calls) == times


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Plans that are made without a look (what is measured is another test's matter); the cache folder."""

    def quick(words: list[str], own: object, evidence: bool) -> tuple[dict[str, object], list[object]]:
        full, limit = {"ms": 10.0}, {"value": 0.01, "unit": "gamma"}
        rows = [{"part": "later iterations", "decision": "left out", "reason": ""}]
        told = {"full": full, "accuracy": limit, "rows": rows, "together": {"error": 1e-4, "saved": 0.1}, "seconds": 1.0}
        return {"words": words, "chosen": ["solver.target_rg=0.1"], **told}, []

    monkeypatch.setattr(plan_auto, "make_plan", quick)
    monkeypatch.setattr("hood.studies.plan.plan.cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def test_with_an_accuracy_a_rollout_plans_once(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["rollout", *WORDS, *QUIET, "plan=0.01", f"output={tmp_path / 'out'}"]
    assert main(command) == 0
    assert "planned in" in capsys.readouterr().out
    (kept,) = (short / "plans").iterdir()
    beside = tmp_path / "out" / "plan.json"
    assert json.loads(beside.read_text()) == json.loads(kept.read_text())
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["plan"]["mode"] == "file"
    assert rollout_config([f"plan={beside}"]).garment == "tank"
    assert rollout_config([f"plan={beside}"]).solver.target_rg == 0.1

    monkeypatch.setattr(plan_auto, "make_plan", lambda words, own, evidence: pytest.fail("planned again"))
    assert main([*command, "metrics={surface_every:7}"]) == 0
    assert "made before" in capsys.readouterr().out
    monkeypatch.setattr(plan_auto, "make_plan", lambda words, own, evidence: (_ for _ in ()).throw(ValueError("plans again")))
    for other in ("plan=0.02", "material=denim", "num_frames=7"):
        assert main([*command, other]) == 2
        assert "plans again" in capsys.readouterr().err


def test_a_plan_is_of_the_files_it_was_made_for(tmp_path: Path) -> None:
    garment = tmp_path / "mine.obj"
    digests = []
    for text in ("v 0 0 0", "v 0 0 1"):
        garment.write_text(text)
        digests.append(plan_auto._digest([f"garment={garment}"], "0.01"))
    assert digests[0] != digests[1]
    assert plan_auto._digest([f"garment={garment}"], "5mm") not in digests


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["plan=full", "accuracy=0.01"], "plan=full and accuracy=0.01 contradict each other"),
        (["plan=5cm"], "plan=5cm"),
        (["plan=0.01", "garment=tnk"], "tank"),
        (["plan=ful"], "no such file"),
    ],
)
def test_what_does_not_fit_is_told_in_a_line(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rollout", f"output={tmp_path / 'out'}", *words]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1


def test_too_few_frames_to_plan_are_told_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rollout", *WORDS[:3], *QUIET, "num_frames=3", "plan=0.01", f"output={tmp_path / 'out'}"]) == 2
    said = capsys.readouterr().err
    assert "a plan: 3 frames are too few for a window of 7; give more frames (num_frames" in said
    assert "no accuracy=" in said
    assert not (tmp_path / "out").exists()


def test_python_plans_first_as_well(short: Path) -> None:
    simulation = hood.simulate("tank", "plie", num_frames=12, plan=0.01)
    assert "planned in" in simulation.notes[0]
    assert len(list(simulation)) == 12
    assert hood.simulate("tank", "plie", num_frames=12, accuracy=0.01).notes[1].endswith("made before")


def test_a_plan_is_not_of_objects() -> None:
    with pytest.raises(ValueError, match="plan=0.01: a plan names garment"):
        hood.simulate(hood.load_garment("tank"), plan=0.01)

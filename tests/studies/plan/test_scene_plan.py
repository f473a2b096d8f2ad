"""``hood plan``: what is measured is written down, and a rollout by the plan is the rollout by its words."""

from __future__ import annotations

import html
import json
import shlex
import shutil
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import hood
from hood.app.plan_file import read_watch, rollout_config
from hood.app.settings.compose import ConfigError
from hood.assets.files.library import locate
from hood.cli.main import main
from hood.studies.plan.ablation import Effect

WORDS = ["garment=tank", "sequence=plie", "stepper=newton", "num_frames=24"]
QUIET = ["video=none", "sheet=false", "metrics=none", "guard=off"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plan of three parts, one of which a body in motion cannot do without."""
    folder = tmp_path_factory.mktemp("plan")
    words = ["parts=[bending,body contact,cloth contact]", "windows=2", "frames=1", "accuracy=0.05", f"output={folder}"]
    assert main(["plan", *WORDS, *words]) == 0
    return folder / "plan.json"


def read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def test_every_part_is_measured_and_decided(made: Path) -> None:
    plan = read(made)
    rows = {row["part"]: row for row in plan["rows"]}
    assert set(rows) == {"bending", "body contact", "cloth contact"}
    assert rows["body contact"]["decision"] == "kept"
    assert rows["body contact"]["gamma_p95"] > 1.0
    assert plan["full"]["gamma_p95"] < 1e-3
    assert all(row["decision"] in ("kept", "left out", "absent") and row["reason"] for row in rows.values())
    assert plan["windows"][0]["first"] == 0
    assert plan["words"] == WORDS


def test_the_printed_table_names_parts_and_command(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from hood.studies.plan.page import describe_plan

    text = describe_plan(read(made))
    assert "bending" in text
    assert "Needed for this accuracy: " in text
    row = read(made)["rows"][0]
    assert row["command"].startswith("hood plan garment=tank")
    assert "parts=[bending]" in row["command"]


def test_a_line_is_made_again_by_the_command_beside_it(made: Path, tmp_path: Path) -> None:
    row = next(row for row in read(made)["rows"] if row["part"] == "bending")
    words = shlex.split(row["command"])
    assert words[:2] == ["hood", "plan"]
    assert main([*words[1:], f"output={tmp_path}"]) == 0
    (again,) = read(tmp_path / "plan.json")["rows"]
    assert {key: again[key] for key in ("force", "gamma_p50", "gamma_p95", "mm")} == {
        key: row[key] for key in ("force", "gamma_p50", "gamma_p95", "mm")
    }


def test_the_page_lies_beside_the_plan_and_answers(made: Path) -> None:
    page = (made.parent / "plan.html").read_text(encoding="utf-8")
    rows = {row["part"]: row for row in read(made)["rows"]}
    assert html.escape(rows["bending"]["command"]) in page
    assert "edges of" in page
    assert "dress_4k" not in page
    assert "parts=[mesh tank_4k]" in page
    assert "A frame of the full model is made of " in page
    assert html.escape(read(made)["command"]) in page


def test_what_is_hopeless_or_stays_is_looked_at_once(made: Path) -> None:
    rows = {row["part"]: row for row in read(made)["rows"]}
    assert (rows["body contact"]["windows"], rows["cloth contact"]["windows"]) == (1, 1)
    assert rows["bending"]["windows"] == 2


def test_forces_and_fabrics_of_a_scene_are_parts_of_it(tmp_path: Path) -> None:
    scene = ["garment=skirt", "sequence=twists", "stepper=newton", "num_frames=24", "wind=5", "damping=0.01", "material.warp=8"]
    wanted = "parts=[air,damping,fabrics of parts,warp and weft]"
    fabrics = "fabrics={below_waistband:denim}"
    assert main(["plan", *scene, fabrics, wanted, "windows=1", "frames=1", "accuracy=1e-6", f"output={tmp_path}"]) == 0
    rows = {row["part"]: row for row in read(tmp_path / "plan.json")["rows"]}
    assert set(rows) == {"air", "damping", "fabrics of parts", "warp and weft"}
    # What their settings say is what is missing: an omission that changes nothing would leave γ where it is.
    assert all(row["gamma_p95"] > 1e-5 and row["mm"] > 0.01 for row in rows.values()), rows
    assert all(row["decision"] == "kept" for row in rows.values())
    assert all(rows[name]["force"] > 0.0 for name in ("air", "damping"))


def test_rows_of_what_a_scene_lacks_do_not_exist(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", *WORDS, "parts=[damping]", f"output={tmp_path}"]) == 2
    assert "damping" in capsys.readouterr().err


def test_another_mesh_and_time_step_are_compared_in_mm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["parts=[mesh tank_4k,60 fps]", "windows=1", "frames=1", f"output={tmp_path}"]
    assert main(["plan", *WORDS, *words]) == 0
    rows = {row["part"]: row for row in read(tmp_path / "plan.json")["rows"]}
    assert set(rows) == {"mesh tank_4k", "60 fps"}
    for row in rows.values():
        assert row["decision"] == "compared"
        assert 0.0 < row["mm_p50"] < row["mm"] < 60.0
        assert "gamma_p95" not in row
        assert row["ms_per_second"] == pytest.approx(30.0 * row["ms"])
        assert row["saved"] < 0.0
    assert rows["60 fps"]["words"] == ["fps=60", "num_frames=47"]
    assert "mesh tank_4k" in capsys.readouterr().out


def test_the_full_model_is_chosen_where_it_is_fast_enough(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["parts=[2 iterations]", "windows=1", "frames=1", "budget_ms=100000", f"output={tmp_path}"]
    assert main(["plan", *WORDS, *words]) == 0
    assert "within 100000 ms a frame: the full model" in capsys.readouterr().out
    plan = read(tmp_path / "plan.json")
    assert (plan["chosen"], plan["combination"]["names"], plan["combination"]["mm"]) == ([], [], 0.0)


def test_where_nothing_is_fast_enough_the_nearest_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is named was run as a whole, its command can be pasted, and the plan rolls out as the command does."""
    monkeypatch.setattr(Effect, "saving", lambda effect, full: 0.5)  # whatever the clock says of three steps
    words = ["parts=[2 iterations]", "windows=1", "frames=2", "budget_ms=0.001", f"output={tmp_path / 'plan'}"]
    assert main(["plan", *WORDS, *words]) == 0
    told = capsys.readouterr().out
    assert "Nothing takes 0.001 ms a frame or less; the nearest is" in told
    plan = read(tmp_path / "plan" / "plan.json")
    assert plan["combination"]["fits"] is False
    (tried,) = plan["combination"]["tried"]
    assert tried["names"] == ["2 iterations"]
    assert 0.0 < tried["mm_p50"] < tried["mm"]
    assert plan["command"] in told
    command = shlex.split(plan["command"])
    assert command[:2] == ["hood", "rollout"]
    assert {"garment=tank", "sequence=plie"} <= set(command)
    if plan["combination"]["names"]:  # two iterations were faster here than the solver
        assert {"stepper=refine", "refine=2"} <= set(command)
    short = ["num_frames=4", *QUIET]
    assert main([*command[1:], *short, f"output={tmp_path / 'pasted'}"]) == 0
    assert main(["rollout", f"plan={tmp_path / 'plan' / 'plan.json'}", *short, f"output={tmp_path / 'by_plan'}"]) == 0
    assert np.array_equal(positions(tmp_path / "pasted"), positions(tmp_path / "by_plan"))
    assert "plan: it was asked for 0.001 ms a frame, and nothing that was measured" in capsys.readouterr().out
    assert read(tmp_path / "by_plan" / "summary.json")["plan"]["missed_budget_ms"] == 0.001


def test_a_length_is_met_by_what_was_run_as_a_whole(tmp_path: Path) -> None:
    words = ["parts=[2 iterations,4 iterations]", "windows=1", "frames=1", "accuracy=200mm", f"output={tmp_path}"]
    assert main(["plan", *WORDS, *words]) == 0
    plan = read(tmp_path / "plan.json")
    found, rows = plan["combination"], {row["part"]: row for row in plan["rows"]}
    assert found["fits"]
    assert found["mm"] <= 200.0
    assert len(found["names"]) <= 1  # one way to take the steps
    assert all(row["decision"] == ("taken" if name in found["names"] else "not taken") for name, row in rows.items())
    assert rows["4 iterations"]["mm"] < rows["2 iterations"]["mm"]


def test_a_length_is_of_a_second_unless_frames_are_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As far as the motion goes: 24 frames leave room for 20 steps behind the two that begin a window."""
    for accuracy, frames in (("1mm", 20), ("0.01", 3)):
        words = ["parts=[later iterations]", "windows=1", f"accuracy={accuracy}", f"output={tmp_path}"]
        assert main(["plan", *WORDS, *words]) == 0
        assert read(tmp_path / "plan.json")["frames"] == frames
        told = capsys.readouterr().out
        assert f"; {frames} steps each; the full model takes" in told
        assert ("after 20 frames" in told) == (accuracy == "1mm")


def test_times_of_the_page_are_those_of_the_table(made: Path) -> None:
    """Shares of a frame are measured by another clock."""
    plan = read(made)
    assert sum(plan["times"].values()) == pytest.approx(plan["full"]["ms"])
    assert "solver" in plan["times"]


def test_a_name_given_twice_is_one_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", *WORDS, "parts=[bending,bending]", "windows=1", "frames=1", f"output={tmp_path}"]) == 0
    assert [row["part"] for row in read(tmp_path / "plan.json")["rows"]] == ["bending"]
    assert "bending, bending" not in capsys.readouterr().out


def test_a_plan_knows_what_it_was_made_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The words and the content of files; a plan from before that was kept has nothing to compare."""
    monkeypatch.chdir(tmp_path)
    garment = Path("own.npz")
    shutil.copy(locate("garments", "tank"), garment)
    words = ["garment=own.npz", *WORDS[1:]]
    assert main(["plan", *words, "parts=[later iterations]", "windows=1", "frames=1", "output=plan"]) == 0
    path = Path("plan/plan.json")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rollout_config([f"plan={path}"])
    shutil.copy(locate("garments", "skirt"), garment)
    with pytest.warns(UserWarning, match=r"plan=plan/plan\.json: its words, or the files that they name, are not those"):
        rollout_config([f"plan={path}"])
    shutil.copy(locate("garments", "tank"), garment)
    plan = read(path)
    path.write_text(json.dumps(plan | {"words": [*plan["words"], "fps=40"]}))
    with pytest.warns(UserWarning, match="make it again: hood plan garment=own.npz"):
        rollout_config([f"plan={path}"])
    path.write_text(json.dumps(plan | {"words": [*plan["words"], "frobnicate=1"]}))
    with pytest.raises(ConfigError, match=r"plan=plan/plan\.json: unknown key 'frobnicate'.*; make the plan again"):
        rollout_config([f"plan={path}"])


def test_what_a_plan_chose_stands_for_what_was_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "plan.json"
    words = ["garment=tank_4k", "sequence=plie", "fps=60", "num_frames=61"]
    chosen = ["garment=tank", "fps=30", "num_frames=31"]
    path.write_text(json.dumps({"format": "hood-plan/1", "words": words, "chosen": chosen}))
    config = rollout_config([f"plan={path}"])
    assert (config.garment, config.fps, config.num_frames) == ("tank", 30, 31)
    assert rollout_config([f"plan={path}", "num_frames=5"]).num_frames == 5
    assert main(["rollout", f"plan={path}", "garment=tank_4k"]) == 2
    assert "was made for garment=tank;" in capsys.readouterr().err


def positions(path: Path) -> np.ndarray:
    with h5py.File(path / "rollout.h5", "r") as file:
        return np.asarray(file["cloth/pos"])


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """A plan whose choice does not hang on what is faster today."""
    path = tmp_path / "plan.json"
    chosen = ["losses.terms.bending=null", "solver.target_rg=0.1"]
    path.write_text(json.dumps({"format": "hood-plan/1", "words": WORDS, "chosen": chosen}))
    return path


def test_a_rollout_by_a_plan_is_that_of_its_words(written: Path, tmp_path: Path) -> None:
    short = ["num_frames=6", *QUIET]
    plain = [word for word in WORDS if not word.startswith("num_frames")]
    by_plan, by_words, full = (tmp_path / name for name in ("plan", "words", "full"))
    assert main(["rollout", f"plan={written}", *short, f"output={by_plan}"]) == 0
    assert main(["rollout", *plain, "losses.terms.bending=null", "solver.target_rg=0.1", *short, f"output={by_words}"]) == 0
    assert main(["rollout", *plain, *short, f"output={full}"]) == 0
    assert np.array_equal(positions(by_plan), positions(by_words))
    assert not np.array_equal(positions(by_plan), positions(full))


def test_python_takes_a_plan_too(written: Path) -> None:
    run = hood.simulate(plan=str(written), num_frames=3)
    config = rollout_config([f"plan={written}"])
    assert config.losses.terms.bending is None
    assert config.solver.target_rg == 0.1
    assert len(list(run)) == 3
    with pytest.raises(ValueError, match="leave them out"):
        hood.simulate(plan=str(written), material=hood.Material())


def test_a_rollout_watches_what_its_plan_leaves_out(written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With no tolerance at all every step is the full model's, and the summary says so."""
    plan = json.loads(written.read_text())
    chosen, short = ["losses.terms.bending=null", "cloth_contact=off"], ["num_frames=5", *QUIET]
    written.write_text(json.dumps(plan | {"chosen": chosen, "watch": {"limit": 1e-30, "hold": 3}}))
    by_plan, full = tmp_path / "plan", tmp_path / "full"
    assert main(["rollout", f"plan={written}", *short, f"output={by_plan}"]) == 0
    assert "plan: the full model took 4 steps" in capsys.readouterr().out
    assert main(["rollout", *WORDS[:3], *short, f"output={full}"]) == 0
    assert np.array_equal(positions(by_plan), positions(full))
    found = json.loads((by_plan / "summary.json").read_text())["plan"]
    assert found["frames_by_full_model"] == [1, 2, 3, 4]
    assert found["price_max"] > 1e-30

    written.write_text(json.dumps(plan | {"chosen": chosen, "watch": {"limit": 1e9, "hold": 3}}))
    assert main(["rollout", f"plan={written}", *short, f"output={tmp_path / 'lean'}"]) == 0
    assert "plan: what was left out was worth" in capsys.readouterr().out
    assert json.loads((tmp_path / "lean" / "summary.json").read_text())["plan"]["frames_by_full_model"] == []


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "not a plan"),
        ("[]", "not a plan"),
        ('{"format": "hood-plan/2"}', "not a plan"),
        ('{"format": "hood-plan/1", "words": "garment=dress", "chosen": []}', "must be lists"),
        ('{"format": "hood-plan/1", "words": ["plan=other.json"], "chosen": []}', "names another plan"),
        ('{"format": "hood-plan/1", "words": ["material._target_=os.system"], "chosen": []}', "os.system"),
        ('{"format": "hood-plan/1", "words": [], "chosen": [], "watch": {"limit": -1}}', "'watch' must hold"),
        (None, "no such file"),
    ],
)
def test_what_is_no_plan_is_refused(content: str | None, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.json"
    if content is not None:
        path.write_text(content)
    assert main(["rollout", f"plan={path}", f"output={tmp_path / 'out'}"]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_what_is_shown_and_exported_is_free_beside_a_plan(written: Path, tmp_path: Path) -> None:
    words = [f"plan={written}", "num_frames=2", *QUIET, "formats=[glb]", f"output={tmp_path}"]
    assert main(["rollout", *words]) == 0
    assert (tmp_path / "rollout.glb").exists()


def test_words_that_the_plan_was_not_made_for_are_refused(written: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for word, made_for in (("garment=skirt", "garment=tank"), ("material=denim", "the default of material")):
        assert main(["rollout", f"plan={written}", word]) == 2
        assert made_for in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["parts=[bendign]"], "bending"),
        (["accuracy=5cm"], "accuracy=5cm"),
        (["windows=0"], "windows=0"),
        (["frames=0"], "frames=0"),
        (["frames=200"], "fewer frames"),
        (["plan=x.json"], "drop plan="),
        (["budget_ms=0"], "budget_ms=0: give milliseconds"),
        (["parts=[mesh dress]"], "mesh tank_4k"),
        (["garmet=tank"], "garmet"),
    ],
)
def test_bad_words_are_told_in_a_line(words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", *WORDS, f"output={tmp_path / 'plan'}", *words]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert not (tmp_path / "plan" / "plan.json").exists()


def test_without_a_body_its_contact_is_absent(tmp_path: Path) -> None:
    words = ["body=none", "garment=tank", "sequence=plie", "stepper=newton", "pins=[0,1]", "num_frames=12"]
    assert main(["plan", *words, "windows=1", "frames=1", "parts=[friction,bending]", f"output={tmp_path}"]) == 0
    rows = {row["part"]: row for row in read(tmp_path / "plan.json")["rows"]}
    assert rows["friction"]["decision"] == "absent"
    assert rows["bending"]["decision"] in ("kept", "left out")


def test_a_plan_that_names_no_stepper_is_of_the_network(tmp_path: Path) -> None:
    """It was made when the network was the default."""
    path = tmp_path / "plan.json"
    watch = {"limit": 0.01, "hold": 3}
    for chosen, stepper in ((["refine=5"], "network"), ([], "network"), (["stepper=newton", "refine=0"], "newton")):
        path.write_text(json.dumps({"format": "hood-plan/1", "words": ["garment=tank"], "chosen": chosen, "watch": watch}))
        assert rollout_config([f"plan={path}"]).stepper == stepper
        found = read_watch(path)
        assert found is not None
        assert found.words == ["stepper=network", "garment=tank"]

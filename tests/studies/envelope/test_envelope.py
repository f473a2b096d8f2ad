"""``hood envelope``: its rollouts, what is done and not done again, and how commands beside it end."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hood.app.settings.compose import ConfigError, load_config
from hood.cli.main import main
from hood.rollouts.verdict.rule import Verdict
from hood.studies.envelope import envelope
from hood.studies.envelope import tasks as envelope_tasks
from hood.studies.envelope.cells import NOMINAL, Cell, cells
from hood.studies.envelope.judge import Criteria
from hood.studies.envelope.tasks import REFERENCE, Task, command_of, make_tasks, write_inputs
from hood.studies.processes import Ended, run_beside

NO_TIME = Cell("input", "no time", ("fps=0",), bad_input="fps")


def test_what_a_rollout_of_the_map_is_asked_for(tmp_path: Path) -> None:
    config = load_config("envelope", ["models=[quickstart+5,guess+5,quickstart+repair,newton+repair]", "factors=[dt]"])
    tasks = make_tasks(config)
    finest = next(cell for cell in cells() if cell.value == "1/480")
    models = [task.model for task in tasks if task.cell == finest]
    assert models == [REFERENCE, "newton", "quickstart+5", "guess+5", "quickstart+repair", "newton+repair"]
    words = {task.model: command_of(task, config, tmp_path) for task in tasks if task.cell == finest}
    assert "fps=960" in words[REFERENCE]  # no more than 1,000
    assert "fps=480" in words["newton"]
    assert {"checkpoint=quickstart", "refine=5"} <= set(words["quickstart+5"])
    assert {"stepper=refine", "refine=5"} <= set(words["guess+5"])
    assert {"checkpoint=quickstart", "refine=0", "guard=repair"} <= set(words["quickstart+repair"])
    assert {"stepper=newton", "guard=repair"} <= set(words["newton+repair"])
    assert [model for model in models if "guard=repair" in words[model]] == ["quickstart+repair", "newton+repair"]
    assert {task.model for task in tasks if task.alone} == {"quickstart+repair"}
    assert Task(finest, "dress", "quickstart").alone


def test_the_limits_that_help_prints_are_the_librarys() -> None:
    config = load_config("envelope")
    assert Criteria() == Criteria(**{spec.name: config[spec.name] for spec in fields(Criteria)})


def test_the_nominal_cell_is_first_and_long_ones_are_asked_for() -> None:
    tasks = make_tasks(load_config("envelope", ["models=[quickstart]", "factors=[spin]", "garments=[dress,tank]"]))
    assert {task.cell.factor for task in tasks} == {NOMINAL, "spin"}
    assert [(task.cell.factor, task.garment) for task in tasks[:6:3]] == [(NOMINAL, "dress"), (NOMINAL, "tank")]
    short, whole, named = (
        {task.cell for task in make_tasks(load_config("envelope", words))} for words in ([], ["long=true"], ["factors=[long]"])
    )
    assert whole - short == {cell for cell in cells() if cell.long} == named - short
    long = [task for task in make_tasks(load_config("envelope", ["factors=[long]"])) if task.cell.long]
    assert REFERENCE not in {task.model for task in long}


def test_cells_bring_their_own_garment_body_and_motion(tmp_path: Path) -> None:
    config = load_config("envelope", ["models=[newton]", "garments=[tank]"])
    tasks = [task for task in make_tasks(config) if task.model == "newton"]

    def words(name: str) -> tuple[str, ...]:
        return next(command_of(task, config, tmp_path) for task in tasks if task.cell.name == name)

    assert "garment=[tank,skirt]" in words("layers-tank-skirt")
    assert {"sequence=none", f"body={tmp_path}/inputs/body.obj"} <= set(words("drop-2-m"))
    assert {"garment=skirt", "pins=[waistband,hem]"} <= set(words("pins-hem-legs-90-degrees-apart"))
    assert {"loop=50", "sequence=walk_proud", "metrics={surface_every:20}"} <= set(
        command_of(Task(next(c for c in cells() if c.long and c.sequence), "tank", "newton"), config, tmp_path)
    )
    folders = {task.folder(tmp_path) for task in tasks}
    assert len(folders) == len(tasks)
    assert all(" " not in str(path.relative_to(tmp_path)) and "[" not in str(path) for path in folders)


def test_inputs_are_written_once(tmp_path: Path) -> None:
    chosen = [cell for cell in cells() if cell.name in ("drop-2-m", "turn-90-degrees", "together-eight")]
    write_inputs([Task(cell, "dress", "newton") for cell in chosen], tmp_path)
    found = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "inputs").iterdir()}
    assert set(found) == {"body.obj", "dress_sheet_2.npz", "turn_90.npz"}
    write_inputs([Task(cell, "dress", "newton") for cell in chosen], tmp_path)
    assert found == {path.name: path.stat().st_mtime_ns for path in (tmp_path / "inputs").iterdir()}


def test_a_long_motion_has_a_file_of_its_own(tmp_path: Path) -> None:
    config = load_config("envelope", ["models=[newton]"])
    rest, long = (Task(cell, "dress", "newton") for cell in cells() if cell.motion == "rest")
    assert command_of(rest, config, tmp_path)[2] != command_of(long, config, tmp_path)[2]
    assert long.cell.seconds * long.cell.fps >= long.cell.num_frames


def test_a_document_without_marks_is_refused_before_anything_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "page.md"
    path.write_text("# Page\n")
    assert main(["envelope", f"document={path}", f"output={tmp_path / 'out'}"]) == 2
    assert "write the lines <!-- written by hood envelope: begin -->" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["factors=[spam]"], "factors: 'spam' is none of them; choose nominal, garment, motion, dt"),
        (["models=[newton+5]"], "refines what is solved already"),
        (["models=[]"], r"models=\[\]: give at least one"),
    ],
)
def test_what_is_no_map_is_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_tasks(load_config("envelope", overrides))


def test_a_cell_is_run_once_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(envelope_tasks, "cells", lambda: (NO_TIME,))
    words = ["envelope", "models=[newton]", "garments=[tank]", f"output={tmp_path}"]
    assert main(words) == 0
    with open(tmp_path / "envelope.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["class"] == "refused"
    assert row["reasons"] == "fps=0: give the simulation's frames per second, 1 to 1000"
    assert "hood rollout garment=tank" in row["command"]
    assert "0/1, 1 refused" in capsys.readouterr().out
    monkeypatch.setattr(envelope, "run_beside", lambda started, *given: iter([_never(task) for task in started]))
    assert main(words) == 0
    record = next(tmp_path.rglob("cell.json"))
    record.write_text(json.dumps(json.loads(record.read_text()) | {"weights": "others"}))
    with pytest.raises(AssertionError, match="run again"):
        main(words)


@pytest.mark.parametrize(("strain", "sound", "asked"), [(0.2, True, False), (0.3, True, True), (0.3, False, False)])
def test_a_finer_rollout_of_the_solver_is_made_where_it_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strain: float, sound: bool, asked: bool
) -> None:
    made: list[str] = []

    def beside(started: Iterable[tuple[Task, object, Path]], *given: object) -> Iterator[tuple[Task, Ended]]:
        for task, _, folder in started:
            made.append(task.model)
            folder.mkdir(parents=True)
            yield task, Ended(0, "", 1.0)

    monkeypatch.setattr(envelope_tasks, "cells", lambda: (Cell("fall", "2 m"),))
    monkeypatch.setattr(envelope, "run_beside", beside)
    monkeypatch.setattr(envelope, "read_rollout", lambda path: SimpleNamespace(metrics={"strain_p99": np.full(9, strain)}))
    monkeypatch.setattr(envelope, "judge_rollout", lambda data: Verdict(sound))
    assert main(["envelope", "models=[quickstart]", "garments=[tank]", "factors=[fall]", f"output={tmp_path}"]) == 0
    assert made == ["newton", "quickstart", *([REFERENCE] if asked else [])]


def _never(task: object) -> tuple[Task, Ended]:
    raise AssertionError("run again")


def test_how_commands_beside_end(tmp_path: Path) -> None:
    programs = {
        "done": "print('hood: error: not this one')",
        "refused": "import sys; print('hood: error: no such file', file=sys.stderr); sys.exit(2)",
        "broken": "print('hood: error: before'); raise SystemError('trace')",
        "slow": "import time; time.sleep(60)",
    }
    started = [(name, ["-c", text], tmp_path / name) for name, text in programs.items()]
    ended = dict(run_beside(started, 2, 1.5, (sys.executable,)))
    assert ended["done"].exit_code == 0
    assert ended["done"].error == ""
    assert (ended["refused"].exit_code, ended["refused"].error) == (2, "no such file")
    assert (ended["broken"].exit_code, ended["broken"].error) == (1, "")
    assert ended["slow"].exit_code < 0
    assert "not done after 1.5 s" in ended["slow"].error
    assert "SystemError" in (tmp_path / "broken" / "log.txt").read_text()

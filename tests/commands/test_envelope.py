"""``hood envelope``: its rollouts, what is done and not done again, and how commands beside it end."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import pytest

from hood.cli import main
from hood.commands import envelope
from hood.commands.envelope import REFERENCE, Task, command_of, make_tasks
from hood.commands.rollouts_beside import Ended, run_beside
from hood.config import ConfigError, load_config
from hood.evaluation.envelope import Cell, cells

NO_TIME = Cell("input", "no time", ("fps=0",), bad_input="fps")


def test_what_a_rollout_of_the_map_is_asked_for(tmp_path: Path) -> None:
    config = load_config("envelope", ["models=[quickstart+5,guess+5]", "factors=[dt]"])
    tasks = make_tasks(config)
    finest = next(cell for cell in cells() if cell.value == "1/480")
    assert [task.model for task in tasks if task.cell == finest] == [REFERENCE, "newton", "quickstart+5", "guess+5"]
    words = {task.model: command_of(task, config, tmp_path) for task in tasks if task.cell == finest}
    assert "fps=960" in words[REFERENCE]  # no more than 1,000
    assert "fps=480" in words["newton"]
    assert {"checkpoint=quickstart", "refine=5"} <= set(words["quickstart+5"])
    assert {"stepper=refine", "refine=5"} <= set(words["guess+5"])
    assert not any(task.alone for task in tasks)
    assert Task(finest, "dress", "quickstart").alone


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["factors=[spam]"], "factors: 'spam' is none of them; choose dt, stretching"),
        (["models=[newton+5]"], "refines what is solved already"),
        (["models=[]"], "models and garments: give one of each at least"),
    ],
)
def test_what_is_no_map_is_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_tasks(load_config("envelope", overrides))


def test_a_cell_is_run_once_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(envelope, "cells", lambda: (NO_TIME,))
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

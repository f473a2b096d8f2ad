"""``hood envelope``: where each method holds, measured at the extremes of everything that a scene may ask for.

What has been measured of the stability map: every cell judged, as tables, as a page and as a section of a document.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from tqdm import tqdm

from hood.app.common import held_folder, require_distinct, together
from hood.app.output.verdict import surface_warnings
from hood.app.settings.compose import ConfigError, load_config, shown
from hood.app.settings.record import require_same_config, save_run_record
from hood.assets.files.atomic import write_atomically
from hood.evaluation.files import write_rows
from hood.evaluation.table import NEWTON
from hood.rollouts.file.reader import read_rollout
from hood.rollouts.verdict.rule import judge_rollout
from hood.studies.envelope.cells import NOMINAL
from hood.studies.envelope.judge import (
    FIGURES,
    Criteria,
    JudgedRun,
    at_same_times,
    figures,
    judge,
    judged_table,
    shares,
    usual_of,
    worst,
)
from hood.studies.envelope.page import Curve, View, require_marks, small_sheet, write_map_page, write_section
from hood.studies.envelope.tasks import REFERENCE, Task, command_of, make_tasks, read_judged, weights_of, write_inputs
from hood.studies.processes import Ended, interruptible, run_beside
from hood.training import distributed

_COLUMNS = ("factor", "value", "garment", "model", "class", "reasons", "said", "exit_code", *FIGURES, "weights", "command")


@dataclass(frozen=True)
class _Found:
    """What a rollout left."""

    run: JudgedRun
    pos: np.ndarray | None = None  # (T, V, 3) m
    dt: float = 0.0


def report(config: DictConfig, tasks: Sequence[Task], commands: Mapping[Task, Sequence[str]], folder: Path) -> None:
    """Judge what is done, print how many cells are sound and write ``envelope.csv``, ``envelope.json``, ``index.html`` and the
    section of the document."""
    criteria = Criteria(**{spec.name: float(config[spec.name]) for spec in fields(Criteria)})
    models, views, usual = [str(name) for name in config.models], list[View](), dict[tuple[str, str], set[str]]()
    for _, group in groupby(tasks, key=lambda task: (task.cell, task.garment)):
        found = {task: read_found(task, folder) for task in group if read_judged(task, folder)}
        for task in sorted((task for task in found if task.model in models), key=lambda task: models.index(task.model)):
            known = usual.get((task.garment, task.model), usual.get((str(config.garments[0]), task.model), set()))
            view = view_of(task, found, commands[task], criteria, known, folder)
            if task.cell.factor == NOMINAL:
                usual[task.garment, task.model] = usual_of(found[task].run.warnings, bool(view.judged.reasons))
                view = view_of(task, found, commands[task], criteria, usual[task.garment, task.model], folder)
            views.append(view)
    rows = [view.row for view in views]
    write_rows(rows, _COLUMNS, folder, "envelope")
    page = write_map_page(views, models, criteria, folder)
    if config.document is not None:
        write_section(Path(str(config.document)), rows, models)
    print(judged_table(rows, models))
    for model in models:
        parts = shares([row["class"] for row in rows if row["model"] == model])
        print(f"{model}: " + ", ".join(f"{kind} {share:.0%}" for kind, share in parts.items()))
    print(f"cells with reasons, curves and commands in {page}, as tables in {folder / 'envelope.csv'} and envelope.json")


def view_of(
    task: Task, found: Mapping[Task, _Found], command: Sequence[str], criteria: Criteria, usual: Collection[str], folder: Path
) -> View:
    """What is shown of a rollout: its class and figures, its curve beside the solver's, and pictures where it is not sound."""
    own, against = found[task], found.get(task.beside(REFERENCE if task.model == NEWTON else NEWTON))
    solver = None if against is None else against.run
    judged = judge(task.cell, own.run, None if solver is None else solver.metrics, task.alone, criteria, usual)
    words = {"class": judged.kind, "reasons": "; ".join(judged.reasons), "said": "; ".join(judged.said)}
    row = _row(task, own, against) | words | {"command": shlex.join(["hood", *command])}
    picture = small_sheet(task.folder(folder)) if judged.reasons and own.pos is not None else None
    return View(row, judged, curve_of(own.run), None if solver is None else curve_of(solver), picture)


def read_found(task: Task, folder: Path) -> _Found:
    """What is on disk of a rollout that has ended."""
    record, at = read_judged(task, folder), task.folder(folder) / "rollout"
    code, error = int(record["exit_code"]), str(record["error"])
    try:
        summary = json.loads((at / "summary.json").read_text())
        data = read_rollout(at / "rollout.h5")
    except (OSError, ValueError):
        return _Found(JudgedRun(code, error, late=code < 0 and bool(error)))
    surface = summary.get("surface")
    warnings = (*summary.get("warnings", ()), *(() if surface is None else surface_warnings(surface)))
    verdict = judge_rollout(data)  # of today's rule, whenever the rollout was made
    unsound = verdict.sentences if verdict.sound is False else ()
    finite = np.isfinite(data.cloth_pos).all(axis=(1, 2))
    run = JudgedRun(code, error, warnings, unsound, {**data.metrics, "finite": finite})
    return _Found(run, data.cloth_pos, float(data.attributes["dt"]))


def curve_of(run: JudgedRun) -> Curve | None:
    """Strain p99 and cut share by frame, for the page."""
    if run.metrics is None:
        return None
    blank = np.full(len(run.metrics["finite"]), np.nan)
    return Curve(run.metrics.get("strain_p99", blank), run.metrics.get("cut_face_share", blank))


def _row(task: Task, found: _Found, against: _Found | None) -> dict[str, Any]:
    run, measured = found.run, dict.fromkeys(FIGURES)
    if run.metrics is not None and found.pos is not None:
        reference = None
        if against is not None and against.pos is not None:
            reference = at_same_times(against.pos, against.dt, found.dt)
        measured = figures(run.metrics, found.pos, task.cell.motion == "rest", reference)
    return {
        "factor": task.cell.factor,
        "value": task.cell.value,
        "garment": task.garment,
        "model": task.model,
        "exit_code": run.exit_code,
        **measured,
        "weights": weights_of(task.model),
    }


#: Settings that may change from one call to the next, besides the criteria: they change no rollout.
_FREE = ("models", "garments", "factors", "long", "document", "jobs", "timeout", "output")
#: Rollouts of long cells may take so many times as long as others.
_LONGER = 12


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    config = load_config("envelope", overrides)
    for key in ("models", "garments", "factors"):
        require_distinct(key, [str(value) for value in config[key]])
    _check_numbers(config)
    if config.document is not None:
        require_marks(Path(str(config.document)))  # now, not in some hours
    return together(lambda: _run(config))


def _check_numbers(config: DictConfig) -> None:
    if int(config.jobs) < 1:
        raise ConfigError(f"jobs={config.jobs}: must be at least 1, rollouts side by side")
    for key in ("timeout", *(spec.name for spec in fields(Criteria))):
        if not float(config[key]) > 0:
            raise ConfigError(f"{key}={shown(config[key])}: give a number above 0")


def _run(config: DictConfig) -> int:
    tasks = make_tasks(config)
    with held_folder(config) as folder:
        return _make(config, tasks, folder)


def _make(config: DictConfig, tasks: Sequence[Task], folder: Path) -> int:
    distributed.on_main(lambda: _prepare(config, folder, tasks))
    commands = {task: command_of(task, config, folder) for task in tasks}
    _roll_out([task for task in tasks if task.model != REFERENCE], commands, config, folder)
    finer = [task for task in tasks if task.model == REFERENCE]
    _roll_out(
        [task for task in finer if _is_asked(task.beside(NEWTON), float(config.strain), folder)], commands, config, folder
    )
    if distributed.rank() == 0:
        report(config, tasks, commands, folder)
    return 0


def _roll_out(tasks: Sequence[Task], commands: Mapping[Task, Sequence[str]], config: DictConfig, folder: Path) -> None:
    """Make those that are not done; every process its share, and none goes on before all are done."""
    todo = [task for task in tasks if not _is_done(task, commands[task], folder)]
    mine = todo[distributed.rank() :: distributed.world_size()]
    quiet = True if distributed.rank() else None
    with tqdm(total=len(mine), desc="envelope", unit="rollout", disable=quiet) as bar, interruptible():
        started = ((task, commands[task], task.folder(folder)) for task in mine)
        timeout = float(config.timeout) * (_LONGER if any(task.cell.long for task in mine) else 1)
        for task, ended in run_beside(started, int(config.jobs), timeout):
            _note(task, commands[task], ended, folder)
            bar.update()
    distributed.gather(None)


def _is_asked(solver: Task, strain: float, folder: Path) -> bool:
    """Whether only a finer rollout can tell if the solver's is sound: the verdict calls it so, but its strain is beyond what is
    sound without a reference."""
    try:
        data = read_rollout(solver.folder(folder) / "rollout" / "rollout.h5")
    except (OSError, ValueError):
        return False
    return worst(data.metrics, "strain_p99") > strain and judge_rollout(data).sound is not False


def _prepare(config: DictConfig, folder: Path, tasks: Sequence[Task]) -> None:
    require_same_config(config, folder, (*_FREE, *(spec.name for spec in fields(Criteria))))
    save_run_record(folder, config, seed=0)
    write_inputs(tasks, folder)


def _is_done(task: Task, command: Sequence[str], folder: Path) -> bool:
    record = read_judged(task, folder)
    return record.get("command") == list(command) and record.get("weights") == weights_of(task.model)


def _note(task: Task, command: Sequence[str], ended: Ended, folder: Path) -> None:
    record = {"command": list(command), "weights": weights_of(task.model), "exit_code": ended.exit_code, "error": ended.error}
    write_atomically(task.folder(folder) / "cell.json", json.dumps(record | {"seconds": ended.seconds}, indent=1).encode())

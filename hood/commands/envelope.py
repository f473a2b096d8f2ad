"""``hood envelope``: where each method holds, measured at the extremes of everything that a scene may ask for."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from tqdm import tqdm

from hood.assets.atomic import write_atomically
from hood.assets.extremes import write_garment, write_motion
from hood.assets.library import locate
from hood.commands.candidates import split_refinement
from hood.commands.common import held_folder, require_distinct, require_same_config, together
from hood.commands.rollouts_beside import Ended, interruptible, run_beside
from hood.commands.surface_report import surface_warnings
from hood.config import ConfigError, load_config, save_run_record
from hood.dynamics.recorder import read_rollout
from hood.evaluation.envelope import Cell, Criteria, Judged, Run, cells, judge, shares, table
from hood.evaluation.grid import GUESS, NEWTON, quoted
from hood.evaluation.rows import write_rows
from hood.training import distributed

#: The solver at a quarter of the time step, which the solver itself is held against; and no rollout has more frames per second.
REFERENCE, _FINER, _MOST_FPS = "newton, dt/4", 4, 1000.0
_COLUMNS = ("factor", "value", "garment", "model", "class", "reasons", "exit_code", "said", "strain_p99", "command")


@dataclass(frozen=True)
class Task:
    """A rollout of the map."""

    cell: Cell
    garment: str
    model: str

    def folder(self, output: Path) -> Path:
        return output / "cells" / self.cell.name / self.garment / self.model.replace(", ", "_").replace("/", "-")

    @property
    def alone(self) -> bool:
        """Whether a network alone takes the steps."""
        name, refine = split_refinement(self.model)
        return refine is None and name not in (NEWTON, GUESS, REFERENCE)


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    config = load_config("envelope", overrides)
    for key in ("models", "garments", "factors"):
        require_distinct(key, [str(value) for value in config[key]])
    return together(lambda: _run(config))


def _run(config: DictConfig) -> int:
    tasks = make_tasks(config)
    with held_folder(config) as folder:
        return _make(config, tasks, folder)


def _make(config: DictConfig, tasks: Sequence[Task], folder: Path) -> int:
    distributed.on_main(lambda: _prepare(config, folder, tasks))
    commands = {task: command_of(task, config, folder) for task in tasks}
    todo = [task for task in tasks if not _is_done(task, commands[task], folder)]
    mine = todo[distributed.rank() :: distributed.world_size()]
    quiet = True if distributed.rank() else None
    with tqdm(total=len(mine), desc="envelope", unit="rollout", disable=quiet) as bar, interruptible():
        started = ((task, commands[task], task.folder(folder)) for task in mine)
        for task, ended in run_beside(started, int(config.jobs), float(config.timeout)):
            _note(task, commands[task], ended, folder)
            bar.update()
    distributed.gather(None)
    if distributed.rank() == 0:
        _report(config, tasks, commands, folder)
    return 0


def make_tasks(config: DictConfig) -> list[Task]:
    """All rollouts of the map, those that others are held against first.

    Raises:
        ConfigError: no such factor, or no model or garment.
        FileNotFoundError: there is no such model or garment.
    """
    known = list(dict.fromkeys(cell.factor for cell in cells()))
    wanted = [str(name) for name in config.factors]
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise ConfigError(f"factors: {unknown[0]!r} is none of them; choose {', '.join(known)}")
    models, garments = [str(name) for name in config.models], [str(name) for name in config.garments]
    if not models or not garments:
        raise ConfigError("models and garments: give one of each at least")
    for model in models:
        name, _ = split_refinement(model)
        if name not in (NEWTON, GUESS):
            locate("weights", name)
    for garment in garments:
        locate("garments", garment)
    chosen = [cell for cell in cells() if not wanted or cell.factor in wanted]
    methods = [REFERENCE, NEWTON, *(model for model in models if model != NEWTON)]
    return [
        Task(cell, garment, model)
        for cell in chosen
        for garment in garments
        for model in methods
        if not (cell.bad_input and model not in models)
    ]


def _prepare(config: DictConfig, folder: Path, tasks: Sequence[Task]) -> None:
    criteria = tuple(spec.name for spec in fields(Criteria))
    require_same_config(config, folder, ("models", "garments", "factors", "jobs", "timeout", "output", *criteria))
    save_run_record(folder, config, seed=0)
    (folder / "inputs").mkdir(exist_ok=True)
    for task in tasks:
        cell = task.cell
        motion, garment = _motion(cell, folder), _garment(cell, task.garment, folder)
        if cell.motion is not None and not motion.exists():
            write_motion(motion, cell.motion, cell.seconds + 1.0)
        if cell.fault is not None and not garment.exists():
            write_garment(garment, task.garment, cell.fault)


def _motion(cell: Cell, folder: Path) -> Path:
    return folder / "inputs" / f"{(cell.motion or '').replace(':', '_')}.npz"


def _garment(cell: Cell, garment: str, folder: Path) -> Path:
    return folder / "inputs" / f"{garment}_{(cell.fault or '').replace(':', '_')}.npz"


def command_of(task: Task, config: DictConfig, folder: Path) -> tuple[str, ...]:
    """The arguments of ``hood`` that make a rollout of the map."""
    cell = task.cell
    finer = min(_FINER, int(_MOST_FPS / cell.fps)) if task.model == REFERENCE else 1
    settings = [text for text in cell.settings if finer == 1 or not text.startswith("fps=")]
    if finer > 1:
        settings.append(f"fps={finer * cell.fps:g}")
    garment = _garment(cell, task.garment, folder) if cell.fault is not None else task.garment
    motion = _motion(cell, folder) if cell.motion is not None else str(config.sequence)
    asked = (
        f"garment={quoted(str(garment))}",
        f"sequence={quoted(str(motion))}",
        f"num_frames={finer * (cell.num_frames - 1) + 1}",
        *settings,
    )
    drawn = ("surface_stride=1" if finer == 1 else "metrics=strain", "video=none", "sheet=false")
    return ("rollout", *asked, *_method(task.model), *drawn, f"output={quoted(str(task.folder(folder) / 'rollout'))}")


def _method(model: str) -> tuple[str, ...]:
    if model in (NEWTON, REFERENCE):
        return ("stepper=newton",)
    name, refine = split_refinement(model)
    if name == GUESS:
        return ("stepper=refine", f"refine={refine or 0}")
    return (f"checkpoint={name}", f"refine={refine or 0}")


@cache
def _weights(model: str) -> str:
    """SHA-256 of the weights; a map of others of the same name is not done."""
    name, _ = split_refinement(model)
    if name in (NEWTON, GUESS, REFERENCE):
        return "none"
    return hashlib.sha256(locate("weights", name).read_bytes()).hexdigest()


def _is_done(task: Task, command: Sequence[str], folder: Path) -> bool:
    record = _record(task, folder)
    return record.get("command") == list(command) and record.get("weights") == _weights(task.model)


def _record(task: Task, folder: Path) -> dict[str, Any]:
    try:
        content = json.loads((task.folder(folder) / "cell.json").read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _note(task: Task, command: Sequence[str], ended: Ended, folder: Path) -> None:
    record = {"command": list(command), "weights": _weights(task.model), "exit_code": ended.exit_code, "error": ended.error}
    write_atomically(task.folder(folder) / "cell.json", json.dumps(record | {"seconds": ended.seconds}, indent=1).encode())


def _outcome(task: Task, folder: Path) -> Run:
    """What is on disk of a rollout that has ended."""
    record, at = _record(task, folder), task.folder(folder) / "rollout"
    try:
        summary = json.loads((at / "summary.json").read_text())
        data = read_rollout(at / "rollout.h5")
    except (OSError, ValueError):
        return Run(int(record["exit_code"]), str(record["error"]))
    surface = summary.get("surface")
    told = () if surface is None else surface_warnings(surface)
    said = (*summary.get("warnings", ()), *summary.get("unsound_reasons", ()), *told)
    finite = np.isfinite(data.cloth_pos).all(axis=(1, 2))
    return Run(int(record["exit_code"]), str(record["error"]), said, {**data.metrics, "finite": finite})


def _report(config: DictConfig, tasks: Sequence[Task], commands: Mapping[Task, Sequence[str]], folder: Path) -> None:
    criteria = Criteria(**{spec.name: float(config[spec.name]) for spec in fields(Criteria)})
    models = [str(name) for name in config.models]
    rows, runs = [], {task: _outcome(task, folder) for task in tasks if _record(task, folder)}
    for task, found in runs.items():
        if task.model in models:
            against = runs.get(Task(task.cell, task.garment, REFERENCE if task.model == NEWTON else NEWTON))
            judged = judge(task.cell, found, None if against is None else against.metrics, task.alone, criteria)
            rows.append(_row(task, found, judged, commands[task]))
    write_rows(rows, _COLUMNS, folder, "envelope")
    print(table(rows, models))
    for model in models:
        parts = shares([row["class"] for row in rows if row["model"] == model])
        print(f"{model}: " + ", ".join(f"{kind} {share:.0%}" for kind, share in parts.items()))
    print(f"every cell with its reasons and its command in {folder / 'envelope.csv'} and {folder / 'envelope.json'}")


def _row(task: Task, found: Run, judged: Judged, command: Sequence[str]) -> dict[str, Any]:
    strain = None if found.metrics is None else found.metrics["strain_p99"]
    known = strain is not None and np.isfinite(strain).any()
    return {
        "factor": task.cell.factor,
        "value": task.cell.value,
        "garment": task.garment,
        "model": task.model,
        "class": judged.kind,
        "reasons": "; ".join(judged.reasons),
        "exit_code": found.exit_code,
        "said": "; ".join(found.said) or found.error,
        "strain_p99": float(np.nanmax(strain)) if strain is not None and known else None,
        "command": shlex.join(["hood", *command]),
    }

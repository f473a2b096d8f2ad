"""``hood envelope``: where each method holds, measured at the extremes of everything that a scene may ask for."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from omegaconf import DictConfig
from tqdm import tqdm

from hood.assets.files.atomic import write_atomically
from hood.commands.common import held_folder, require_distinct, require_same_config, together
from hood.commands.envelope_report import report
from hood.commands.envelope_tasks import Task, command_of, make_tasks, read_record, weights_of, write_inputs
from hood.commands.rollouts_beside import Ended, interruptible, run_beside
from hood.config import ConfigError, load_config, save_run_record, shown
from hood.evaluation.envelope import Criteria
from hood.evaluation.envelope_prose import require_marks
from hood.training import distributed

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
    if distributed.rank() == 0:
        report(config, tasks, commands, folder)
    return 0


def _prepare(config: DictConfig, folder: Path, tasks: Sequence[Task]) -> None:
    require_same_config(config, folder, (*_FREE, *(spec.name for spec in fields(Criteria))))
    save_run_record(folder, config, seed=0)
    write_inputs(tasks, folder)


def _is_done(task: Task, command: Sequence[str], folder: Path) -> bool:
    record = read_record(task, folder)
    return record.get("command") == list(command) and record.get("weights") == weights_of(task.model)


def _note(task: Task, command: Sequence[str], ended: Ended, folder: Path) -> None:
    record = {"command": list(command), "weights": weights_of(task.model), "exit_code": ended.exit_code, "error": ended.error}
    write_atomically(task.folder(folder) / "cell.json", json.dumps(record | {"seconds": ended.seconds}, indent=1).encode())

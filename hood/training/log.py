"""Where the figures of a training go: one JSON object per line in ``metrics.jsonl``, and loggers beside it: TensorBoard, CSV,
Weights & Biases, or classes of one's own.

Means of the updates since the last record; iterations per second of training alone.
"""

from __future__ import annotations

import csv
import io
import json
import math
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.assets.files.said import install, say

#: What ``metrics.jsonl`` holds of a line: the iteration and the figures; None where one was not finite.
LogRecord = Mapping[str, float | None]


class Clock:
    """Runs while training does; what is :meth:`paused` does not count."""

    def __init__(self, iteration: int) -> None:
        self._first, self._begun, self._away = iteration, time.monotonic(), 0.0

    def rate(self, iteration: int) -> float:
        return (iteration - self._first) / max(time.monotonic() - self._begun - self._away, 1e-9)

    @contextmanager
    def paused(self) -> Iterator[None]:
        left = time.monotonic()
        yield
        self._away += time.monotonic() - left


class Logger:
    """What is told the figures of a training, on process 0. A class of one's own overrides what it needs::

        class Printed(Logger):
            def write(self, iteration, values):
                print(iteration, values["loss"])

    One that raises is told nothing more; the training goes on.

    Attributes:
        config: the keys of the run, as ``config.yaml`` has them; empty where a program trains without them.
    """

    config: Mapping[str, Any] = {}

    def begin(self, folder: Path, iteration: int, records: Sequence[LogRecord]) -> None:
        """Training begins or goes on at an iteration, with these records so far; later ones that were written are void.

        Called again, after :meth:`end`, when training goes back to a checkpoint.
        """

    def write(self, iteration: int, values: Mapping[str, float]) -> None:
        """The figures of one record; two records may have one iteration, of updates and of a validation."""

    def picture(self, iteration: int, name: str, image: np.ndarray) -> None:
        """A picture (H, W, 3) uint8."""

    def end(self) -> None:
        """Nothing more will be written."""


class TensorBoard(Logger):
    """Events in the folder ``tensorboard`` of the run."""

    def begin(self, folder: Path, iteration: int, records: Sequence[LogRecord]) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise ImportError(
                "torch cannot use the one that is installed"
                if find_spec("tensorboard")
                else f"it is not installed ({install('tensorboard')})"
            ) from error
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=iteration + 1 if iteration else None)

    def write(self, iteration: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._board.add_scalar(name, value, iteration)

    def picture(self, iteration: int, name: str, image: np.ndarray) -> None:
        self._board.add_image(name, image, iteration, dataformats="HWC")

    def end(self) -> None:
        self._board.close()


class Csv(Logger):
    """``metrics.csv``: a row a record, a column a figure; empty where a record has none, or none that is finite."""

    def begin(self, folder: Path, iteration: int, records: Sequence[LogRecord]) -> None:
        self._path, self._rows = folder / "metrics.csv", [dict(record) for record in records]
        self._columns = list(dict.fromkeys(["iteration", *(name for row in self._rows for name in row)]))
        self._write_all()

    def write(self, iteration: int, values: Mapping[str, float]) -> None:
        row = _finite({"iteration": iteration, **values})
        self._rows.append(row)
        further = [name for name in row if name not in self._columns]
        self._columns += further
        if further:
            self._write_all()
            return
        with open(self._path, "a", encoding="utf-8", newline="") as file:
            file.write(self._text([row]))

    def _write_all(self) -> None:
        head = dict(zip(self._columns, self._columns, strict=True))
        write_atomically(self._path, self._text([head, *self._rows]).encode())

    def _text(self, rows: Sequence[Mapping[str, Any]]) -> str:
        text = io.StringIO()
        csv.DictWriter(text, self._columns, lineterminator="\n").writerows(rows)
        return text.getvalue()


class Wandb(Logger):
    """One run of Weights & Biases in the folder ``wandb`` of the run, offline: nothing is sent; ``wandb sync`` does that.

    A training that goes on writes it anew, with all records so far.

    Raises:
        ValueError: the package is not installed.
    """

    def __init__(self, project: str = "hood", name: str | None = None) -> None:
        if find_spec("wandb") is None:
            raise ValueError(f"loggers: wandb is not installed ({install('wandb')})")
        self._project, self._name = project, name

    def begin(self, folder: Path, iteration: int, records: Sequence[LogRecord]) -> None:
        import wandb

        for old in (folder / "wandb").glob("offline-run-*"):
            shutil.rmtree(old)
        quiet = wandb.Settings(silent=True, console="off", disable_git=True, save_code=False)
        name, config = self._name or folder.name, dict(self.config)
        self._run = wandb.init(
            project=self._project,
            name=name,
            dir=str(folder),
            config=config,
            mode="offline",
            reinit="create_new",
            settings=quiet,
        )
        for record in records:
            known = {name: value for name, value in record.items() if value is not None and name != "iteration"}
            self._run.log(known, step=int(record["iteration"] or 0))

    def write(self, iteration: int, values: Mapping[str, float]) -> None:
        self._run.log(dict(values), step=iteration)

    def picture(self, iteration: int, name: str, image: np.ndarray) -> None:
        import wandb

        self._run.log({name: wandb.Image(image)}, step=iteration)

    def end(self) -> None:
        self._run.finish()


#: Loggers that have a name.
LOGGERS: dict[str, type[Logger]] = {"tensorboard": TensorBoard, "csv": Csv, "wandb": Wandb}


class MetricsLog:
    """Appends to ``metrics.jsonl``; on resume, lines after the resumed iteration are dropped first. Loggers are told the same.

    A disk that refuses a line raises an OSError that names the file; a logger that fails is dropped, and a line says so.

    Args:
        loggers: None: TensorBoard.
    """

    def __init__(self, folder: Path, iteration: int, loggers: Sequence[Logger] | None = None) -> None:
        self._folder, self.path = folder, folder / "metrics.jsonl"
        self._loggers: list[Logger] = [TensorBoard()] if loggers is None else list(loggers)
        self._open(iteration)

    def write(self, iteration: int, values: dict[str, float]) -> None:
        """One record, on disk at once, so that a killed run keeps it; what is not a finite number becomes null."""
        line = (json.dumps(_finite({"iteration": iteration, **values})) + "\n").encode()
        try:
            while line:
                line = line[self._file.write(line) or 0 :]
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error
        self._tell("write", iteration, values)

    def picture(self, iteration: int, name: str, image: np.ndarray) -> None:
        """A picture (H, W, 3) uint8 for loggers that show some."""
        self._tell("picture", iteration, name, image)

    def cut(self, iteration: int) -> None:
        """Drop what was recorded after ``iteration``: training went back there."""
        self._close()
        self._open(iteration)

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._close()

    def _open(self, iteration: int) -> None:
        lines = _lines_up_to(self.path, iteration)
        write_atomically(self.path, "".join(lines).encode())
        self._file = open(self.path, "ab", buffering=0)
        self._tell("begin", self._folder, iteration, [json.loads(line) for line in lines])

    def _close(self) -> None:
        self._file.close()
        self._tell("end")

    def _tell(self, method: str, *values: Any) -> None:
        for logger in tuple(self._loggers):
            try:
                getattr(logger, method)(*values)
            except Exception as error:  # whatever a logger raises: its figures are worth less than the training
                self._loggers.remove(logger)
                more, name = "no" if method == "begin" else "no more", type(logger).__name__
                what = f"{name} events" if isinstance(logger, TensorBoard) else f"figures for the logger {name}"
                reason = " ".join(str(error).split()) or type(error).__name__
                say(f"hood: {more} {what}: {reason}; all numbers are in {self.path}", error=True)


class LogWindow:
    """Means of what was reported since the last record: one update of a few scenes says little, a hard one looks like trouble.

    What is not finite is passed over unless there is nothing else; what is no measurement (``LATEST``) keeps its last value.
    """

    LATEST = ("horizon", "learning_rate", "skipped")

    def __init__(self) -> None:
        self._reports: list[dict[str, float]] = []

    def add(self, report: dict[str, float]) -> None:
        """One more update."""
        self._reports.append(report)

    def close(self) -> dict[str, float]:
        """The record of the window; the next one begins empty."""
        reports, self._reports = self._reports, []
        record = {}
        for name, value in reports[-1].items():
            values = [report[name] for report in reports if math.isfinite(report.get(name, math.nan))]
            record[name] = value if name in self.LATEST or not values else sum(values) / len(values)
        return record

    def state_dict(self) -> list[dict[str, float]]:
        """What a resumed run needs to write the same record."""
        return list(self._reports)

    def load_state_dict(self, state: list[dict[str, float]]) -> None:
        """Back to what :meth:`state_dict` gave."""
        self._reports = list(state)


def _finite(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def _lines_up_to(path: Path, iteration: int) -> list[str]:
    if not path.exists():
        return []
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            if json.loads(line)["iteration"] <= iteration:
                kept.append(line + "\n")
        except (ValueError, KeyError, TypeError):
            continue  # a line cut by a kill
    return kept

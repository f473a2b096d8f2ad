"""Training metrics: one JSON object per line, and TensorBoard events where TensorBoard is installed.

Iterations per second of training alone.

The training loss as one number that can be watched: the potential above what free fall would cost.

Updates that were skipped, since a loss or a gradient was no number: how many, how many in a row, and why.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.assets.files.atomic import write_atomically
from hood.assets.files.said import install, say
from hood.energies.potential import scale
from hood.energies.problem import StepProblem

#: An output whose spread is less is one constant.
CONSTANT = 1e-3


def output_spread(acc: Tensor, free: Tensor) -> Tensor:
    """How much of the accelerations (V, 3) differs between the vertices that are ``free`` (V,): the root of the mean square of
    what deviates from their mean, over that of all, (). 1 where all are zero."""
    rows = free.unsqueeze(1).to(acc)
    mean = (acc * rows).sum(dim=0) / rows.sum().clamp_min(1.0)
    all_of_it = (acc * rows).norm()
    return torch.where(all_of_it > 0, ((acc - mean) * rows).norm() / torch.where(all_of_it > 0, all_of_it, 1.0), 1.0)


class ConstantOutput:
    """Says once that a network's output has become a constant: a gradient that reaches one cannot bring the network back."""

    def __init__(self, learning_rate: float) -> None:
        self._rate, self._told = learning_rate, False

    def look(self, iteration: int, spread: float) -> None:
        """With the mean of :func:`output_spread` since the last look."""
        if spread >= CONSTANT or self._told:
            return
        self._told = True
        say(
            f"hood: iteration {iteration}: the network gives every vertex the same acceleration, whatever it is shown. The "
            "units of its decoder are dead, and nothing is learned any more; begin again with a lower trainer.learning_rate "
            f"than {self._rate:g}",
            error=True,
        )


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


def relative_loss(problem: StepProblem, energies: Mapping[str, Tensor], acc: Tensor, longest: float | None = None) -> Tensor:
    """(Φ − Φ_fall) / e0 of every scene (B,): how far the step is above free fall, in units of e0.

    Φ alone cannot be watched: gravity's zero is arbitrary, so Φ is as often negative as positive. With Φ_fall, inertia plus
    gravity of the acceleration g, the two become ½ Σ m dt² ‖a − g‖² and no term can be negative; garments of any mass and steps
    of any length are comparable. Cloth at rest has 1, its weight held up, plus what it is stretched and bent. ``longest``: of
    :func:`hood.energies.potential.scale`.
    """
    dt = problem.vertex_dt.squeeze(1)
    apart = (acc - problem.gravity.to(acc)).square().sum(dim=1)
    fall = problem.sum_vertices(0.5 * problem.cloth.mass * dt * dt * apart)
    rest = [value for name, value in energies.items() if name not in ("inertia", "gravity")]
    return sum(rest, start=fall) / scale(problem, longest)


class MetricsLog:
    """Appends to ``metrics.jsonl``; on resume, lines after the resumed iteration are dropped first.

    A disk that refuses a line raises an OSError that names the file; one that refuses TensorBoard's events ends those.
    """

    def __init__(self, folder: Path, iteration: int) -> None:
        self._folder = folder
        self.path = folder / "metrics.jsonl"
        self._open(iteration)
        if self._board is None:
            say(f"hood: no TensorBoard events: {_missing()}; all numbers are in {self.path}", error=True)

    def write(self, iteration: int, values: dict[str, float]) -> None:
        """One record, on disk at once, so that a killed run keeps it; what is not a finite number becomes null."""
        record = {name: value if math.isfinite(value) else None for name, value in values.items()}
        line = (json.dumps({"iteration": iteration, **record}) + "\n").encode()
        try:
            while line:
                line = line[self._file.write(line) or 0 :]
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error
        for name, value in values.items():
            self._to_board("add_scalar", name, value, iteration)

    def picture(self, iteration: int, name: str, image: np.ndarray) -> None:
        """A picture (H, W, 3) uint8 for TensorBoard."""
        self._to_board("add_image", name, image, iteration, dataformats="HWC")

    def cut(self, iteration: int) -> None:
        """Drop what was recorded after ``iteration``: training went back there."""
        self._close()
        self._open(iteration)

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._close()

    def _open(self, iteration: int) -> None:
        write_atomically(self.path, "".join(_lines_up_to(self.path, iteration)).encode())
        self._file = open(self.path, "ab", buffering=0)
        self._board = _tensorboard(self._folder, iteration)

    def _close(self) -> None:
        self._file.close()
        self._to_board("close")

    def _to_board(self, method: str, *values: Any, **options: Any) -> None:
        if self._board is None:
            return
        try:
            getattr(self._board, method)(*values, **options)
        except (OSError, ImportError) as error:
            self._board = None
            say(f"hood: no more TensorBoard events: {error}", error=True)


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


def _missing() -> str:
    """Why there are no events, with the way out."""
    try:
        import tensorboard  # noqa: F401
    except ImportError:
        return f"it is not installed ({install('tensorboard')})"
    return "torch cannot use the one that is installed"


def _tensorboard(folder: Path, iteration: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / "tensorboard"), purge_step=iteration + 1 if iteration else None)


class Skipped:
    """Counts the updates of a training; what it says is about the whole run, what was rolled back included.

    Attributes:
        count: updates that were skipped.
        in_row: of these, those since the last one that was made.
        made: updates that were made, and not rolled back.
        reason: why the last one was skipped; empty where another process saw it.
    """

    def __init__(self) -> None:
        self.count, self.in_row, self.made = 0, 0, 0
        self.reason = ""

    def skip(self, iteration: int, energies: Mapping[str, float], norm: float) -> None:
        """An update that is not made, with the means of its energies and the length of its gradient."""
        self.count, self.in_row = self.count + 1, self.in_row + 1
        lost = [name for name, value in energies.items() if not math.isfinite(value)]
        if lost:
            self.reason = f"iteration {iteration}: energy {lost[0]} is {energies[lost[0]]}"
        else:
            self.reason = "" if math.isfinite(norm) else f"iteration {iteration}: the length of the gradient is {norm}"

    def make(self) -> None:
        """An update that is made."""
        self.made, self.in_row = self.made + 1, 0

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run goes on with."""
        return {"skipped": self.count, "skipped_in_row": self.in_row, "made": self.made, "skip_reason": self.reason}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Back to what :meth:`state_dict` gave; older checkpoints do not say how many were made."""
        self.count, self.in_row = int(state["skipped"]), int(state["skipped_in_row"])
        self.made = made_behind(state)
        self.reason = str(state.get("skip_reason", ""))


def made_behind(state: Mapping[str, Any]) -> int:
    """Updates that were made behind a checkpoint."""
    return int(state.get("made", state["iteration"]))


def told(reasons: list[str]) -> str:
    """The reason of the first process that has one, in brackets."""
    reason = next((reason for reason in reasons if reason), "")
    return f" ({reason})" if reason else ""

"""Training metrics: one JSON object per line, and TensorBoard events where TensorBoard is installed."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.assets.files.extras import install


class MetricsLog:
    """Appends to ``metrics.jsonl``; on resume, lines after the resumed iteration are dropped first.

    A disk that refuses a line raises an OSError that names the file; one that refuses TensorBoard's events ends those.
    """

    def __init__(self, folder: Path, iteration: int) -> None:
        self._folder = folder
        self.path = folder / "metrics.jsonl"
        self._open(iteration)
        if self._board is None:
            print(f"hood: no TensorBoard events: {_missing()}; all numbers are in {self.path}", file=sys.stderr)

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
            print(f"hood: no more TensorBoard events: {error}", file=sys.stderr)


class Window:
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

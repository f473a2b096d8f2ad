"""Training metrics: one JSON object per line, and TensorBoard events where TensorBoard is installed."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Any


class MetricsLog:
    """Appends to ``metrics.jsonl``; on resume, lines after the resumed iteration are dropped first."""

    def __init__(self, folder: Path, iteration: int) -> None:
        path = folder / "metrics.jsonl"
        kept = _lines_up_to(path, iteration)
        path.write_text("".join(kept), encoding="utf-8")
        self._file = open(path, "a", encoding="utf-8")
        self._board = _tensorboard(folder, iteration)

    def write(self, iteration: int, values: dict[str, float]) -> None:
        """One record; flushed at once, so that a killed run keeps it."""
        self._file.write(json.dumps({"iteration": iteration, **values}) + "\n")
        self._file.flush()
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(name, value, iteration)

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._file.close()
        if self._board is not None:
            self._board.close()


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


def _tensorboard(folder: Path, iteration: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / "tensorboard"), purge_step=iteration + 1 if iteration else None)

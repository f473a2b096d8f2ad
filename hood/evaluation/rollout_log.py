"""A log of the rollouts of an evaluation, one line each, so that an interrupted evaluation goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

from hood.evaluation.table import Measured


class Unit(NamedTuple):
    """One rollout of an evaluation."""

    model: int  # place in the list of candidates
    garment: str
    motion: str
    shape: int = 0  # place in the list of body shapes


class RolloutLog:
    """Lines of ``rollouts.RANK.jsonl`` in ``folder``: one process appends to its own file, every process reads all of them."""

    def __init__(self, folder: Path, rank: int = 0) -> None:
        self.folder = folder
        self.path = folder / f"rollouts.{rank}.jsonl"

    def read(self, digests: Sequence[str] | None) -> dict[Unit, Measured]:
        """What was written for candidates whose weights have these ``digests``, the latest of every rollout; None for whatever
        weights they had. Lines cut by a kill are passed over."""
        found = {}
        for path in sorted(self.folder.glob("rollouts.*.jsonl")):
            for line in path.read_text(encoding="utf-8").splitlines():
                try:
                    entry = json.loads(line)
                    unit = Unit(*entry["unit"])
                    if digests is None or digests[unit.model] == entry["weights"]:
                        found[unit] = Measured(**entry["measured"])
                except (ValueError, KeyError, TypeError, IndexError):
                    continue
        return found

    def write(self, unit: Unit, digest: str, measured: Measured) -> None:
        """Add a rollout.

        Raises:
            OSError: the disk refuses; the error names the file.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        entry = {"unit": unit, "weights": digest, "measured": asdict(measured)}
        try:
            with open(self.path, "ab", buffering=0) as file:
                # A line of its own even after one that was cut.
                line = memoryview(f"\n{json.dumps(entry)}\n".encode())
                while line:
                    line = line[file.write(line) or 0 :]
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error

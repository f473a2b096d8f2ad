"""A garment on its way from a file to a body, and the record of what was done to it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hood.assets.garment.garment import Garment


@dataclass
class Fitting:
    """A garment on its way from a file to a body, with a record of every change."""

    garment: Garment
    file: Garment  # as it was read
    vertex_map: np.ndarray  # (V of the file,) present number of each vertex of the file; -1: removed
    changes: list[Change] = field(default_factory=list)
    stitches: np.ndarray | None = None  # (S, 2) vertices of the file that its lines join

    def note(self, what: str, count: int, text: str, **details: Any) -> None:
        """Record a change of ``count`` things; nothing is recorded for none."""
        if count:
            self.changes.append(Change(what, count, text, details))

    def in_file(self, vertices: np.ndarray) -> np.ndarray:
        """Numbers in the file, of any shape, of vertices by their present numbers: of several that were joined the first."""
        first = np.full(len(self.garment.rest_pos), -1, dtype=np.int64)
        rows = np.flatnonzero(self.vertex_map >= 0)[::-1]
        first[self.vertex_map[rows]] = rows
        return np.asarray(first[vertices])

    def at_present(self, vertices: np.ndarray) -> np.ndarray:
        """(n,) present numbers of vertices of the file, without those that are gone."""
        present = self.vertex_map[vertices.reshape(-1)]
        return np.asarray(present[present >= 0])

    def guess(self, what: str, count: int, text: str, fix: str, **details: Any) -> None:
        """Record a change that rests on what the file seems to hold; ``fix`` is what says otherwise."""
        if count:
            self.changes.append(Change(what, count, text, details, fix))


@dataclass(frozen=True)
class Change:
    """One change: its name for programs, how many things it touched, and a sentence."""

    what: str
    count: int
    text: str
    details: dict[str, Any]
    fix: str = ""  # of a guess: what to do where it is wrong


def start_fitting(garment: Garment, stitches: np.ndarray | None = None) -> Fitting:
    """A fitting of a garment as it was read, with the pairs (S, 2) of vertices that lines of its file join."""
    return Fitting(garment, garment, np.arange(len(garment.rest_pos)), stitches=stitches)

"""What a rollout file knows of all simulated frames where it stores others: their metrics, and whether they are finite.

Two frame rates: that of the simulation, and that of the frames that are given.

Rows of a table in an open HDF5 file, written one by one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import h5py
import numpy as np

from hood.assets.files.guarded import own_dataset, own_group


@dataclass(frozen=True)
class OutputRate:
    """How many frames per second are given of how many that are simulated.

    Args:
        fps: [1/s] of the frames that are given.
        simulated_fps: [1/s] of those that are simulated.
    """

    fps: float
    simulated_fps: float

    @property
    def stride(self) -> Fraction:
        """Simulated frames from one that is given to the next; exact for the rates as they are written."""
        return Fraction(repr(float(self.simulated_fps))) / Fraction(repr(float(self.fps)))

    @property
    def whole(self) -> bool:
        """Whether every frame that is given is a simulated one."""
        return self.stride.denominator == 1

    def count(self, num_simulated: int) -> int:
        """How many frames lie within so many simulated ones, the first included."""
        return int((num_simulated - 1) // self.stride) + 1

    def place(self, index: int) -> tuple[int, Fraction]:
        """The simulated frame at or before the given frame ``index``, and the share of the step from there."""
        before = int(index * self.stride // 1)
        return before, index * self.stride - before


class RowWriter:
    """Writes rows of a table: what h5py does for ``table[row] = value``, with the table, its type and its selection kept.

    A rollout writes some forty tables a frame. To look each up and to make its selection again takes longer than to write it.

    Args:
        table: (T, …) of real or whole numbers, in a file that is open for writing.
    """

    def __init__(self, table: h5py.Dataset) -> None:
        self._table, self._kind, self._shape = table.id, table.dtype, table.shape[1:]
        self._selected = table.id.get_space()
        self._one = h5py.h5s.create_simple((1, *self._shape))

    def write(self, row: int, value: Any) -> None:
        """Write the row ``row`` from a number, or numbers of the shape of a row.

        Raises:
            ValueError: numbers of another shape.
            OSError: the file system refuses.
        """
        numbers = np.ascontiguousarray(value, self._kind).reshape(self._shape)
        self._selected.select_hyperslab((row, *(0 for _ in self._shape)), (1, *self._shape))
        self._table.write(self._one, self._selected, numbers)


_METRICS, _FINITE, _VERTICES, _POS = "steps/metrics", "steps/finite", "steps/vertices", "steps/pos"


@dataclass(frozen=True)
class Steps:
    """Simulated frames 0, 1, … of a rollout that stores frames at a rate of its own."""

    rate: OutputRate  # of the stored frames
    finite: np.ndarray  # (S,) bool, whether all positions are
    metrics: dict[str, np.ndarray]  # (S,) by name
    vertices: np.ndarray  # (K,) those whose positions are kept: what events fasten and hold
    pos: np.ndarray  # (S, K, 3) m, world

    @property
    def time(self) -> np.ndarray:
        """(S,) s."""
        return np.arange(len(self.finite)) / self.rate.simulated_fps

    def pos_of(self, vertices: np.ndarray) -> np.ndarray:
        """(S, N, 3) m of vertices (N,) that are among those kept."""
        return self.pos[:, np.searchsorted(self.vertices, vertices)]


@dataclass(frozen=True)
class StepPlan:
    """Simulated frames of a rollout that stores others: ``count`` at most, of whose positions those of ``watched`` are kept."""

    rate: OutputRate
    count: int
    watched: Sequence[int] = ()  # vertices in ascending order


class StepTable:
    """The part of a rollout file, open for writing, that holds :class:`Steps`.

    Datasets, a row a simulated frame: ``steps/metrics/NAME (S,)``, ``steps/finite (S,)`` (1, 0, or -1 before it is simulated)
    and ``steps/pos (S,K,3)`` of ``steps/vertices (K,)``; attributes ``output_fps``, ``simulated_fps``, and of
    ``steps_planned`` frames ``num_steps`` done. A frame is counted after its values are written.
    """

    def __init__(self, file: h5py.File, plan: StepPlan, metric_names: Sequence[str]) -> None:
        self._file, self.done, count, rate = file, 0, plan.count, plan.rate
        self._vertices = np.asarray(plan.watched, dtype=np.int64)
        file.create_group(_METRICS)
        for name in metric_names:
            file.create_dataset(f"{_METRICS}/{name}", (count,), dtype=np.float64, fillvalue=np.nan)
        file.create_dataset(_FINITE, (count,), dtype=np.int8, fillvalue=-1)
        file[_VERTICES] = self._vertices
        file.create_dataset(_POS, (count, len(self._vertices), 3), dtype=np.float64, fillvalue=np.nan)
        own = {"output_fps": rate.fps, "simulated_fps": rate.simulated_fps, "num_steps": 0, "steps_planned": count}
        file.attrs.update(own)
        self._rows = {name: RowWriter(file[name]) for name in step_paths(file)}

    def begin_after(self, done: int) -> None:
        """Go on after so many rows, which somebody has copied."""
        self.done = done
        self._file.attrs.modify("num_steps", done)

    def append(self, cloth_pos: np.ndarray, metrics: Mapping[str, float]) -> None:
        """Write one simulated frame: positions (V, 3) [m], world, and its metrics."""
        for name, value in metrics.items():
            self._rows[f"{_METRICS}/{name}"].write(self.done, value)
        if len(self._vertices):
            self._rows[_POS].write(self.done, cloth_pos[self._vertices])
        self._rows[_FINITE].write(self.done, np.isfinite(cloth_pos).all())
        self._file.flush()
        self.done += 1
        self._file.attrs.modify("num_steps", self.done)
        self._file.flush()


def step_paths(file: h5py.File) -> list[str]:
    """The tables of a rollout file with a row a simulated frame; none where every one of them is stored."""
    if own_group(file, "steps") is None:
        return []
    return [_FINITE, _POS, *(f"{_METRICS}/{name}" for name in own_group(file, _METRICS) or ())]


def still_step_paths(file: h5py.File) -> list[str]:
    """The tables beside them that are the same throughout."""
    return [] if own_group(file, "steps") is None else [_VERTICES]


def read_steps(file: h5py.File, num_vertices: int) -> Steps | None:
    """What the file says of simulated frames; None where every one of them is stored.

    Raises:
        ValueError: tables that do not belong together.
    """
    paths = step_paths(file)
    if not paths:
        return None
    rate = OutputRate(float(file.attrs["output_fps"]), float(file.attrs["simulated_fps"]))
    if not (0 < rate.fps < np.inf and 0 < rate.simulated_fps < np.inf):
        raise ValueError(f"output_fps is {rate.fps:g} and simulated_fps {rate.simulated_fps:g}; both are above 0")
    done, vertices = int(file.attrs["num_steps"]), own_dataset(file, _VERTICES)[:]
    if vertices.ndim != 1 or (np.diff(vertices, prepend=-1, append=num_vertices) <= 0).any():
        raise ValueError(f"{_VERTICES} does not name vertices of the cloth in ascending order")
    rows = len(own_dataset(file, _FINITE))
    for name in paths:
        shape = own_dataset(file, name).shape
        if shape != (rows, *((len(vertices), 3) if name == _POS else ())) or not 0 <= done <= rows:
            raise ValueError(f"{name} has the shape {shape}, which does not fit {done} simulated frames")
    metrics = {name.removeprefix(f"{_METRICS}/"): file[name][:done] for name in paths if name.startswith(_METRICS)}
    return Steps(rate, file[_FINITE][:done] == 1, metrics, vertices, file[_POS][:done])

"""What a rollout file knows of all simulated frames where it stores others: their metrics, and whether they are finite."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import h5py
import numpy as np

from hood.assets.files.h5_links import own_dataset, own_group
from hood.dynamics.output_rate import OutputRate
from hood.dynamics.row_writer import RowWriter

_METRICS, _FINITE, _VERTICES, _POS = "steps/metrics", "steps/finite", "steps/vertices", "steps/pos"


@dataclass(frozen=True)
class Steps:
    """Simulated frames 0, 1, … of a rollout that stores frames at a rate of its own."""

    rate: OutputRate
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

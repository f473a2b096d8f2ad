"""What the settings of a chart reached: read from the folders of their evaluations, with confidence intervals."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hood.evaluation.bootstrap import Estimate, estimate_interval, resample_rows
from hood.evaluation.files import RolloutLog
from hood.evaluation.gap import AGREEMENT
from hood.evaluation.table import NEWTON, MeasuredRollout
from hood.studies.tradeoff.grid import Point

#: Parts of a frame's time, and which entries of a frame belong to each.
FRAME_PARTS = {
    "search": ("ms_search",),
    "features": ("ms_features",),
    "network": ("ms_network",),
    "refine": ("ms_refine", "ms_solver"),
    "rest": ("ms_rest", "ms_guess"),
}
#: A process that had its processor for less than this share of the time was disturbed: reading files takes some as well.
UNDISTURBED = 0.85
#: Minima further apart than this share of γ make it doubtful.
_DOUBT = 0.1
#: Strain beyond this multiple of the solver's counts as too much.
OVERSTRETCHED = 2.0


@dataclass(frozen=True)
class Reached:
    """Cost and accuracy of one point, on the states that it reaches itself.

    ``ms`` and ``gap`` are medians, ``ms_p95`` and ``gap_p95`` 95th percentiles, over frames and over the states looked at;
    ``rg`` and ``strain_p99`` are medians over frames. The draws are those of the
    bootstrap, alike for points that were measured on the same rollouts.
    """

    point: Point
    vertices: int
    ms: Estimate
    ms_p95: Estimate
    gap: Estimate
    gap_p95: Estimate
    rg: float
    strain_p99: float
    penetration: float  # mean share of vertices deeper than 2 mm
    depth: float  # m, mean over frames of the deepest vertex
    strains: tuple[float, ...]  # strain_p99 of every rollout, median over its frames; infinite after a breakdown
    penetrations: tuple[float, ...]  # share of vertices deeper than 2 mm of every rollout, mean over its frames; likewise
    parts: Mapping[str, float]  # ms, mean over frames, of PARTS
    rollouts: int
    frames: int
    states: int
    unconverged: int  # states whose reference missed its accuracy: their gaps are lower bounds
    disagreeing: int  # states where minimisations ended in different minima
    doubtful: int  # those of them where that changes γ by more than a tenth
    failures: int  # rollouts that became non-finite
    unsolved: float  # share of the converged solver's steps that missed their accuracy; 0 for all others
    record: Mapping[str, Any] = field(default_factory=dict)  # what was written down about the run
    ms_draws: np.ndarray = field(default_factory=lambda: np.empty(0), repr=False, compare=False)
    gap_draws: np.ndarray = field(default_factory=lambda: np.empty(0), repr=False, compare=False)

    @property
    def label(self) -> str:
        return self.point.label

    @property
    def charted(self) -> bool:
        """Whether it has a time and a gap."""
        return math.isfinite(self.ms.value) and math.isfinite(self.gap.value)

    @property
    def disturbed(self) -> bool:
        """Whether other work took the processor away while it was measured on a CPU, so that its times are too long."""
        share = self.record.get("cpu_share")
        return share is not None and share < UNDISTURBED and str(self.record.get("device", "")).startswith("CPU")

    def row(self) -> dict[str, Any]:
        """Its line of the table: plain values, None where nothing was measured."""
        point = self.point
        entries: dict[str, Any] = {
            "size": point.size, "vertices": self.vertices, "setting": self.label, "model": point.model,
            "precision": point.precision, "method": point.method, "refine": point.refine,
        }  # fmt: skip
        for name in ("ms", "ms_p95", "gap", "gap_p95"):
            value: Estimate = getattr(self, name)
            entries |= {name: value.value, f"{name}_low": value.low, f"{name}_high": value.high}
        entries |= {"rg": self.rg, "strain_p99": self.strain_p99, "penetration": self.penetration, "depth": self.depth}
        entries |= {f"ms_{name}": value for name, value in self.parts.items()}
        for name in ("rollouts", "frames", "states", "unconverged", "disagreeing", "doubtful", "failures", "unsolved"):
            entries[name] = getattr(self, name)
        entries |= {"device": self.record.get("device"), "cpu_share": self.record.get("cpu_share"), "command": point.command}
        return {key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in entries.items()}


def read_reached(point: Point, folder: Path, vertices: int, record: Mapping[str, Any] | None = None) -> Reached:
    """What the evaluation in ``folder`` gave.

    Raises:
        ValueError: no rollout is written down there, or no frame of any is finite.
    """
    rollouts = [measured for _, measured in sorted(RolloutLog(folder).read(None).items())]
    if not any(measured.frames for measured in rollouts):
        fault = "no rollout was written down" if not rollouts else "every rollout was non-finite before a frame could be timed"
        raise ValueError(f"{folder}: {fault}")
    return summarise_points(point, rollouts, vertices, record or {})


def summarise_points(point: Point, rollouts: Sequence[MeasuredRollout], vertices: int, record: Mapping[str, Any]) -> Reached:
    """The rollouts of a point in numbers; those on a standing body, for drift alone, are left out."""
    rollouts = [measured for measured in rollouts if measured.frames or measured.failures or measured.gaps]
    frames = [frame for measured in rollouts for frame in measured.frames]
    gaps = [item for measured in rollouts for item in measured.gaps]
    times = [[frame["ms_total"] for frame in measured.frames] for measured in rollouts]
    gammas = [[item["gamma"] for item in measured.gaps] for measured in rollouts]
    ms_draws, gap_draws = resample_rows(times, 0.5), resample_rows(gammas, 0.5)
    return Reached(
        point,
        vertices,
        estimate_interval(times, 0.5, ms_draws),
        estimate_interval(times, 0.95),
        estimate_interval(gammas, 0.5, gap_draws),
        estimate_interval(gammas, 0.95),
        float(np.median([frame["relative_gradient"] for frame in frames])),
        float(np.median([frame["strain_p99"] for frame in frames])),
        float(np.mean([frame.get("penetration_share", 0.0) for frame in frames])),
        float(np.mean([frame.get("penetration_depth", 0.0) for frame in frames])),
        tuple(_unless_broken(one, "strain_p99", np.median) for one in rollouts),
        tuple(_unless_broken(one, "penetration_share", np.mean) for one in rollouts),
        {name: float(np.mean([sum(f.get(key, 0.0) for key in keys) for f in frames])) for name, keys in FRAME_PARTS.items()},
        rollouts=len(rollouts),
        frames=len(frames),
        states=len(gaps),
        unconverged=sum(item["converged"] == 0.0 for item in gaps),
        disagreeing=sum(item["spread"] > AGREEMENT for item in gaps),
        doubtful=sum(item["spread"] > max(AGREEMENT, _DOUBT * abs(item["gamma"])) for item in gaps),
        failures=sum(bool(measured.failures) for measured in rollouts),
        unsolved=float(np.mean([1.0 - frame.get("solver_converged", 1.0) for frame in frames])),
        record=record,
        ms_draws=ms_draws,
        gap_draws=gap_draws,
    )


def _unless_broken(measured: MeasuredRollout, key: str, statistic: Callable[[list[float]], Any]) -> float:
    """Of a rollout's frames; infinite where one of them is not finite."""
    if measured.failures or not measured.frames:
        return float("inf")
    value = float(statistic([frame.get(key, 0.0) for frame in measured.frames]))
    return value if math.isfinite(value) else float("inf")


def overstretched(reached: Iterable[Reached]) -> set[Point]:
    """Points whose p99 strain exceeds :data:`OVERSTRETCHED` times that of the solver at the same size, and points with rollouts
    that became non-finite. Where the solver was not measured, its strain is no bound."""
    reached = list(reached)
    bounds = {item.point.size: OVERSTRETCHED * item.strain_p99 for item in reached if item.point.model == NEWTON}
    return {item.point for item in reached if item.failures or item.strain_p99 > bounds.get(item.point.size, float("inf"))}


def refinement_tables(reached: Sequence[Reached]) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """By series, the table that ``refine`` of a rollout reads: what so many iterations cost and reach at each size.

    Without iterations all methods are the same, so each of them has that row. Finite entries only.
    """
    tables: dict[str, dict[str, list[dict[str, Any]]]] = {}
    methods = list(dict.fromkeys(item.point.method for item in reached))
    for item in reached:
        point = item.point
        if point.model == NEWTON or not item.charted:
            continue
        rows = tables.setdefault(f"{point.name}_{point.precision}", {"rows": []})["rows"]
        for method in [point.method] if point.refine else methods:
            rows.append({
                "method": method, "vertices": item.vertices, "refine": point.refine, "ms": item.ms.value,
                "gap": item.gap.value, "gap_p95": item.gap_p95.value, "strain_p99": item.strain_p99,
            })  # fmt: skip
    return tables


def read_measured(folder: Path, name: str = "point.json") -> dict[str, Any]:
    """What was written down about a point, by default when it was done; empty where nothing was."""
    try:
        record = json.loads((folder / name).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}

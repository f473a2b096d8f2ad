"""The stability map: what a rollout in one of its cells comes to.

What is measured of a rollout of the stability map, besides its class.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hood.limits import STRAIN_ALARM, STRAIN_RATIO
from hood.studies.envelope.cells import Cell

SOUND, DEGRADED, FAILED, SILENT, REFUSED = "sound", "degraded and said", "failed and said", "silent", "refused"
#: From best to worst; a refusal of bad input counts with none of them.
CLASSES = (SOUND, DEGRADED, FAILED, SILENT, REFUSED)

#: What differs between two sentences that say the same: names, numbers, and how many of these are listed.
_NAME, _NUMBER = re.compile(r"'[^']*'"), re.compile(r"[-+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?%?")
_LISTED = re.compile(r"frames? #(?:(?:, | and |–)#)*(?: more)?")
#: Begins what a guard says of a rollout.
GUARD = "guard"


@dataclass(frozen=True)
class Criteria:
    """What a reference can tell beyond the rule (:mod:`hood.rollouts.verdict.rule`): the solver's rollout of the same scene,
    and a body at rest. A single rollout has none, and light or soft cloth may stretch far beyond ``strain`` as it should."""

    strain: float = STRAIN_ALARM.value  # 99th percentile in the worst frame, or
    strain_ratio: float = STRAIN_RATIO.value  # so many times that of the solver, whichever is more
    network_strain: float = 0.05  # difference of a network's to the solver's
    climb: float = 0.005  # of the strain per 100 frames at rest


@dataclass(frozen=True)
class JudgedRun:
    """How a rollout of a cell ended."""

    exit_code: int
    error: str  # the line that it ended with; empty without
    warnings: tuple[str, ...] = ()
    unsound: tuple[str, ...] = ()  # reasons of the verdict, by the rule
    metrics: Mapping[str, np.ndarray] | None = None  # (T,) each, and "finite"; None where there is no file
    late: bool = False  # the map's limit of time ended it: whoever waits sees that it is not done


@dataclass(frozen=True)
class Judged:
    """The class of a run, in sentences why it is no better, and what was said of it."""

    kind: str
    reasons: tuple[str, ...]
    said: tuple[str, ...] = ()


def form(sentence: str) -> str:
    """The sentence without its numbers and quoted names: two of one form say the same."""
    return _LISTED.sub("frame #", _NUMBER.sub("#", _NAME.sub("''", sentence)))


def what_was_said(run: JudgedRun, usual: Collection[str]) -> tuple[str, ...]:
    """What a run said of itself: why it is unsound, the error that it ended with, and warnings whose :func:`form` is none of
    the ``usual`` ones, which its method prints where everything is ordinary."""
    error = (run.error,) if run.exit_code and run.error else ()
    return (*run.unsound, *error, *(text for text in run.warnings if form(text) not in usual))


def usual_of(warnings: Sequence[str], wanting: bool) -> set[str]:
    """Forms of the warnings that a method prints where everything is ordinary, from those of the nominal rollout. Where that is
    ``wanting`` itself, what the guard found in it is none of them: it was measured there, and it was right."""
    return {form(text) for text in warnings if not (wanting and text.startswith(GUARD))}


def judge(
    cell: Cell,
    run: JudgedRun,
    solver: Mapping[str, np.ndarray] | None,
    network: bool,
    criteria: Criteria,
    usual: Collection[str] = (),
) -> Judged:
    """The class of a run.

    Args:
        solver: metrics of what its strain is held against: of the solver in the same cell, for the solver itself those of a
            quarter of the time step; None where there are none.
        network: whether a network alone took the steps.
        usual: forms of the warnings that the method prints in the nominal cell.
    """
    told = what_was_said(run, usual)
    if run.exit_code == 2 and run.error:
        refused = bool(cell.bad_input) and cell.bad_input in run.error
        return Judged(REFUSED if refused else FAILED, (run.error,), told)
    if run.late:
        return Judged(FAILED, (run.error,), told)
    if run.exit_code not in (0, 3) or run.metrics is None:
        return Judged(SILENT, (f"ended with exit code {run.exit_code} and no sentence",), told)
    finite = run.metrics["finite"]
    if not finite.all():
        reason = f"not finite from frame {int(np.argmin(finite))} on"
        return Judged(FAILED if told else SILENT, (reason,), told)
    reasons = run.unsound or tuple(_shortcomings(cell, run.metrics, solver, network, criteria))
    if cell.bad_input:
        reasons = (*reasons, "bad input was taken")
    if not reasons:
        return Judged(SOUND, (), told)
    return Judged(DEGRADED if told else SILENT, reasons, told)


def _shortcomings(
    cell: Cell, metrics: Mapping[str, np.ndarray], solver: Mapping[str, np.ndarray] | None, network: bool, criteria: Criteria
) -> Iterator[str]:
    strain, reference = worst(metrics, "strain_p99"), None if solver is None else worst(solver, "strain_p99")
    limit = max(criteria.strain, criteria.strain_ratio * (reference or 0.0))
    if not strain <= limit:
        yield f"strain p99 {strain:.0%} in the worst frame, beyond {limit:.0%}"
    if network and reference is not None and abs(strain - reference) > criteria.network_strain:
        yield f"strain p99 {strain:.0%}, the solver's is {reference:.0%}"
    if cell.motion == "rest":
        climb = 100.0 * slope_at_rest(metrics["strain_p99"])
        if climb > criteria.climb:
            yield f"strain climbs by {100 * climb:.1f} points per 100 frames at rest"


def worst(metrics: Mapping[str, np.ndarray], key: str) -> float:
    """The largest finite entry; 0 where nothing was measured."""
    values = metrics.get(key, np.empty(0))
    values = values[np.isfinite(values)]
    return float(values.max()) if len(values) else 0.0


def slope_at_rest(values: np.ndarray) -> float:
    """Slope of ``values`` (T,) per frame in the second half; the first may settle."""
    half = values[len(values) // 2 :]
    half = half[np.isfinite(half)]
    return float(np.polyfit(np.arange(len(half)), half, 1)[0]) if len(half) > 2 else 0.0


def shares(kinds: Sequence[str]) -> dict[str, float]:
    """Shares of the classes among runs; refusals of bad input, right as they are, are left out."""
    counted = [kind for kind in kinds if kind != REFUSED]
    return {kind: counted.count(kind) / max(len(counted), 1) for kind in CLASSES if kind != REFUSED}


def judged_table(rows: Sequence[Mapping[str, Any]], models: Sequence[str]) -> str:
    """Factor by method: how many cells are sound, and how many are worse."""
    lines = [f"{'':24}" + "".join(f"{model:>22}" for model in models)]
    for factor in dict.fromkeys(row["factor"] for row in rows):
        texts = []
        for model in models:
            kinds = [row["class"] for row in rows if row["factor"] == factor and row["model"] == model]
            worse = [f"{kinds.count(kind)} {kind.split()[0]}" for kind in CLASSES[1:] if kind in kinds]
            texts.append(", ".join([f"{kinds.count(SOUND)}/{len(kinds)}", *worse]) if kinds else "")
        lines.append(f"{factor:24}" + "".join(f"{text:>22}" for text in texts))
    return "\n".join(lines)


#: Columns of the map's tables, in their order.
FIGURES = (
    "frames", "strain_p99", "strain_p99_median", "strain_max", "cut_face_share", "penetration_depth_m", "self_crossings",
    "garment_crossings", "rg_median", "rg_p95", "converged", "iterations", "ms_per_frame", "energy_slope", "moved_at_rest_mm",
    "difference_mm",
)  # fmt: skip


def figures(
    metrics: Mapping[str, np.ndarray], pos: np.ndarray, at_rest: bool, reference: np.ndarray | None = None
) -> dict[str, Any]:
    """The figures of a rollout by the names of :data:`FIGURES`; None for what was not measured.

    ``strain_p99`` to ``garment_crossings`` are of the worst frame but for the median; ``rg`` is the relative gradient, of
    refined steps the one that refinement left; ``converged`` a share of the solver's steps, ``iterations`` and ``ms_per_frame``
    medians. Where the body stands still, ``energy_slope`` is the change of stretching and bending energy per 100 frames in the
    second half, as a share of its mean there, and ``moved_at_rest_mm`` the way that the cloth's centre went in that half.

    Args:
        metrics: (T,) each.
        pos: (T, V, 3) m, of the cloth.
        reference: (T, V, 3) m, of the solver at the same times, or None.
    """
    gradient = metrics.get("refine_rg", metrics.get("relative_gradient"))
    iterations = metrics.get("solver_iterations", metrics.get("refine_iterations"))
    median: Callable[[np.ndarray], Any] = np.median
    return {
        "frames": len(pos),
        "strain_p99": _worst(metrics, "strain_p99"),
        "strain_p99_median": _of(median, metrics.get("strain_p99")),
        "strain_max": _worst(metrics, "strain_max"),
        "cut_face_share": _worst(metrics, "cut_face_share"),
        "penetration_depth_m": _worst(metrics, "penetration_depth"),
        "self_crossings": _worst(metrics, "self_crossings"),
        "garment_crossings": _worst(metrics, "garment_crossings"),
        "rg_median": _of(median, gradient),
        "rg_p95": _of(lambda values: np.quantile(values, 0.95), gradient),
        "converged": _of(np.mean, metrics.get("solver_converged")),
        "iterations": _of(median, iterations),
        "ms_per_frame": _of(median, metrics.get("ms_total")),
        "energy_slope": _energy_slope(metrics) if at_rest else None,
        "moved_at_rest_mm": _moved(pos) if at_rest else None,
        "difference_mm": None if reference is None else _difference(pos, reference),
    }


def at_same_times(reference: np.ndarray, reference_dt: float, dt: float) -> np.ndarray:
    """Frames of ``reference`` (T', V, 3) at multiples of ``dt``, a multiple of ``reference_dt``."""
    return reference[:: max(round(dt / reference_dt), 1)]


def _of(function: Callable[[np.ndarray], Any], values: np.ndarray | None) -> float | None:
    """Of the finite entries."""
    if values is None or not np.isfinite(values).any():
        return None
    return float(function(values[np.isfinite(values)]))


def _worst(metrics: Mapping[str, np.ndarray], key: str) -> float | None:
    values = metrics.get(key)
    return worst(metrics, key) if values is not None and np.isfinite(values).any() else None


def _energy_slope(metrics: Mapping[str, np.ndarray]) -> float | None:
    stored = [metrics.get(f"energy_{name}") for name in ("stretching", "bending")]
    if any(values is None for values in stored):
        return None
    energy = np.sum(np.array(stored, dtype=np.float64), axis=0)
    half = energy[len(energy) // 2 :]
    mean = float(np.nanmean(half)) if np.isfinite(half).any() else 0.0
    return 100.0 * slope_at_rest(energy) / mean if mean > 0 else None


def _moved(pos: np.ndarray) -> float | None:
    centre = pos[len(pos) // 2 :].astype(np.float64).mean(axis=1)
    way = float(np.linalg.norm(centre - centre[0], axis=1).max())
    return 1e3 * way if np.isfinite(way) else None


def _difference(pos: np.ndarray, reference: np.ndarray) -> float | None:
    """Mean distance [mm] of the vertices in the worst frame that both have; None for other meshes, or where none is finite."""
    count = min(len(pos), len(reference))
    if count == 0 or pos.shape[1:] != reference.shape[1:]:
        return None
    away = np.linalg.norm(pos[:count].astype(np.float64) - reference[:count], axis=2).mean(axis=1)
    return 1e3 * float(away[np.isfinite(away)].max()) if np.isfinite(away).any() else None

"""What is measured of a rollout of the stability map, besides its class."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hood.evaluation.envelope import slope_at_rest, worst

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

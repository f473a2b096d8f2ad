"""What a rollout comes to in a few numbers, from its file: ``summary.json`` and the lines a command prints."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hood.app.output.frames import describe_mesh, describe_rate, summarise_mesh, summarise_rate
from hood.app.output.verdict import (
    cut_at_worst,
    describe_surface,
    describe_verdict,
    describe_worst,
    summarise_surface,
    summarise_verdict,
)
from hood.app.scene.events import describe_fasteners, summarise_fasteners
from hood.app.settings.record import read_settings
from hood.app.stepping.cloth_contact import describe_cloth_contact, summarise_cloth_contact
from hood.app.stepping.guarding import summarise_guard
from hood.app.stepping.refinement import describe_refinement, summarise_refinement
from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.solver.step_figures import MET, count_reasons, name_counts


def summarise_file(path: Path) -> dict[str, Any]:
    """That of the rollout in a file; see :func:`summarise`."""
    return summarise(read_rollout(path))


def summarise(data: RolloutData) -> dict[str, Any]:
    """Summary of a rollout: strain, penetration, surface, times, first non-finite frame; None if not measured."""
    finite = data.step_finite
    metrics = defaultdict(lambda: np.full(len(finite), np.nan), data.step_metrics)
    # The first step makes tables as well: it counts only where there is no other.
    times = {
        name[3:]: _quantiles(metrics[name][2 if len(finite) > 2 else 1 :]) for name in sorted(metrics) if name.startswith("ms_")
    }
    converged = metrics.get("solver_converged")
    solver: dict[str, Any] = {}
    if converged is not None:
        solver["solver_steps_not_converged"] = int((converged == 0).sum())
        solver["solver_steps_ended"] = count_reasons(metrics["solver_reason"])
    return {
        "num_frames": len(data.time),
        "complete": bool(data.attributes["complete"]),
        "garment": data.attributes["garment"],
        "num_vertices": int(data.cloth_pos.shape[1]) - data.riding[0] if data.refined is None else data.refined.num_coarse,
        **summarise_mesh(data),
        "dt": float(data.attributes["dt"]),
        **summarise_rate(data),
        "first_nonfinite_frame": None if finite.all() else int(np.argmin(finite)),
        "first_frame": {
            key: _at(metrics[key], 0) for key in ("strain_p50", "strain_p99", "penetration_count", "penetration_depth")
        },
        "settled": _settled(metrics),
        "strain_p50": _median(metrics["strain_p50"]),
        "strain_p99": _median(metrics["strain_p99"]),
        "strain_max": _largest(metrics["strain_max"]),
        "penetration_share_mean": _mean(metrics["penetration_share"]),
        "penetration_share_max": _largest(metrics["penetration_share"]),
        "penetration_count_max": _largest(metrics["penetration_count"]),
        "penetration_depth_max_m": _largest(metrics["penetration_depth"]),
        "surface": summarise_surface(data.step_metrics, _stride(data.attributes)),
        "potential_mean_J": _mean(metrics["energy_total"]),
        "potential_inertial_guess_mean_J": _mean(metrics["energy_inertial_guess"]),
        "distance_p99_median_m": _median(metrics["distance_p99"]),
        "relative_gradient_median": _median(metrics["relative_gradient"]),
        "ms_per_frame": times,
        **solver,
        **summarise_cloth_contact(
            read_settings(data.attributes["config"]), data.step_metrics, str(data.attributes.get("cloth_contact_off", ""))
        ),
        **summarise_refinement(read_settings(data.attributes["config"]), data.step_metrics),
        **summarise_fasteners(data),
        **summarise_guard(data),
        **summarise_verdict(data),
    }


def describe(summary: dict[str, Any]) -> str:
    """The summary in a few lines: frames, strain, vertices inside the body, times, how far steps were taken, the cut surface
    with its warnings, the verdict."""
    first = summary["first_nonfinite_frame"]
    return "\n".join(
        [
            f"{summary['garment']}: {summary['num_frames']} frames, "
            + ("all finite" if first is None else f"first non-finite frame {first}"),
            *describe_rate(summary),
            *describe_mesh(summary),
            f"strain p50 {_percent(summary['strain_p50'])} p99 {_worst_strain(summary)}, {_penetration(summary)}",
            *_describe_times(summary["ms_per_frame"]),
            *_describe_start(summary.get("settled")),
            *describe_refinement(summary),
            *describe_surface(summary["surface"]),
            *describe_cloth_contact(summary),
            *describe_fasteners(summary),
            *_missed(summary),
            *describe_verdict(summary),
        ]
    )


def describe_all(rows: Mapping[str, Mapping[str, Any]], total: int) -> str:
    """One line per motion, and how many were done."""
    lines = []
    for name, row in rows.items():
        if "error" in row:
            lines.append(row["error"] if row["error"].startswith(f"{name}:") else f"{name}: {row['error']}")
            continue
        first = row["first_nonfinite_frame"]
        state = f"{row['num_frames']} frames, " + ("all finite" if first is None else f"first non-finite frame {first}")
        lines.append(
            f"{name}: {state}, strain p99 {_worst_strain(row)}, "
            f"{_percent(row['penetration_share_mean'])} of the vertices inside the body, {cut_at_worst(row.get('surface'))}"
            + ("; finished before, skipped" if row.get("skipped") else "")
            + (f"; UNSOUND: {row['unsound_reasons'][0]}" if row["sound"] is False else "")
            + (f"; doubt: {row['doubts'][0]['sentence']}" if row.get("doubts") else "")
        )
    failed = sum("error" in row for row in rows.values())
    unsound = sum(row.get("sound") is False for row in rows.values())
    doubtful = sum(bool(row.get("doubts")) for row in rows.values())
    skipped = sum(bool(row.get("skipped")) for row in rows.values())
    parts = [f"{len(rows) - failed} of {total} motions simulated"]
    parts += [f"{count} {what}" for count, what in ((failed, "failed"), (unsound, "unsound"), (doubtful, "doubtful")) if count]
    before = f"; {skipped} of them finished before and skipped now" if skipped else ""
    return "\n".join([*lines, ", ".join(parts) + before])


def _settled(metrics: Mapping[str, np.ndarray]) -> dict[str, Any] | None:
    """How the start was brought to rest; None where it was not."""
    seconds = _at(metrics["settle_seconds"], 0)
    if seconds is None:
        return None
    return {
        "seconds": seconds,
        "steps": int(metrics["settle_steps"][0]),
        "speed_m_per_s": _at(metrics["settle_speed"], 0),
        "reached": bool(metrics["settle_reached"][0]),
    }


def _describe_times(times: Mapping[str, Mapping[str, float | None]]) -> list[str]:
    known = [f"{name} {value['median']:.1f}" for name, value in times.items() if value["median"] is not None]
    return [f"ms per frame (median): {', '.join(known)}"] if known else []


def _describe_start(settled: Mapping[str, Any] | None) -> list[str]:
    if settled is None:
        return []
    speed = settled["speed_m_per_s"]
    moves = "n/a" if speed is None else f"{1e3 * speed:.1f} mm a second"
    state = "at rest" if settled["reached"] else "not at rest"
    took = f"{settled['seconds']:.1f} s ({settled['steps']} steps)"
    return [f"frame 0: settled in {took}, {state}: the cloth still moves by {moves}"]


def _missed(summary: Mapping[str, Any]) -> list[str]:
    """A line where the solver missed its target, with the reasons."""
    missed = summary.get("solver_steps_not_converged", 0)
    if not missed:
        return []
    reasons = name_counts({name: count for name, count in summary["solver_steps_ended"].items() if name != MET})
    why = f" ({reasons})" if reasons else ""  # earlier files have none
    return [f"{missed} steps did not reach solver.target_rg{why}; their frames are kept as far as they got"]


def _quantiles(values: np.ndarray) -> dict[str, float | None]:
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return {"median": None, "p99": None}
    return {"median": float(np.median(values)), "p99": float(np.quantile(values, 0.99))}


def _at(values: np.ndarray, index: int) -> float | None:
    return float(values[index]) if np.isfinite(values[index]) else None


def _reduce(function: Any, values: np.ndarray) -> float | None:
    values = values[np.isfinite(values)]
    return float(function(values)) if len(values) else None


def _median(values: np.ndarray) -> float | None:
    return _reduce(np.median, values)


def _mean(values: np.ndarray) -> float | None:
    return _reduce(np.mean, values)


def _largest(values: np.ndarray) -> float | None:
    return _reduce(np.max, values)


def _percent(value: float | None) -> str:
    return "n/a" if value is None else f"{100 * value:.1f}%"


def _worst_strain(summary: Mapping[str, Any]) -> str:
    return _percent(summary["strain_p99"]) + describe_worst(summary, "strain_p99", ".1%")


def _penetration(summary: dict[str, Any]) -> str:
    share, depth = summary["penetration_share_mean"], summary["penetration_depth_max_m"]
    if share is None or depth is None:
        return "vertices inside the body n/a"
    return f"vertices inside the body: {_percent(share)} deeper than 2 mm, deepest {1e3 * depth:.1f} mm"


def _stride(attributes: dict[str, Any]) -> int | None:
    """Frames from one measurement of the surface to the next; None of files that do not say."""
    return int(attributes["surface_stride"]) if "surface_stride" in attributes else None

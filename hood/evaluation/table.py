"""The paper's Table 1: cost, reach and accuracy of several models on one fixed list of garments and motions."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hood.dynamics.rollout import simulate
from hood.dynamics.simulator import Simulator
from hood.evaluation.radius import measured_radius
from hood.losses.potential import Potential
from hood.scene.scene import Scene

#: Frames at the start of a rollout that are left out of the times: caches fill and pages are mapped there.
_WARMUP = 2
ALL = "all"
COLUMNS = (
    *("model", "weights", "garment", "steps", "radius", "ms", "ms_p99", "fps", "L_total", "L_guess"),
    *("L_stretching", "L_bending", "L_inertia", "L_gravity", "L_collision", "L_friction"),
    *("gradient_norm", "relative_gradient", "strain_p99", "penetration", "frames", "failed_at"),
)
#: Columns that the printed table leaves to the files.
_FILE_ONLY = ("relative_gradient", "frames")


@dataclass(frozen=True)
class Candidate:
    """A model to evaluate and what its weights are."""

    name: str
    weights: str
    simulator: Simulator


def evaluate(
    candidates: Sequence[Candidate],
    scenes: Mapping[str, Sequence[Scene]],
    potential: Potential,
    num_frames: int,
    progress: Callable[[str], None] = lambda text: None,
) -> list[dict[str, Any]]:
    """Rows of the table: one per model and garment, and one per model over all garments.

    Means over the frames that a model's own rollouts reach before the first non-finite one; ``failed_at`` is the earliest
    such frame (None: never). ``L_guess`` is the potential of the inertial guess on the same states. ``gradient_norm`` [N]
    is the mean over vertices of ‖∂L/∂x_v‖₂, averaged over frames.
    """
    rows = []
    for candidate in candidates:
        steps = len(candidate.simulator.schedule)
        radius = measured_radius(candidate.simulator)
        frames: dict[str, list[dict[str, float]]] = {}
        failures: dict[str, list[int]] = {}
        for garment, variants in scenes.items():
            frames[garment], failures[garment] = [], []
            for scene in variants:
                progress(f"{candidate.name} {garment} {scene.motion.sequence.name}")
                reached, failed = _own_frames(candidate.simulator, scene, potential, num_frames)
                frames[garment] += reached
                failures[garment] += [] if failed is None else [failed]
        shared = {"model": candidate.name, "weights": candidate.weights, "steps": steps, "radius": radius}
        groups = [(garment, frames[garment], failures[garment]) for garment in scenes]
        groups.append((ALL, sum(frames.values(), []), sum(failures.values(), [])))
        rows += [{**shared, "garment": garment, **_row(values, failed)} for garment, values, failed in groups]
    return rows


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Fixed-width text of the rows."""
    shown = [column for column in COLUMNS if column not in _FILE_ONLY]
    cells = [[_cell(row.get(column)) for column in shown] for row in rows]
    widths = [max(len(title), *(len(line[i]) for line in cells)) for i, title in enumerate(shown)]
    lines = ["  ".join(title.rjust(width) for title, width in zip(shown, widths, strict=True))]
    lines += ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells]
    return "\n".join(lines)


def write_table(rows: Sequence[Mapping[str, Any]], folder: Path) -> tuple[Path, Path]:
    """Write ``table.csv`` and ``table.json`` atomically; returns their paths."""
    csv_path, json_path = folder / "table.csv", folder / "table.json"
    temporary = csv_path.with_name(csv_path.name + ".partial")
    with open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows({column: row.get(column) for column in COLUMNS} for row in rows)
    os.replace(temporary, csv_path)
    temporary = json_path.with_name(json_path.name + ".partial")
    temporary.write_text(json.dumps(list(rows), indent=1), encoding="utf-8")
    os.replace(temporary, json_path)
    return csv_path, json_path


def _own_frames(
    simulator: Simulator, scene: Scene, potential: Potential, num_frames: int
) -> tuple[list[dict[str, float]], int | None]:
    reached: list[dict[str, float]] = []
    for frame in simulate(simulator, scene, potential, num_frames):
        if not np.isfinite(frame.metrics["strain_p99"]):
            return reached, frame.index
        if frame.index > _WARMUP:
            reached.append(frame.metrics)
    return reached, None


def _row(frames: Sequence[Mapping[str, float]], failures: Sequence[int]) -> dict[str, Any]:
    row: dict[str, Any] = {"frames": len(frames), "failed_at": min(failures) if failures else None}
    if not frames:
        return row
    times = np.array([frame["ms_total"] for frame in frames])
    row |= {
        "ms": float(np.median(times)),
        "ms_p99": float(np.quantile(times, 0.99)),
        "fps": float(1e3 / np.median(times)),
    }
    for name in ("stretching", "bending", "inertia", "gravity", "collision", "friction", "total"):
        row[f"L_{name}"] = _mean(frames, f"energy_{name}")
    row["L_guess"] = _mean(frames, "energy_inertial_guess")
    for column, key in (
        ("gradient_norm", "gradient_norm"),
        ("strain_p99", "strain_p99"),
        ("penetration", "penetration_share"),
    ):
        row[column] = _mean(frames, key)
    row["relative_gradient"] = float(np.median([frame["relative_gradient"] for frame in frames]))
    return row


def _mean(frames: Sequence[Mapping[str, float]], key: str) -> float:
    return float(np.mean([frame.get(key, 0.0) for frame in frames]))


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)

"""Measured refinements: what so many iterations cost and reach, read from a table to begin where others have been."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any


@dataclass(frozen=True)
class Costs:
    """What a refined frame costs on the machine of the table [ms]."""

    iteration: float
    setup: float  # before the first iteration, beyond what a frame costs without refinement
    frame: float | None  # without refinement; None where the table does not say


def floor_from_table(path: Path, limit: float, num_vertices: int, method: str) -> int:
    """Iterations with which a table of measurements stays at ``limit`` or below, for :class:`hood.dynamics.stopping.MaxStrain`.

    The file is JSON: ``{"rows": [{"method": "newton", "vertices": 1014, "refine": 5, "strain_p99": 0.04}, …]}``; further
    entries of a row are not read. Of the method's rows those count whose number of vertices is nearest by ratio; where none
    of them is low enough, the lowest.

    Raises:
        ValueError: not such a file, an entry that is missing or no number, or no row of the method.
    """
    rows = _nearest_rows(path, method, "strain_p99", num_vertices)
    enough = [k for k, strain in rows if strain <= limit]
    return min(enough) if enough else min(rows, key=lambda row: row[1])[0]


def costs_from_table(path: Path, num_vertices: int, method: str) -> Costs:
    """What an iteration costs, for :class:`hood.dynamics.stopping.Budget`, from the same rows' ``ms`` of a whole frame.

    An iteration costs the median of what it costs between neighbouring rows with ``refine`` of 1 or more; with a single one
    of them, its share of what that row takes longer than the row without refinement.

    Raises:
        ValueError: as above, or too few rows to tell.
    """
    measured: dict[int, list[float]] = {}
    for k, ms in _nearest_rows(path, method, "ms", num_vertices):
        measured.setdefault(k, []).append(ms)
    times = {k: median(measured[k]) for k in sorted(measured)}
    frame, refined = times.pop(0, None), list(times.items())
    if not refined or (len(refined) == 1 and frame is None):
        raise ValueError(
            f"{path}: ms of {len(measured)} values of refine for method {method!r} do not say what an iteration costs; add rows"
        )
    if len(refined) == 1:
        assert frame is not None
        k, ms = refined[0]
        return Costs(max((ms - frame) / k, 0.0), 0.0, frame)
    slope = max(median((b[1] - a[1]) / (b[0] - a[0]) for a, b in zip(refined, refined[1:], strict=False)), 0.0)
    start = refined[0][1] - slope * refined[0][0]
    return Costs(slope, max(start - frame, 0.0) if frame is not None else 0.0, frame)


def _nearest_rows(path: Path, method: str, field: str, num_vertices: int) -> list[tuple[int, float]]:
    """``refine`` and ``field`` of the method's rows whose number of vertices is nearest by ratio."""
    rows = [
        (_number(path, i, row, "vertices", 1), int(_number(path, i, row, "refine", 0)), _number(path, i, row, field, 0))
        for i, row in enumerate(_rows(path))
        if _method(path, i, row) == method
    ]
    if not rows:
        raise ValueError(f"{path}: has no row of method {method!r}; leave refine_table out to adapt online alone")
    nearest = min(max(vertices / num_vertices, num_vertices / vertices) for vertices, *_ in rows)
    return [(k, value) for vertices, k, value in rows if max(vertices / num_vertices, num_vertices / vertices) == nearest]


def _rows(path: Path) -> list[dict[str, Any]]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not a table of refinements, no JSON ({error}); hood tradeoff writes one") from error
    rows = content.get("rows") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        raise ValueError(f"{path}: not a table of refinements, it has no list named rows; hood tradeoff writes one")
    return rows


def _method(path: Path, index: int, row: Any) -> str:
    if not isinstance(row, dict) or not isinstance(row.get("method"), str):
        raise ValueError(f"{path}: row {index}: method is missing; give newton or sweeps")
    return str(row["method"])


def _number(path: Path, index: int, row: dict[str, Any], field: str, least: int) -> float:
    """Entry ``field`` of a row: finite, ``least`` or more."""
    value, counts = row.get(field), field in ("vertices", "refine")
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value >= least:
        if not counts or value == int(value):
            return float(value)
    given = "is missing" if field not in row else f"is {value!r}"
    kind = "a whole number" if counts else "a finite number"
    raise ValueError(f"{path}: row {index}: {field} {given}; give {kind}, {least} or more")

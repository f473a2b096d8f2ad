"""Points of a chart with made-up measurements."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hood.evaluation.files import EvaluationUnit, RolloutLog
from hood.evaluation.table import GUESS, NEWTON, MeasuredRollout
from hood.studies.tradeoff.grid import Grid, GridSize, Point
from hood.studies.tradeoff.results import Reached, summarise_points

PARTS = {"ms_search": 0.1, "ms_features": 0.1, "ms_network": 0.6, "ms_refine": 0.1, "ms_guess": 0.05, "ms_rest": 0.05}


def point(model: str = "net", refine: int = 0, size: str = "1k", precision: str = "fp32", method: str = "newton") -> Point:
    return Point(size, model, refine, precision, method, (f"models=[{model}+{refine}]", f"garments=[{size}]"))


def rollout(ms: Sequence[float], gaps: Sequence[float], strain: float = 0.1, **flags: float) -> MeasuredRollout:
    """A rollout with these times and gaps; ``converged`` and ``spread`` of its references."""
    frames = [
        {
            "ms_total": time,
            "strain_p99": strain,
            "relative_gradient": 0.5,
            **{key: time * share for key, share in PARTS.items()},
        }
        for time in ms
    ]
    return MeasuredRollout(frames, [], [{"gamma": gap, "converged": 1.0, "spread": 1e-4, **flags} for gap in gaps])


def reached(
    model: str, refine: int, ms: float, gap: float, size: str = "1k", vertices: int = 1000, noise: float = 0.02,
    strain: float = 0.1, precision: str = "fp32", seed: int = 0,
) -> Reached:  # fmt: skip
    """A point around ``ms`` and ``gap`` with the given relative noise, from eight rollouts."""
    random = np.random.default_rng([seed, refine, len(model)])
    rollouts = [
        rollout(ms * (1 + noise * random.normal(size=10)), gap * (1 + noise * random.normal(size=4)), strain) for _ in range(8)
    ]
    made = point(model, refine, size, precision)
    return summarise_points(made, rollouts, vertices, {"device": "CPU (made up)", "jobs": 2, "load_at_start": 1.5})


def solver(curve: dict[int, tuple[float, float]], converged: float = 300.0, **options: object) -> list[Reached]:
    """The solver alone: milliseconds and γ by iterations, and converged."""
    stopped = [reached(GUESS, k, *reach, **options) for k, reach in curve.items()]  # type: ignore[arg-type]
    return [*stopped, reached(NEWTON, 0, converged, 1e-7, **options)]  # type: ignore[arg-type]


def tiny_grid(*models: str, refine: tuple[int, ...] = (0, 2)) -> Grid:
    return Grid(
        models,
        ("fp32",),
        ("newton",),
        (GridSize("1k", ("tank",), refine, (2,), 5, 1),),
        ("sequences=[walk_proud]",),
        newton=False,
    )


def write_point(folder: Path, one: Point, rollouts: Sequence[MeasuredRollout]) -> None:
    """The folder of a point that is done."""
    for index, measured in enumerate(rollouts):
        RolloutLog(folder).write(EvaluationUnit(0, "tank", f"motion{index}"), "none", measured)
    (folder / "point.json").write_text(json.dumps({"command": one.command, "weights": "none", "device": "CPU (made up)"}))

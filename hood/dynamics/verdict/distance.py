"""How far the vertices of a step still have to go to the minimum of its potential, in metres.

The relative gradient misjudges a step both ways: a stretch by a hundredth of a millimetre counts as much as a swing by a
centimetre. What tells is how far the solver goes from where the step ended. A few iterations cover most of the way; where
contact or the line search stops them early, Newton's own steps tell how much is left.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hood.losses.layer_sides import LayerSides
from hood.losses.potential import Potential
from hood.losses.problem import StepProblem
from hood.solver.further import Further

#: Distance [m] to the minimum of the step that led to a frame: 99th percentile over the vertices that move, and the largest.
DISTANCE_METRICS = ("distance_p99", "distance_max")

#: Iterations from the end of the step at most. The last one is where Newton's step (99th percentile over the vertices) is less
#: than this [m], or than this share of all of them.
ITERATIONS, CALM, SETTLED = 4, 5e-5, 0.1
#: The whole way over what the iterations tell of it, and the power of the share of the force that they leave
#: (``python benchmarks/step_distance.py``).
WHOLE, LEFT = 1.35, 0.08
#: So much of Newton's steps counts as gone at least: of a search that gets nowhere, all of the way is left.
_LEAST = 0.05


class Distance(NamedTuple):
    """Estimated distance [m] of a step to its minimum over the vertices that move."""

    p99: float
    most: float


@torch.no_grad()
def distance_metrics(potential: Potential, problem: StepProblem, next_pos: Tensor) -> dict[str, float]:
    """:data:`DISTANCE_METRICS` of the step to ``next_pos`` (V, 3) m; NaN where that is not finite, and of a potential that is
    for training alone. Arguments as of :func:`estimate`."""
    for_training = any(type(term) is LayerSides for term in potential.terms.values())
    if for_training or not bool(torch.isfinite(next_pos).all()):
        return dict.fromkeys(DISTANCE_METRICS, float("nan"))
    found = estimate(potential, problem, next_pos)
    for scene in problem.layers:  # what somebody asks of the step after this does not depend on it
        scene.layers.restart()
    return dict(zip(DISTANCE_METRICS, found, strict=True))


def estimate(potential: Potential, problem: StepProblem, next_pos: Tensor) -> Distance:
    """How far vertices at ``next_pos`` (V, 3) m are from the minimum that the solver goes to from there.

    d is how far a vertex gets in up to :data:`ITERATIONS` iterations, p the sum of Newton's steps on the way, taken whole, and
    r the share of the force that is left: the way is √(d p) times 1.35 r^0.08, or times 1 where that is less. Cloth that
    passes through cloth has no way to go for that: ``self_crossings`` counts it.

    Args:
        potential: what the step is measured by.
        problem: prepared by it, with the contact that the step was taken with in the end.
    """
    free = problem.cloth.free
    if not bool(free.any()):
        return Distance(0.0, 0.0)
    way = Further(potential, problem, next_pos)
    began = way.residual
    if not began > 0.0 or not math.isfinite(began):
        return Distance(began, began)
    steps, calm = _follow(way, free)
    gone = torch.maximum(_lengths(way.pos - next_pos, free), _LEAST * steps)
    left = (gone * steps).sqrt() * (WHOLE if calm else _whole(began, way.residual))
    return Distance(_p99(left), float(left.max()))


def _follow(way: Further, free: Tensor) -> tuple[Tensor, bool]:
    """Take the iterations: the sum of Newton's steps, (N,) m, and whether the first of them hardly moved anything."""
    steps, told = torch.zeros(int(free.sum()), dtype=torch.float64, device=free.device), 0.0
    for turn in range(ITERATIONS):
        if turn and not way.residual > 0.0:
            break
        moved, step = way.move(), _lengths(way.direction, free)
        steps, size = steps + step, _p99(step)
        told += size
        if not moved or size < max(CALM, SETTLED * told):
            return steps, turn == 0
    return steps, False


def _whole(began: float, residual: float) -> float:
    """The way over what is known of it, by the relative gradients where it began and where it has got to."""
    return max(WHOLE * min(residual / began, 1.0) ** LEFT, 1.0)


def _p99(values: Tensor) -> float:
    return float(values.quantile(0.99))


def _lengths(moved: Tensor, free: Tensor) -> Tensor:
    """(N,) m, of the vertices that move."""
    return torch.linalg.vector_norm(moved, dim=1)[free]

"""How far the vertices of a step still have to go to the minimum of its potential, in metres.

The relative gradient misjudges a step both ways: a stretch by a hundredth of a millimetre counts as much as a swing by a
centimetre. What tells is how far the solver goes from where the step ended. A few iterations cover most of the way; where
contact or the line search stops them early, Newton's own steps tell how much is left.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.energies.term import Role, having
from hood.limits import DISTANCE_UNSOUND
from hood.solver.newton import Further

#: Distance [m] to the minimum of the step that led to a frame: 99th percentile over the vertices that move, and the largest.
DISTANCE_METRICS = ("distance_p99", "distance_max")
#: Measured in every so many of the frames in which the surface is: of a rollout with five iterations from the inertial guess,
#: the quickest there is, it takes 2 to 5% of the time then, and half of that or less of all others.
DISTANCE_EVERY = 2

#: Iterations from the end of the step at most. The last one is where Newton's step (99th percentile over the vertices) is less
#: than this [m], or than this share of all of them.
ITERATIONS, CALM, SETTLED = 5, 5e-5, 0.1
#: The whole way over what the iterations tell of it, and the power of the share of the force that they leave: fitted to 500
#: states of scenes that ``benchmarks/step_distance.py`` does not have.
WHOLE, LEFT = 1.3, 0.08
#: Within this factor of the limit of a verdict, by the estimate or by Newton's steps, it is looked at again: up to so many
#: iterations more, until Newton's step is less than this share of the way.
NEAR, AGAIN, CLOSE = 3.0, 25, 0.02
#: So much of Newton's steps counts as gone at least: of a search that gets nowhere, all of the way is left. A step so many
#: times longer than all before it is of a model without a minimum, and tells nothing.
_LEAST, _WILD = 0.2, 50.0


class Distance(NamedTuple):
    """Lengths [m] over the vertices that move: the 99th percentile and the largest."""

    p99: float
    most: float


@torch.no_grad()
def distance_metrics(potential: Potential, problem: StepProblem, next_pos: Tensor) -> dict[str, float]:
    """:data:`DISTANCE_METRICS` of the step to ``next_pos`` (V, 3) m; NaN where that is not finite, and of a potential that is
    for training alone. Arguments as of :func:`estimate`."""
    if having(potential.terms, Role.TRAINING) or not bool(torch.isfinite(next_pos).all()):
        return dict.fromkeys(DISTANCE_METRICS, float("nan"))
    limit = DISTANCE_UNSOUND.value * float(problem.step.dt.max())
    found = estimate(potential, problem, next_pos, limit)
    for scene in problem.layers:  # what somebody asks of the step after this does not depend on it
        scene.layers.restart()
    return dict(zip(DISTANCE_METRICS, found, strict=True))


def estimate(potential: Potential, problem: StepProblem, next_pos: Tensor, limit: float | None = None) -> Distance:
    """How far vertices at ``next_pos`` (V, 3) m are from the minimum that the solver goes to from there.

    d is how far they get in up to :data:`ITERATIONS` iterations, p the sum of Newton's steps on the way, taken whole, and r the
    share of the force that is left: the way is √(d p) times 1.3 r^0.08, or times 1 where that is less; d and every step are
    99th percentiles or largest values. Where this or p is near ``limit`` the solver goes on, and the way is how far it gets.
    Cloth that passes through cloth has no way to go for that: ``self_crossings`` counts it.

    Args:
        potential: what the step is measured by.
        problem: prepared by it, with the contact that the step was taken with in the end.
        limit: of a verdict [m]; None: there is none.
    """
    free = problem.cloth.free
    if not bool(free.any()):
        return Distance(0.0, 0.0)
    way = Further(potential, problem, next_pos)
    began = way.residual
    if not began > 0.0 or not math.isfinite(began):
        return Distance(began, began)
    steps = _follow(way, free)
    whole = WHOLE if len(steps) == 1 else max(WHOLE * min(way.residual / began, 1.0) ** LEFT, 1.0)
    gone, sums = _sizes(way.pos - next_pos, free), Distance(*(_whole(sizes) for sizes in zip(*steps, strict=True)))
    found = Distance(*(whole * math.sqrt(max(d, _LEAST * p) * p) for d, p in zip(gone, sums, strict=True)))
    near = limit is not None and max(found.p99, sums.p99) > limit / NEAR and found.p99 < limit * NEAR
    return _looked_at_again(way, next_pos, free, found) if near else found


def _whole(sizes: Iterable[float]) -> float:
    """The sum of Newton's steps, each as long as it is, but for wild ones."""
    total = longest = 0.0
    for size in sizes:
        if not total or size < _WILD * longest:
            total, longest = total + size, max(longest, size)
    return total


def _looked_at_again(way: Further, start: Tensor, free: Tensor, before: Distance) -> Distance:
    """How far the solver gets when it goes on, and its last step, of which some is left; what was estimated ``before`` where it
    does not get there and that is more."""
    gone, last = _sizes(way.pos - start, free), Distance(0.0, 0.0)
    for _ in range(AGAIN):
        if not (way.residual > 0.0 and way.move()):
            break
        gone, last = _sizes(way.pos - start, free), _sizes(way.direction, free)
        if last.p99 < CLOSE * gone.p99:
            return Distance(gone.p99 + last.p99, gone.most + last.most)
    return Distance(max(gone.p99 + last.p99, before.p99), max(gone.most + last.most, before.most))


def _follow(way: Further, free: Tensor) -> list[Distance]:
    """Take the iterations: the sizes of Newton's steps."""
    steps: list[Distance] = []
    while len(steps) < ITERATIONS and (not steps or way.residual > 0.0):
        moved = way.move()
        steps.append(_sizes(way.direction, free))
        if not moved or steps[-1].p99 < max(CALM, SETTLED * sum(step.p99 for step in steps)):
            break
    return steps


def _sizes(moved: Tensor, free: Tensor) -> Distance:
    """How far (V, 3) m leads, over the vertices that move."""
    lengths = torch.linalg.vector_norm(moved, dim=1)[free]
    return Distance(float(lengths.quantile(0.99)), float(lengths.max()))

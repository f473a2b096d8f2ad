"""How far the vertices of a step still have to go to the minimum of its potential, in metres.

The relative gradient misjudges a step both ways: a stretch of a hundredth of a millimetre counts as much as a swing of a
centimetre. What tells is how far the solver goes from where the step ended: three of its iterations cover most of the way.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hood.losses.layer_sides import LayerSides
from hood.losses.potential import Potential
from hood.losses.problem import StepProblem
from hood.solver.newton import NewtonSettings, minimize

#: Distance [m] to the minimum of the step that led to a frame: 99th percentile over the vertices that move, and the largest.
DISTANCE_METRICS = ("distance_p99", "distance_max")

#: Iterations from the end of the step.
ITERATIONS = 3
#: The whole way over the part of it that these cover.
WHOLE = 1.4
#: Relative gradient of a minimum from which no iteration leads on.
_EXACT = 1e-9


@torch.no_grad()
def distance_metrics(potential: Potential, problem: StepProblem, next_pos: Tensor) -> dict[str, float]:
    """:data:`DISTANCE_METRICS` of the step to ``next_pos`` (V, 3) m; NaN where that is not finite, and of a potential that is
    for training alone.

    The minimum is the one that the solver goes to from there. Layers of cloth are kept apart as they lie at ``next_pos``: cloth
    that passes through cloth there has no distance to go for that. Nothing of ``problem`` changes.

    Args:
        potential: what the step is measured by.
        problem: prepared by it, with the contact that the step was taken with in the end.
    """
    for_training = any(type(term) is LayerSides for term in potential.terms.values())
    if for_training or not bool(torch.isfinite(next_pos).all()):
        return dict.fromkeys(DISTANCE_METRICS, float("nan"))
    way = WHOLE * covered(potential, problem, next_pos, ITERATIONS)
    if len(way) == 0:
        return dict.fromkeys(DISTANCE_METRICS, 0.0)
    return dict(zip(DISTANCE_METRICS, (float(way.quantile(0.99)), float(way.max())), strict=True))


def covered(potential: Potential, problem: StepProblem, next_pos: Tensor, iterations: int) -> Tensor:
    """How far (N,) [m], float64, the N vertices that move get in some iterations of the solver from ``next_pos`` (V, 3) m."""
    start = next_pos.double()
    settings = NewtonSettings(target_rg=_EXACT, max_iterations=iterations)
    # Asked before every iteration, the solver leaves alone what it remembers of layers for the rollout's next step.
    pos, _ = minimize(potential, problem.with_ways_from(start), start, settings, proceed=lambda progress, here: True)
    free = problem.cloth.free
    return torch.linalg.vector_norm(pos.double() - start, dim=1)[free]

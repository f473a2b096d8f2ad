"""The training loss as one number that can be watched: the potential above what free fall would cost."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from hood.losses.potential import scale
from hood.losses.problem import StepProblem


def relative_loss(problem: StepProblem, energies: Mapping[str, Tensor], acc: Tensor) -> Tensor:
    """(Φ − Φ_fall) / e0 of every scene (B,): how far the step is above free fall, in units of e0.

    Φ alone cannot be watched: gravity's zero is arbitrary, so Φ is as often negative as positive. With Φ_fall, inertia plus
    gravity of the acceleration g, the two become ½ Σ m dt² ‖a − g‖² and no term can be negative; garments of any mass and steps
    of any length are comparable. Cloth at rest has 1, its weight held up, plus what it is stretched and bent.
    """
    dt = problem.vertex_dt.squeeze(1)
    apart = (acc - problem.gravity.to(acc)).square().sum(dim=1)
    fall = problem.sum_vertices(0.5 * problem.cloth.mass * dt * dt * apart)
    rest = [value for name, value in energies.items() if name not in ("inertia", "gravity")]
    return sum(rest, start=fall) / scale(problem)

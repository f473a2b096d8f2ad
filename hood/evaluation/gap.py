"""Accuracy without ground truth: how far a step is from the minimum of the potential it should minimise.

A step is exact where its positions are a minimum of the incremental potential Φ, and two numbers say how far a method's
positions are from that. The *gap* γ is the energy above the minimum in units of e0 = ½ M g² dt², what it costs to be wrong
about every vertex's acceleration by 1 g. Inertia alone makes that a quadratic law: with γ = 1e-2 accelerations are wrong by
about √γ = 0.1 g, root mean square over the mass, and positions by 0.1 g dt² = 1.1 mm at dt = 1/30 s; where cloth is stiff the
same energy is spent on less. The *relative gradient* rg = ‖∇Φ‖ / ‖M g‖ is the force left unbalanced in units of the weight
and needs no minimum, but does not say how far away that is: at edges of 1 cm, stretching cotton by 10 µm counts as much as
swinging it 1 cm too far. So both are reported, on the states that the method itself reaches.

Steps kept out of a rollout, for measurements after it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hood.energies.potential import Potential, scale
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import Unknowns, in_double
from hood.steppers.network import Prediction

#: Accuracy of a reference minimum; a start that misses it is flagged.
REFERENCE = NewtonSettings(target_rg=1e-3, max_iterations=300)
#: Starts whose minima differ by more than this [e0] found different minima.
AGREEMENT = 1e-2


@dataclass(frozen=True)
class _Gap:
    """Gap of a method's positions, scene by scene.

    γ = (Φ(x) − Φ*) / e0 with e0 = ½ M g² dt²; √γ is about the RMS error of the acceleration in g. Positions that beat every
    minimisation become the reference themselves: γ is 0 then, and ``converged`` is False.
    """

    gamma: Tensor  # (B,) float64
    phi: Tensor  # (B,) J, of the positions
    reference: Tensor  # (B,) J, lowest potential known: over the starts and the positions themselves
    converged: Tensor  # (B,) bool, the lowest start reached the reference accuracy
    spread: Tensor  # (B,) e0, highest minus lowest potential over the converged starts; NaN with fewer than two of them

    @property
    def agree(self) -> Tensor:
        """(B,) bool: at least two starts converged, and all that did found the same minimum within :data:`AGREEMENT`."""
        return self.spread <= AGREEMENT


def starts(problem: StepProblem, next_pos: Tensor) -> tuple[Tensor | None, ...]:
    """Where minimisations of the step ``problem`` (float64) begin; the potential is not convex, so one start is not enough.

    The contact-projected inertial guess (None: :func:`hood.solver.newton.minimize` makes it), the previous positions (V, 3) m
    and a method's own ``next_pos`` (V, 3) m.
    """
    return None, problem.state.pos, next_pos.detach().double()


def gap(
    potential: Potential,
    problem: StepProblem,
    next_pos: Tensor,
    settings: NewtonSettings = REFERENCE,
) -> _Gap:
    """Gap γ of ``next_pos`` (V, 3) for the step ``problem``.

    The reference Φ* is the lowest of the minimisations from :func:`starts`. Computed in float64.
    """
    work = in_double(potential.prepare(problem))
    pos = next_pos.detach().double()
    phi = potential.total(work, pos)
    noise = Unknowns(potential, work).at(pos).noise
    e0 = scale(work)
    values, converged = [], []
    for start in starts(work, pos):
        _, report = minimize(potential, work, start, settings)
        values.append(report.phi)
        converged.append(report.converged)
    table, sound = torch.stack(values), torch.stack(converged)
    table = torch.where(torch.isfinite(table), table, float("inf"))
    lowest, which = table.min(dim=0)
    high = torch.where(sound, table, float("-inf")).amax(dim=0)
    low = torch.where(sound, table, float("inf")).amin(dim=0)
    spread = torch.where(sound.sum(dim=0) > 1, (high - low) / e0, float("nan"))
    reference = torch.where(torch.isfinite(phi), torch.minimum(lowest, phi), lowest)
    # A state that is the minimum already may differ from its own minimisation by rounding.
    reached = sound.gather(0, which.unsqueeze(0)).squeeze(0) & ~(phi < lowest - noise)
    return _Gap((phi - reference) / e0, phi, reference, reached, spread)


class StepSample:
    """Observer of :func:`hood.rollouts.loop.simulate` that keeps ``count`` steps, spread evenly over ``frames``.

    Steps are kept instead of measured on the spot: what runs between two frames slows the next one down. Steps that
    lead to positions that are not finite have no gap and are passed over.
    """

    def __init__(self, frames: range, count: int) -> None:
        # The middles of equal stretches.
        self.wanted = {frames[(2 * i + 1) * len(frames) // (2 * count)] for i in range(count if len(frames) else 0)}
        self.steps: list[tuple[StepProblem, Prediction]] = []

    def __call__(self, frame: int, problem: StepProblem, prediction: Prediction) -> None:
        """Keep the step to ``frame`` if it is one of those wanted."""
        if frame in self.wanted and bool(torch.isfinite(prediction.next_pos).all()):
            self.steps.append((problem, prediction))

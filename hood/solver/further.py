"""The solver's way on from a place, iteration by iteration, for those who look at the way and not at its end."""

from __future__ import annotations

import torch
from torch import Tensor

from hood.losses.potential import Potential
from hood.losses.problem import StepProblem
from hood.solver.iterate import fixed_positions, in_double
from hood.solver.layers import approached, layers_of
from hood.solver.newton import NewtonSettings, system_of
from hood.solver.plan import plan_for


class Further:
    """Iterations from ``start`` (V, 3) m, as :func:`hood.solver.newton.minimize` takes them, in float64.

    Where cloth would have to cross cloth on the straight way from the step's beginning to ``start``, layers are kept apart as
    they lie at ``start``. What is remembered of them for the next step does not change.

    Args:
        problem: prepared by ``potential``.
    """

    def __init__(
        self, potential: Potential, problem: StepProblem, start: Tensor, settings: NewtonSettings | None = None
    ) -> None:
        start, work = start.double(), in_double(problem)
        layers = layers_of(potential, work)
        if layers:
            start = torch.where(work.cloth.free.unsqueeze(1), start, fixed_positions(work))
            if not torch.equal(approached(layers, start), start):
                work = work.with_ways_from(start)
        self._system = system_of(potential, work, plan_for(work), settings or NewtonSettings())
        self._system.begin(start)
        self._residual: list[float] | None = None

    @property
    def residual(self) -> float:
        """Relative gradient where the way has got to, the largest over the scenes."""
        return max(self._modelled())

    def move(self) -> bool:
        """Take an iteration, from a :attr:`residual` that is finite; whether it led anywhere."""
        residual = self._modelled()
        self._residual = None if any(self._system.move(residual, [value > 0.0 for value in residual])) else residual
        return self._residual is None

    @property
    def pos(self) -> Tensor:
        """(V, 3) m, where the way has got to."""
        return self._system.state()[0]

    @property
    def direction(self) -> Tensor:
        """(V, 3) m: the last Newton step, before contact and the line search took less of it."""
        return self._system.direction()

    def _modelled(self) -> list[float]:
        if self._residual is None:
            with torch.no_grad():
                self._residual = self._system.model()
        return self._residual

"""Schedules as functions of the iteration: horizon, learning rate, collision weight. Stateless, so a resume is exact."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hood.losses.potential import Potential


@dataclass(frozen=True)
class Horizon:
    """Predicted steps per training rollout: ``start`` at first, one more every ``every`` iterations, at most ``maximum``.

    The paper (section 3.4): every 5000 iterations, at most 5.
    """

    every: int = 5000
    maximum: int = 5
    start: int = 1

    def __call__(self, iteration: int) -> int:
        return min(self.start + iteration // max(self.every, 1), self.maximum)


@dataclass(frozen=True)
class StepDecay:
    """Learning-rate factor 0.5^⌊iteration / every⌋ + 0.01, the reference's."""

    every: int = 50000
    floor: float = 0.01

    def __call__(self, iteration: int, num_iterations: int) -> float:
        return 0.5 ** (iteration // self.every) + self.floor


@dataclass(frozen=True)
class WarmupCosine:
    """Learning-rate factor: linear over ``warmup`` iterations, then half a cosine down to ``floor``."""

    warmup: int = 50
    floor: float = 0.01

    def __call__(self, iteration: int, num_iterations: int) -> float:
        if iteration < self.warmup:
            return (iteration + 1) / self.warmup
        progress = (iteration - self.warmup) / max(num_iterations - self.warmup, 1)
        return self.floor + (1 - self.floor) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))


@dataclass(frozen=True)
class CollisionRamp:
    """Collision weight [J/m³] rising linearly from ``start`` to ``end`` between two iterations."""

    start: float = 5e5
    end: float = 5e5
    begin_iteration: int = 0
    end_iteration: int = 0

    def __call__(self, iteration: int) -> float:
        if iteration >= self.end_iteration:
            return self.end
        span = max(self.end_iteration - self.begin_iteration, 1)
        progress = min(max((iteration - self.begin_iteration) / span, 0.0), 1.0)
        return self.start + (self.end - self.start) * progress

    def apply(self, potential: Potential, iteration: int) -> Potential:
        """The potential with this iteration's weight in collision and friction."""
        weight = self(iteration)
        names = [name for name in ("collision", "friction") if name in potential.terms]
        return potential.with_terms(**{name: potential.terms[name].with_weight(weight) for name in names})  # type: ignore[attr-defined]

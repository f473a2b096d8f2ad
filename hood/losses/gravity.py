"""Gravitational energy."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from hood.losses.problem import StepProblem


class Gravity:
    """Gravitational energy [J], the sum over vertices of -m g·x; zero at the local frame's origin."""

    kind: ClassVar[str] = "Gravity"

    def applies(self, problem: StepProblem) -> bool:
        return bool(problem.gravity.any())

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        height = (next_pos * problem.gravity.to(next_pos)).sum(dim=1)
        return problem.sum_vertices(-problem.cloth.mass * height)

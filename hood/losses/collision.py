"""Cubic penalty that keeps the cloth outside the body."""

from __future__ import annotations

import torch
from torch import Tensor

from hood.losses.problem import StepProblem


class Collision:
    """Collision energy [J], the sum over vertices of w max(ε - d, 0)³ (HOOD paper, section 3.3).

    d is the signed distance to the tangent plane, on the body at t+1, of the surface point that was closest
    at t: the search happens once per step (:class:`hood.scene.contact.Contact`), which makes the energy one
    smooth function of the positions. A vertex at depth p = ε - d feels the force 3 w p² along the normal.
    Vertices without a match within the search's cap, and isolated ones, feel nothing.

    Args:
        weight: w [J/m³].
        epsilon: ε [m], distance at which the penalty sets in.
    """

    def __init__(self, weight: float = 5e5, epsilon: float = 2e-3) -> None:
        if weight < 0 or epsilon <= 0:
            raise ValueError(f"collision: weight is {weight}, epsilon {epsilon}; give weight >= 0 and epsilon > 0")
        self.weight = weight
        self.epsilon = epsilon

    def with_weight(self, weight: float) -> Collision:
        """The same term with another weight, for a ramp during training."""
        return Collision(weight, self.epsilon)

    def applies(self, problem: StepProblem) -> bool:
        return problem.contact is not None

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        if problem.contact is None:
            return next_pos.new_zeros(problem.num_scenes)
        touching = problem.contact.valid & (problem.cloth.mass > 0)
        # where() before the arithmetic: rows without a match may hold infinite or undefined distances.
        dist = torch.where(touching, problem.contact.next_dist(next_pos), self.epsilon)
        return problem.sum_vertices(self.weight * (self.epsilon - dist).clamp_min(0.0) ** 3)

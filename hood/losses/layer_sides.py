"""Penalty that keeps cloth on the side of other cloth that it is on at t: a signal for training, and for taking apart."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from hood.losses.problem import StepProblem, sum_per_scene


class LayerSides:
    """Energy [J] of layers of cloth, a sum over pairs of a vertex and a face near each other at t: w max(ε - d, 0)³.

    d = ± n · (x_v - x_f) is the distance of the vertex from the face's plane, both at t + 1, positive on the side on which the
    vertex is at t (:func:`hood.scene.layer_sides.find_sides`). A vertex on the wrong side at t + 1 is pushed back, however deep
    it went: where :class:`hood.losses.layers.LayerBarrier` is infinite or blind, this term has a slope. Cloth that is crossed
    at t stays so. Rigid-motion invariant; no net force or torque; twice differentiable but for faces without an area.

    Pairs are found once a step. What comes from beyond the reach within one, passes two edges through each other, or slides off
    its face, is not seen, or felt where nothing is: good enough to learn from, or to take garments apart; the solver and
    rollouts take the barrier.

    Args:
        weight: w [J/m³]; the body's is 5e5.
        epsilon: ε [m]; where faces are small, half of the smallest height around.
        reach: distance [m] at t below which cloth is near; farther than cloth moves against cloth in a step.
    """

    kind: ClassVar[str] = "LayerSides"

    def __init__(self, weight: float = 5e5, epsilon: float = 3e-3, reach: float = 2e-2) -> None:
        if weight < 0 or epsilon <= 0 or reach < epsilon:
            raise ValueError(
                f"layer_sides: weight is {weight}, epsilon {epsilon}, reach {reach}; give weight >= 0 and 0 < epsilon <= reach"
            )
        self.weight, self.epsilon, self.reach = weight, epsilon, reach

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with the sides that its vertices are on, searched for once per step."""
        return problem.with_sides(self.reach)

    def applies(self, problem: StepProblem) -> bool:
        if problem.sides is None:
            raise ValueError("step problem: sides not searched for yet; pass the problem through Potential.prepare once")
        return len(problem.sides.vertex) > 0

    def distances(self, problem: StepProblem, next_pos: Tensor) -> Tensor:
        """d [m] (N,) of every pair at ``next_pos`` (V, 3)."""
        pairs = problem.sides
        assert pairs is not None
        x, point = next_pos[pairs.corners], next_pos[pairs.vertex]
        normal = torch.linalg.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        square = (normal * normal).sum(dim=1)
        proper = square > torch.finfo(square.dtype).tiny
        length = torch.where(proper, square, 1.0).sqrt()
        return pairs.side * torch.where(proper, ((point - x[:, 0]) * normal).sum(dim=1), 0.0) / length

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        pairs = problem.sides
        assert pairs is not None
        depth = (pairs.room.clamp_max(self.epsilon) - self.distances(problem, next_pos)).clamp_min(0.0)
        return sum_per_scene(self.weight * depth**3, pairs.scene, problem.num_scenes)


def layer_sides(weight: float = 0.0, epsilon: float = 3e-3, reach: float = 2e-2) -> LayerSides | None:
    """The term of a config; None, which a potential leaves out, where it weighs nothing."""
    return LayerSides(weight, epsilon, reach) if weight else None

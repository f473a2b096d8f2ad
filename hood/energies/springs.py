"""Springs between cloth vertices: buttons, zipper teeth."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from hood.energies.problem import StepProblem, sum_per_scene


class Attachment:
    """Energy [J] of the step's closed attachments, the sum over active edges of ½ k ‖x_a - x_b - t‖².

    Springs that come with the step, not the garment: opening a button is leaving its edge inactive. What a pair is drawn to,
    t, is 0 where the attachments have no ``length``; else :func:`attachment_targets`, which is constant within a step.

    Args:
        stiffness: k [N/m]. At the default the weight of 100 g opens a button by 1 mm.
    """

    kind: ClassVar[str] = "Attachment"

    def __init__(self, stiffness: float = 1e3) -> None:
        if stiffness < 0:
            raise ValueError(f"attachment: stiffness is {stiffness}; give a number >= 0")
        self.stiffness = stiffness

    def applies(self, problem: StepProblem) -> bool:
        return problem.step.attachments is not None

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        attachments = problem.step.attachments
        if attachments is None:
            return next_pos.new_zeros(problem.num_scenes)
        a, b = attachments.edges.unbind(dim=1)
        gap, target = next_pos[a] - next_pos[b], attachment_targets(problem)
        gap = gap if target is None else gap - target.to(gap)
        energy = 0.5 * self.stiffness * attachments.active.to(gap.dtype) * (gap * gap).sum(dim=1)
        return sum_per_scene(energy, problem.cloth.vertex_scene[a], problem.num_scenes)


def attachment_targets(problem: StepProblem) -> Tensor | None:
    """What x_a - x_b is drawn to in the step, (A, 3) [m]: it keeps the direction that it has at t, and its length goes to that
    of the attachment by no more than its speed allows. None where the attachments have neither: 0.

    So a pair that is closed from afar comes together at its speed, and is drawn by k · speed · dt [N] at most when it is held
    back; nothing has to be remembered from step to step.
    """
    attachments = problem.step.attachments
    if attachments is None or (attachments.length is None and attachments.speed is None):
        return None
    a, b = attachments.edges.unbind(dim=1)
    gap = problem.state.pos[a] - problem.state.pos[b]
    now = torch.linalg.vector_norm(gap, dim=1)
    change = (0.0 if attachments.length is None else attachments.length.to(gap)) - now
    if attachments.speed is not None:
        most = attachments.speed.to(gap) * problem.step.dt.to(gap)[problem.cloth.vertex_scene[a]]
        change = torch.minimum(torch.maximum(change, -most), most)
    return gap * ((now + change) / torch.where(now > 0, now, 1.0)).unsqueeze(1)

"""Springs between cloth vertices: buttons, zipper teeth."""

from __future__ import annotations

from torch import Tensor

from hood.losses.problem import StepProblem, sum_per_scene


class Attachment:
    """Energy [J] of the step's closed attachments, the sum over active edges of ½ k ‖x_a - x_b‖².

    Springs of rest length zero that come with the step, not the garment: opening a button is leaving its edge
    inactive.

    Args:
        stiffness: k [N/m]. At the default the weight of 100 g opens a button by 1 mm.
    """

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
        gap = next_pos[a] - next_pos[b]
        energy = 0.5 * self.stiffness * attachments.active.to(gap.dtype) * (gap * gap).sum(dim=1)
        return sum_per_scene(energy, problem.cloth.vertex_scene[a], problem.num_scenes)

"""Energies of vertices as points with a mass: inertia, weight, springs between two (buttons, zipper teeth), and springs to
places (soft pins)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from hood.energies.problem import StepProblem, sum_per_scene
from hood.energies.term import Energy, Form, Passes, Role


class Gravity(Energy):
    """Gravitational energy [J], the sum over vertices of -m g·x; zero at the local frame's origin."""

    kind: ClassVar[str] = "Gravity"
    role = Role.GRAVITY
    form = Form.WEIGHT

    def applies(self, problem: StepProblem) -> bool:
        return any(problem.gravity.tolist())  # three numbers: soonest on the host

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        height = (next_pos * problem.gravity.to(next_pos)).sum(dim=1)
        return problem.sum_vertices(-problem.cloth.mass * height)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> Tensor:
        """Forces (V, 3) [N]."""
        return problem.cloth.mass[:, None] * problem.gravity.to(problem.state.pos)


class Inertia(Energy):
    """Inertia [J], the sum over vertices of m / (2 dt²) ‖x - x̂‖² with x̂ = x_t + dt v_t.

    Evaluated as ½ m dt² ‖a‖² from the predicted acceleration a = (x - x̂) / dt²: subtracting positions first
    would leave an error of 6e-4 g in float32 at 1/240 s, this form 2e-8 g. A longer ``dt`` of the first step
    lets the cloth relax (HOOD paper, section 3.4: the factor α).
    """

    kind: ClassVar[str] = "Inertia"
    role = Role.INERTIA
    form = Form.MASS

    def applies(self, problem: StepProblem) -> bool:
        return True

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) of the acceleration ``acc`` (V, 3) [m/s²]."""
        dt = problem.vertex_dt.squeeze(1)
        return problem.sum_vertices(0.5 * problem.cloth.mass * dt * dt * (acc * acc).sum(dim=1))

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> Tensor:
        """Masses (V,) [kg]."""
        return problem.cloth.mass


class Attachment(Energy):
    """Energy [J] of the step's closed attachments, the sum over active edges of ½ k ‖x_a - x_b - t‖².

    Springs that come with the step, not the garment: opening a button is leaving its edge inactive. What a pair is drawn to,
    t, is 0 where the attachments have no ``length``; else :func:`attachment_targets`, which is constant within a step.

    Args:
        stiffness: k [N/m]. At the default the weight of 100 g opens a button by 1 mm.
    """

    kind: ClassVar[str] = "Attachment"
    role = Role.ELASTIC
    form = Form.SPRINGS

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

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> Tensor:
        """Spring constants [N/m] (A,) of the step's attachments, 0 where open."""
        attachments = problem.step.attachments
        assert attachments is not None
        return self.stiffness * attachments.active.to(problem.state.pos.dtype)


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


class SoftPins(Energy):
    """Energy [J] of soft pins, the sum over vertices of ½ k ‖x - t‖².

    k → ``step.pin_stiffness`` [N/m] (V,), t → ``step.pin_target`` [m] (V, 3): both come with the step, and t may move with the
    body. Vertices that are held exactly have none.
    """

    kind: ClassVar[str] = "SoftPins"
    role = Role.ELASTIC
    form = Form.BLOCKS

    def applies(self, problem: StepProblem) -> bool:
        return problem.step.pin_stiffness is not None

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        return self.closed_form(problem).energy(next_pos)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> SpringsToPlaces:
        """The springs of a step."""
        stiffness, target = problem.step.pin_stiffness, problem.step.pin_target
        assert stiffness is not None
        assert target is not None
        return SpringsToPlaces(torch.where(problem.cloth.pinned, 0.0, stiffness), target, problem)


@dataclass(frozen=True)
class SpringsToPlaces:
    """The closed form of :class:`SoftPins`; its matrices are the second derivative."""

    stiffness: Tensor  # (V,) N/m
    target: Tensor  # (V, 3) m
    problem: StepProblem

    def energy(self, pos: Tensor) -> Tensor:
        """Energy [J] (B,) at ``pos`` (V, 3)."""
        return self.problem.sum_vertices(0.5 * self.stiffness.to(pos) * (pos - self.target.to(pos)).square().sum(dim=1))

    def derivatives(self, pos: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [N] (V, 3) and second derivative [N/m] (V, 3, 3) at ``pos`` (V, 3)."""
        stiffness = self.stiffness.to(pos)
        matrix = torch.diag_embed(stiffness[:, None].expand(-1, 3))
        return stiffness[:, None] * (pos - self.target.to(pos)), matrix

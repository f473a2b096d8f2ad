"""Forces predicted, positions solved for.

Positions that are predicted vertex by vertex differ a little from one vertex to the next, and stiff cloth answers every such
difference with a large force. Here the network corrects the *force* on every vertex, and one linear solve with the potential's
positive matrix says where all vertices go together. Stiffness resists what differs from vertex to vertex: errors of the forces
hardly move the cloth, while long waves pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, Self

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hood.dynamics.network_step import Held, Moved, NetworkStep
from hood.dynamics.output import OutputSettings, VelocityBaseOutput
from hood.dynamics.passes import Pass, take_passes
from hood.features.local import GLOBAL_LOOK_WIDTHS
from hood.losses.problem import StepProblem

#: One unit of output is this force per mass [m/s²].
_PUSH = 9.81
#: Damping of a vertex in units of its inertia m / dt², and the logarithm up to which outputs change it.
_DAMPING, _RANGE = 0.01, 12.0
#: Global steps are shortened to this [m].
_LONGEST = 2e-2


class Solver(Protocol):
    """Who solves for the global step, see :meth:`hood.solver.local.LocalTerms.solve`."""

    def solve(self, pos: Tensor, force: Tensor, damping: Tensor) -> Tensor: ...


class GlobalStepOutput(VelocityBaseOutput):
    """Corrections to the forces at the base, or at what the pass before led to, and the global step under them.

    The raw output (V, 4) is a force in units of the weight, and the logarithm of how much more than a hundredth of its inertia
    holds a vertex back. At last the cloth is taken out of the body. Zero output is a step of Newton's method without a line
    search.
    """

    width = 4
    feature_sets = ("local",)
    several_passes = True
    look_widths = GLOBAL_LOOK_WIDTHS
    sees_global_step = True

    @classmethod
    def from_settings(cls, settings: OutputSettings, options: Mapping[str, Any]) -> Self:
        return cls(**options)

    def move(self, step: NetworkStep) -> Moved:
        return take_passes(self, step)

    def lead(self, raw: Tensor, start: Pass) -> Tensor:
        """Positions (V, 3) [m] after a pass."""
        return self.positions(start.problem, raw, start.last, start.force, start.held, start.feedback.terms)

    def positions(self, problem: StepProblem, raw: Tensor, last: Tensor, force: Tensor, held: Held, solver: Solver) -> Tensor:
        """Positions (V, 3) [m] after a pass.

        Args:
            raw: (V, 4).
            last: (V, 3) m, where the pass starts.
            force: (V, 3) N, −∂Φ/∂x there.
        """
        mass = problem.cloth.mass
        push = force + _PUSH * mass.unsqueeze(1) * raw[:, :3]
        inertia = mass / problem.vertex_dt.squeeze(1) ** 2
        damping = _DAMPING * inertia * torch.exp((2.0 * raw[:, 3]).clamp(-_RANGE, _RANGE))
        moved: Tensor = _Solve.apply(push, damping, last, solver)
        moved = moved * (_LONGEST / moved.norm(dim=1, keepdim=True).clamp_min(_LONGEST))
        return torch.where(held.free.unsqueeze(1), self.outside(problem, last + moved), held.fixed)


class _Solve(torch.autograd.Function):
    """The solve, with the derivative it would have if it were exact: the matrix is symmetric and a constant."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, damping: Tensor, pos: Tensor, solver: Solver) -> Tensor:
        moved = solver.solve(pos, force, damping)
        ctx.save_for_backward(damping, pos, moved)
        ctx.solver = solver
        return moved

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        damping, pos, moved = ctx.saved_tensors
        adjoint = ctx.solver.solve(pos, grad, damping)
        # ∂A/∂d_i = 1 at (i, i): dd = −λ·u.
        return adjoint, -(adjoint * moved).sum(dim=1), None, None

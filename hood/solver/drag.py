"""Drag of the air at the centroids of faces: energy and derivatives in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hood.losses.problem import StepProblem
from hood.losses.wind import Wind


@dataclass(frozen=True)
class Drag:
    """A drag term on N points; see :class:`hood.losses.wind.DragRows`."""

    normal: Tensor  # (N, 3)
    target: Tensor  # (N, 3) m
    across: Tensor  # (N,) J/m³
    along: Tensor  # (N,) J/m³

    def take(self, rows: Tensor) -> Drag:
        """Those of some points."""
        return Drag(self.normal[rows], self.target[rows], self.across[rows], self.along[rows])

    def energy(self, pos: Tensor) -> Tensor:
        """Energy [J] (N,) at ``pos`` (N, 3)."""
        _, across, size, _ = self._slip(pos)
        return (self.across * across.abs() ** 3 + self.along * size**3) / 3.0

    def derivatives(self, pos: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [N] (N, 3) and second derivative [N/m] (N, 3, 3), which is positive, at ``pos`` (N, 3)."""
        slip, across, size, heading = self._slip(pos)
        pressed, dragged = self.across * across.abs(), self.along * size
        gradient = (pressed * across)[:, None] * self.normal + dragged[:, None] * slip
        matrix = torch.diag_embed(dragged[:, None].expand(-1, 3))
        matrix = matrix + _outer((2.0 * pressed - dragged)[:, None] * self.normal, self.normal)
        return gradient, matrix + _outer(dragged[:, None] * heading, heading)

    def _slip(self, pos: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Slip in the plane (N, 3) [m], slip along the normal (N,), size and heading (N, 3) of the former."""
        slip = pos - self.target
        across = torch.mv(slip * self.normal, slip.new_ones(3))
        slip = slip - across[:, None] * self.normal
        size = torch.mv(slip * slip, slip.new_ones(3)).sqrt()
        return slip, across, size, slip / torch.where(size > 0, size, 1.0)[:, None]


def drag_of(term: Wind, problem: StepProblem) -> Drag:
    """The drag of a term on the faces of a step, at their centroids."""
    return Drag(*term.rows(problem))


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a[:, :, None] * b[:, None, :]

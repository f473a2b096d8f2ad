"""Positions whose edges are as predicted, as nearly as they can be: one linear least-squares solve.

    x = argmin Σ_i w_i/2 |x_i − a_i|² + f_i/2 (n_i·(x_i − a_i))² + Σ_ij k/2 |x_i − x_j − p_ij|²

| symbol | variable | |
|---|---|---|
| a_i | ``anchor`` | m, where vertex i is drawn to, (V, 3) |
| w_i | ``weight`` | N/m, how strongly, > 0, (V,) |
| f_i, n_i | ``firm`` | N/m, how much more strongly along n, ≥ 0, (V,), and unit vectors n (V, 3); left out where None |
| p_ij | ``vector`` | m, what the edge from j to i should be, (N, 3) |
| k | ``stiffness`` | N/m, of every edge |

The matrix is a Laplacian and blocks of single vertices. It is solved by conjugate gradients with the blocks of its diagonal as
preconditioner, as many steps as the size of the mesh asks for: no shape and no branch depends on a value, so that a
CUDA graph can hold it. The derivative is the same solve.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hood.graph.builder import EdgeSet
from hood.native import features as native
from hood.nn.dense import sum_rows
from hood.nn.fixed_gradients import Scenes, Steps, solve

#: Steps of conjugate gradients per square root of the vertices of a scene: a square sheet that hangs from one side is left with
#: a thousandth of the energy, at every resolution. Never fewer than the second number.
STEPS = Steps(2.0, 16)


@dataclass(frozen=True)
class EdgeSystem:
    """The edges of B scenes, which do not touch each other, and what moves."""

    edges: EdgeSet  # its rows list every edge in both directions
    free: Tensor  # (V,) bool; the others stay where they are
    scene: Tensor  # (V,)
    scene_sizes: tuple[int, ...]  # vertices of every scene
    stiffness: float  # N/m

    @cached_property
    def degree(self) -> Tensor:
        """Edges at every vertex, (V,)."""
        return self._spread(self.edges.offsets.diff())

    def neighbours(self, values: Tensor) -> Tensor:
        """Σ_j of ``values`` (V, C) over the neighbours j of every vertex, (V, C)."""
        return self._spread(sum_rows(values, self.edges.senders, self.edges.offsets))

    def sums(self, rows: Tensor) -> Tensor:
        """Sums of ``rows`` (N, C) at the vertices that receive them, (V, C)."""
        return self._spread(sum_rows(rows, self.edges.rows, self.edges.offsets))

    def vectors(self, pos: Tensor) -> Tensor:
        """x_i − x_j of every row, (N, 3), at positions (V, 3)."""
        return pos.index_select(0, self.edges.receivers) - pos.index_select(0, self.edges.senders)

    def _spread(self, values: Tensor) -> Tensor:
        """From the vertices that have an edge to all of them."""
        count = len(self.free)
        if len(values) == count:
            return values
        return values.new_zeros(count, *values.shape[1:]).index_copy(0, self.edges.nodes, values)


class Firm(NamedTuple):
    """By how much more vertices are held along one direction than along the others."""

    weight: Tensor  # (V,) N/m, >= 0
    normal: Tensor  # (V, 3) unit vectors; constants

    def times(self, values: Tensor) -> Tensor:
        """f n (n·v) of ``values`` (V, 3)."""
        return (self.weight.unsqueeze(1) * self.normal) * (self.normal * values).sum(dim=1, keepdim=True)


def fit_edges(
    system: EdgeSystem, start: Tensor, vector: Tensor, anchor: Tensor, weight: Tensor, firm: Firm | None = None
) -> Tensor:
    """The positions x (V, 3) [m] above, solved for from ``start`` (V, 3) [m].

    Differentiable in ``vector``, ``anchor``, ``weight`` and ``firm.weight``, as if the solve were exact. What is not free stays
    at ``start``. Where edges and anchors are those of ``start``, that is the result, to the bit.
    """
    away = anchor - start
    pull = weight.unsqueeze(1) * away
    pull = pull if firm is None else pull + firm.times(away)
    force = pull + system.stiffness * system.sums(vector - system.vectors(start))
    moved: Tensor = _Solve.apply(force, weight, *((None, None) if firm is None else firm), system)
    return start + moved


class _Solve(torch.autograd.Function):
    """u with A u = ``force`` (V, 3) for A = diag(w) + f n nᵀ + k L."""

    @staticmethod
    def forward(
        ctx: Any, force: Tensor, weight: Tensor, firm: Tensor | None, normal: Tensor | None, system: EdgeSystem
    ) -> Tensor:
        along = None if firm is None or normal is None else Firm(firm, normal)
        ctx.solve = compiled_gradients if _is_compiled(system, weight, force) else conjugate_gradients
        moved: Tensor = ctx.solve(system, weight, force, along)
        ctx.save_for_backward(weight, moved, firm, normal)
        ctx.system = system
        return moved

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        weight, moved, firm, normal = ctx.saved_tensors
        along = None if firm is None else Firm(firm, normal)
        adjoint = ctx.solve(ctx.system, weight, grad, along)
        # A symmetric, ∂A/∂w_i = 1 at (i, i) and ∂A/∂f_i = n nᵀ: dw = −λ·u, df = −(λ·n)(u·n).
        of_firm = None if along is None else -(adjoint * normal).sum(dim=1) * (moved * normal).sum(dim=1)
        return adjoint, -(adjoint * moved).sum(dim=1), of_firm, None, None


def conjugate_gradients(system: EdgeSystem, weight: Tensor, force: Tensor, firm: Firm | None = None) -> Tensor:
    """Approximate u (V, 3) with (diag(``weight``) + f n nᵀ + k L) u = ``force`` at free vertices and u = 0 at the others."""
    free = system.free.unsqueeze(1)
    diagonal = (weight + system.stiffness * system.degree.to(weight)).unsqueeze(1)
    inverse = torch.where(free, 1.0 / torch.where(free, diagonal, 1.0), 0.0)
    less = None if firm is None else Firm(firm.weight / (diagonal.squeeze(1) + firm.weight), firm.normal)

    def apply(p: Tensor) -> Tensor:
        # Neighbours that are not free have p = 0; what they would receive is not asked for.
        found = diagonal * p - system.stiffness * system.neighbours(p)
        return torch.where(free, found if firm is None else found + firm.times(p), 0.0)

    def precondition(r: Tensor) -> Tensor:
        return inverse * (r if less is None else r - less.times(r))

    scenes = Scenes(system.scene, system.scene_sizes)
    return solve(apply, precondition, torch.where(free, force, 0.0), scenes, STEPS)


def compiled_gradients(system: EdgeSystem, weight: Tensor, force: Tensor, firm: Firm | None = None) -> Tensor:
    """The same by the compiled library, for numbers in float32 on a CPU; every vertex must have an edge."""
    edges, scenes = system.edges, len(system.scene_sizes)
    steps = torch.tensor([STEPS(size) for size in system.scene_sizes])
    mesh = native.Neighbours(len(force), edges.offsets.data_ptr(), edges.senders.data_ptr())
    u, memory = force.new_empty(len(force), 4), force.new_empty(5, len(force), 4)
    more = (None, None) if firm is None else (firm.weight.contiguous(), firm.normal.contiguous())
    given = weight.contiguous(), *more, force.contiguous(), system.free, system.scene if scenes > 1 else None
    sums = torch.empty(3, scenes, dtype=torch.float64)
    native.call("fit", mesh, *given, scenes, steps, system.stiffness, u, sums, memory)
    return u[:, :3]


def _is_compiled(system: EdgeSystem, *values: Tensor) -> bool:
    return len(system.edges.nodes) == len(system.free) and native.applies(*values)

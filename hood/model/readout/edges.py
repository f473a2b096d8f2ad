"""Edges predicted, positions solved for.

To move a garment by a long wave without stretching it, positions have to be right to a thousandth of the move; the edges of the
same move need not be. An error in the edges that differs from one to the next is averaged away by the solve, and its cost does
not grow as meshes get finer.

Cloth slides along a body that it cannot enter: near the body vertices are held towards it and across at strengths of their own.
The network is shown the step of all vertices together. Its matrix knows nothing of a body until cloth touches it, so for that
view vertices near the body are held back.

Positions whose edges are as predicted, as nearly as they can be: one linear least-squares solve.

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

from hood.cloth.cloth import Cloth
from hood.contact.contact import Contact
from hood.contact.sample_points import chord_error
from hood.energies.problem import StepProblem
from hood.model.features.inputs import rest_vectors
from hood.model.graph.builder import MESH, EdgeSet, Graph
from hood.model.readout.network_step import Dirichlet, Moved, NetworkStep
from hood.model.readout.output import DEEPEST, VelocityBaseOutput
from hood.native import features as native
from hood.tensors.conjugate_gradients import Scenes, Steps, solve
from hood.tensors.dense import is_followed, sum_rows

#: Steps of conjugate gradients per square root of the vertices of a scene: a square sheet that hangs from one side is left with
#: a thousandth of the energy, at every resolution. Never fewer than the second number.
_STEPS = Steps(2.0, 16)


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
    if is_followed():
        return start + conjugate_gradients(system, weight, force, firm)
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
    return solve(apply, precondition, torch.where(free, force, 0.0), scenes, _STEPS)


def compiled_gradients(system: EdgeSystem, weight: Tensor, force: Tensor, firm: Firm | None = None) -> Tensor:
    """The same by the compiled library, for numbers in float32 on a CPU; every vertex must have an edge."""
    edges, scenes = system.edges, len(system.scene_sizes)
    steps = torch.tensor([_STEPS(size) for size in system.scene_sizes])
    mesh = native.Neighbours(len(force), edges.offsets.data_ptr(), edges.senders.data_ptr())
    u, memory = force.new_empty(len(force), 4), force.new_empty(5, len(force), 4)
    more = (None, None) if firm is None else (firm.weight.contiguous(), firm.normal.contiguous())
    given = weight.contiguous(), *more, force.contiguous(), system.free, system.scene if scenes > 1 else None
    sums = torch.empty(3, scenes, dtype=torch.float64)
    native.call("fit", mesh, *given, scenes, steps, system.stiffness, u, sums, memory)
    return u[:, :3]


def _is_compiled(system: EdgeSystem, *values: Tensor) -> bool:
    return len(system.edges.nodes) == len(system.free) and native.applies(*values)


#: Stiffness [N/m] of the edges in the solve, and of the anchors of vertices that touch the body where the network does not ask
#: for another one: towards the body and along it, where cloth slides.
_STIFFNESS, _TOWARDS, _ALONG = 40.0, 20.0, 5.0
#: Stiffness [N/m] that holds vertices near the body back in the global step that the network is shown.
_VIEW = 8.0
#: Length of edges [m] for which anchors are that stiff. They are a stiffness per area: with one per vertex the body would hold
#: a mesh of 48,000 vertices eleven times as tightly as one of 4,400, while a sheet of edges is as stiff in both.
_EDGE = 17e-3
#: Share of inertia, m / dt², in the anchors of all vertices: it decides where nothing else does.
_INERTIA = 0.1
#: Anchors are up to exp(±this) times as strong as they are by default.
_RANGE = 4.0
#: Within this distance [m] of where contact sets in vertices are anchored, the nearer the more.
_NEAR = 5e-3
#: One unit of output turns an edge by this share of its rest length, and stretches it by that one.
_TURN, _STRETCH = 0.1, 0.01
#: Shorter edges [m] have no direction.
_SHORTEST = 1e-9


class EdgeOutput(VelocityBaseOutput):
    """Corrections to the edges of the base, and one linear solve for the positions.

    The raw output of an edge (N, 5) turns its vector, takes a share of the way to its rest length, and stretches it by
    hundredths. That of a vertex (V, 5) is a displacement of its anchor in units of ``scale``, and the logarithms of how much
    more than by default it is held there, along the body's normal and across it, if it is near the body. Zero output is the
    base. At last the cloth is taken out of the body.

    Everything turns with the world if the output does, and lengths are relative to the edges: the same at every resolution.
    """

    width = 5
    edge_width = 5
    feature_sets = ("physical", "local")
    sees_global_step = True
    view_steps = Steps(1.0, 16)

    def move(self, step: NetworkStep) -> Moved:
        raw = step.network.with_edges(step.graph, step.nodes, step.edges)
        return Moved(self.positions(step.problem, step.graph, step.base, *raw, step.held))

    def positions(
        self, problem: StepProblem, graph: Graph, base: Tensor, raw: Tensor, edge_raw: Tensor, held: Dirichlet
    ) -> Tensor:
        """Positions (V, 3) [m] at t + 1.

        Args:
            problem: with its contact, as the network saw it.
            graph: its mesh edges, attachments included, are solved for.
            base: (V, 3) m.
            raw: (V, 5) of the vertices.
            edge_raw: (N, 5) of the rows of the graph's mesh edges.
        """
        cloth, free = problem.cloth, held.free.unsqueeze(1)
        system = EdgeSystem(graph.edge_sets[MESH], held.free, cloth.vertex_scene, cloth.scene_sizes, _STIFFNESS)
        start = torch.where(free, base, held.fixed)
        vector = self.vectors(problem, graph, system.vectors(start), edge_raw)
        anchor = start + self.scale * raw[:, :3]
        pos = fit_edges(system, start, vector, anchor, *self.weights(problem, start, raw[:, 3:]))
        return torch.where(free, self.outside(problem, pos), held.fixed)

    def vectors(self, problem: StepProblem, graph: Graph, vector: Tensor, raw: Tensor) -> Tensor:
        """What the edges (N, 3) [m] of the base become: the same in both directions, but for the sign."""
        edges, rest = graph.edge_sets[MESH], rest_vectors(problem.cloth, graph, MESH).norm(dim=1, keepdim=True)
        other = raw.index_select(0, edges.reverse)
        turned = vector + 0.5 * _TURN * rest * (raw[:, :3] - other[:, :3])
        share, stretch = (0.5 * (raw[:, 3:] + other[:, 3:])).split(1, dim=1)
        now = vector.norm(dim=1, keepdim=True)
        # Attachments have a length of their own only by chance, from how the pieces lie at rest.
        goal = torch.where((edges.source < graph.num_mesh_edges).unsqueeze(1), rest, now)
        length = (now + share * (goal - now) + _STRETCH * goal * stretch).clamp_min(0.0)
        return turned * (length / turned.norm(dim=1, keepdim=True).clamp_min(_SHORTEST))

    def weights(self, problem: StepProblem, start: Tensor, raw: Tensor) -> tuple[Tensor, Firm | None]:
        """How strongly vertices are held at their anchors, (V,) [N/m], and how much more towards the body."""
        cloth, contact = problem.cloth, problem.contact
        inertia = _INERTIA * cloth.mass / problem.vertex_dt.squeeze(1) ** 2
        if contact is None:
            return inertia, None
        near = self.held_area(problem, start)
        towards, along = torch.exp(raw.clamp(-_RANGE, _RANGE)).unbind(dim=1)
        least = _ALONG * torch.minimum(along, towards * (_TOWARDS / _ALONG))
        return inertia + near * least, Firm(near * (_TOWARDS * towards - least), contact.next_normal)

    def nearness(self, problem: StepProblem, pos: Tensor) -> Tensor:
        """From 0, a vertex (V,) that does not reach the body from ``pos``, to 1, one that touches it."""
        contact = problem.contact
        if contact is None:
            return torch.zeros_like(pos[:, 0])
        gap = contact.next_dist(pos) - self.clearance - chord_error(problem.cloth, contact, problem.state.pos)
        return (1.0 - gap / _NEAR).clamp(0.0, 1.0) * contact.valid

    def base(self, problem: StepProblem) -> Tensor:
        """Taken out of the body as the result is."""
        return self.outside(problem, super().base(problem))

    def least_distance(self, problem: StepProblem, contact: Contact) -> Tensor:
        """Where contact sets in, less a depth that goes with the length of the edges: contact pushes every vertex with 3 w p²,
        and those of fine meshes weigh less."""
        cloth = problem.cloth
        return self.clearance + chord_error(cloth, contact, problem.state.pos) - DEEPEST * _area(cloth).clamp_max(1.0).sqrt()

    def held_back(self, problem: StepProblem, base: Tensor) -> Tensor:
        return _VIEW * self.held_area(problem, base)

    def held_area(self, problem: StepProblem, pos: Tensor) -> Tensor:
        """Part of :func:`_area` (V,) by which the body holds vertices at ``pos`` (V, 3) [m], all of it where they touch it."""
        return self.nearness(problem, pos) * _area(problem.cloth)


def _area(cloth: Cloth) -> Tensor:
    """Area (V,) that a vertex stands for, in units of that in a mesh of edges as long as :data:`_EDGE`."""
    return cloth.edge_length_sq / _EDGE**2

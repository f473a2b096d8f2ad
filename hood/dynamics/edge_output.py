"""Edges predicted, positions solved for.

To move a garment by a long wave without stretching it, positions have to be right to a thousandth of the move; the edges of the
same move need not be. An error in the edges that differs from one to the next is averaged away by the solve, and its cost does
not grow as meshes get finer.

Cloth slides along a body that it cannot enter: near the body vertices are held towards it and across at strengths of their own.
The network is shown the step of all vertices together. Its matrix knows nothing of a body until cloth touches it, so for that
view vertices near the body are held back.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hood.dynamics.network_step import Held, Moved, NetworkStep
from hood.dynamics.output import DEEPEST, VelocityBaseOutput
from hood.graph.builder import MESH, Graph
from hood.losses.problem import StepProblem
from hood.nn.edge_solve import EdgeSystem, Firm, fit_edges
from hood.nn.fixed_gradients import Steps
from hood.scene.cloth import Cloth
from hood.scene.contact import Contact
from hood.scene.reach import sag

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
    """Corrections to the edges of the base, and one linear solve for the positions (:mod:`hood.nn.edge_solve`).

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

    def positions(self, problem: StepProblem, graph: Graph, base: Tensor, raw: Tensor, edge_raw: Tensor, held: Held) -> Tensor:
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
        edges, rest_pos = graph.edge_sets[MESH], problem.cloth.rest_pos
        rest = (rest_pos.index_select(0, edges.receivers) - rest_pos.index_select(0, edges.senders)).norm(dim=1, keepdim=True)
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
        gap = contact.next_dist(pos) - self.clearance - sag(problem.cloth, contact, problem.state.pos)
        return (1.0 - gap / _NEAR).clamp(0.0, 1.0) * contact.valid

    def base(self, problem: StepProblem) -> Tensor:
        """Taken out of the body as the result is."""
        return self.outside(problem, super().base(problem))

    def least_distance(self, problem: StepProblem, contact: Contact) -> Tensor:
        """Where contact sets in, less a depth that goes with the length of the edges: contact pushes every vertex with 3 w p²,
        and those of fine meshes weigh less."""
        cloth = problem.cloth
        return self.clearance + sag(cloth, contact, problem.state.pos) - DEEPEST * _area(cloth).clamp_max(1.0).sqrt()

    def held_back(self, problem: StepProblem, base: Tensor) -> Tensor:
        return _VIEW * self.held_area(problem, base)

    def held_area(self, problem: StepProblem, pos: Tensor) -> Tensor:
        """Part of :func:`_area` (V,) by which the body holds vertices at ``pos`` (V, 3) [m], all of it where they touch it."""
        return self.nearness(problem, pos) * _area(problem.cloth)


def _area(cloth: Cloth) -> Tensor:
    """Area (V,) that a vertex stands for, in units of that in a mesh of edges as long as :data:`_EDGE`."""
    return cloth.edge_length_sq / _EDGE**2

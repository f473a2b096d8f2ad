"""What feature groups read: one step's cloth, state, obstacle, contact and graph, with the look-ups they share."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import Obstacle, State, StepInput
from hood.contact.contact import Contact
from hood.mesh import geometry
from hood.mesh.closest_point.search import build_incidence
from hood.model.graph.builder import BODY, LAYERS, MESH, EdgeSet, Graph
from hood.model.graph.static_shapes import FixedGraph


@dataclass(frozen=True)
class EdgeRows:
    """The cloth edge sets of a graph stacked into one table, so that a group computes all of them at once."""

    senders: Tensor  # (N,)
    receivers: Tensor  # (N,)
    scene: Tensor  # (N,)
    segment: Tensor  # (N,) one number per pair of edge set and scene
    num_segments: int
    fabric: Tensor  # (N, 3) lame_mu [Pa], lame_lambda [Pa], bending_stiffness [J]
    kept: dict[str, Tensor] = field(default_factory=dict)

    def once(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        """What ``compute`` gave the first time: columns of the cloth at rest, the same in every step."""
        if name not in self.kept:
            self.kept[name] = compute()
        return self.kept[name]


#: The last tables made, with the tensors they were made from: those of a cloth do not change during a rollout.
_recent_rows: deque[tuple[list[tuple[Tensor, int]], EdgeRows]] = deque(maxlen=2)


@dataclass(frozen=True)
class Inputs:
    """Everything a feature group may read.

    Args:
        base_pos: (V, 3) [m] the positions the network's output is added to, where the model has such a base.
        residual: (V, 3) [m/s²] acceleration that the potential's gradient at the base asks for.
        local_step: (V, 3) [m] what every vertex alone would do about it, see :mod:`hood.solver.vertex.block_jacobi`.
        wide_residual: (V, 6) [m/s²] the residual of small and of large neighbourhoods, see :mod:`hood.model.features.local`.
        global_step: (V, 3) [m] what all vertices together would do about it, see :mod:`hood.solver.vertex.block_jacobi`; None
            in models that do not look at it.
        timestep: (B,) [s] value of the timestep feature; None for the step's dt. It is how the relaxing first step of
            a rollout is told to the network (paper, α in section 4.3).
        edge_rows: the table :attr:`edges` where it is known already; made or recognised from an earlier step otherwise.
    """

    cloth: Cloth  # topology, rest shape and fabric
    state: State  # at t
    step: StepInput  # what is prescribed for t → t + 1
    contact: Contact | None  # with the body, where a group or the output needs it
    graph: Graph  # its edges, and the vertices of the body near the cloth
    base_pos: Tensor | None = None
    residual: Tensor | None = None
    local_step: Tensor | None = None
    wide_residual: Tensor | None = None
    timestep: Tensor | None = None
    edge_rows: EdgeRows | None = None
    global_step: Tensor | None = None

    @property
    def num_cloth(self) -> int:
        """V."""
        return self.graph.num_cloth

    @property
    def num_body(self) -> int:
        """W_active, the number of vertices of the body near the cloth."""
        return self.graph.body_vertex.shape[0]

    @property
    def obstacle(self) -> Obstacle:
        """The body, demanded."""
        if self.step.obstacle is None:
            raise ValueError("features: the graph has body nodes but the step has no obstacle; build the graph from this step")
        return self.step.obstacle

    @cached_property
    def base(self) -> Tensor:
        """``base_pos``, demanded."""
        if self.base_pos is None:
            raise ValueError("features: these features are relative to a base guess; pass Inputs(base_pos=…)")
        return self.base_pos

    @cached_property
    def node_scene(self) -> Tensor:
        """Scene of every graph node, (V + W_active,)."""
        if self.num_body == 0:
            return self.cloth.vertex_scene
        return torch.cat([self.cloth.vertex_scene, self.obstacle.vertex_scene[self.graph.body_vertex]])

    @cached_property
    def node_timestep(self) -> Tensor:
        """Timestep feature of every graph node [s], (V + W_active,)."""
        timestep = self.step.dt if self.timestep is None else self.timestep
        return timestep.to(self.state.pos.dtype)[self.node_scene]

    def edge_timestep(self, receivers: Tensor) -> Tensor:
        """The same of edges with these ``receivers`` (N,): (N, 1)."""
        if self.cloth.num_scenes == 1:
            return self.node_timestep[:1].unsqueeze(1).expand(len(receivers), 1)
        return self.node_timestep.index_select(0, receivers).unsqueeze(1)

    @cached_property
    def vertex_dt(self) -> Tensor:
        """True dt of every cloth vertex [s], (V, 1): turns velocities into displacements per frame."""
        return self.step.dt.to(self.state.pos.dtype)[self.cloth.vertex_scene].unsqueeze(1)

    @cached_property
    def body_normal(self) -> Tensor:
        """Area-weighted vertex normals of the active body vertices at t, (W_active, 3)."""
        return self._body_normals(self.obstacle.pos)

    @cached_property
    def body_next_normal(self) -> Tensor:
        """The same at t + 1."""
        return self._body_normals(self.obstacle.next_pos)

    @cached_property
    def cloth_normal(self) -> Tensor:
        """Area-weighted vertex normals of the cloth at t, (V, 3)."""
        pos, faces = self.state.pos, self.cloth.faces
        if isinstance(self.graph, FixedGraph):
            return geometry.vertex_normals(pos, faces)
        incidence = build_incidence(faces, len(pos))
        return geometry.normals_of_fans(pos, faces, incidence.around, incidence.first)

    def _body_normals(self, pos: Tensor) -> Tensor:
        faces = self.obstacle.faces
        if isinstance(self.graph, FixedGraph):
            # Faces that may be data of a step that is traced: nothing to look up a table with.
            return self.body(geometry.vertex_normals(pos, faces))
        incidence = build_incidence(faces, len(pos))
        return geometry.normals_of_fans(pos, faces, incidence.around, incidence.first, self.graph.body_vertex)

    def body(self, values: Tensor) -> Tensor:
        """Rows of an obstacle field (W, …) at the active body vertices."""
        return values.index_select(0, self.graph.body_vertex)

    @property
    def body_edges(self) -> EdgeSet:
        """Those from the body to the cloth."""
        return self.graph.edge_sets[BODY]

    @property
    def layer_edges(self) -> EdgeSet:
        """Those between layers of cloth."""
        return self.graph.edge_sets[LAYERS]

    @cached_property
    def cloth_sets(self) -> tuple[str, ...]:
        """The static ones."""
        return tuple(name for name in self.graph.edge_sets if name not in (BODY, LAYERS))

    @cached_property
    def edges(self) -> EdgeRows:
        """All cloth edge sets in the order of :attr:`cloth_sets`."""
        if self.edge_rows is not None:
            return self.edge_rows
        cloth, sets = self.cloth, [self.graph.edge_sets[name] for name in self.cloth_sets]
        of_sets = [x for s in sets for x in (s.senders, s.receivers, s.source)]
        of_cloth = [cloth.rest_pos, cloth.vertex_scene, cloth.vertex_fabric, cloth.edge_fabric]
        of_cloth += [cloth.mass, cloth.pinned, self.graph.node_level, *([] if cloth.flat is None else [cloth.flat])]
        if torch.is_inference_mode_enabled() or any(x.requires_grad for x in of_cloth):
            return self.make_edge_rows()  # of no use to a later step: inference tensors, or a graph already walked
        key = [(x, x._version) for x in of_sets + of_cloth]
        for known, rows in _recent_rows:
            if len(known) == len(key) and all(a is b and i == j for (a, i), (b, j) in zip(known, key, strict=True)):
                return rows
        _recent_rows.append((key, self.make_edge_rows()))
        return _recent_rows[-1][1]

    @property
    def rest(self) -> Tensor:
        """(N, 3) m: all cloth edges at rest, see :func:`rest_vectors`."""
        return self.edges.once(
            "rest", lambda: torch.cat([rest_vectors(self.cloth, self.graph, name) for name in self.cloth_sets])
        )

    def make_edge_rows(self) -> EdgeRows:
        """The table :attr:`edges`, made anew."""
        sets = [self.graph.edge_sets[name] for name in self.cloth_sets]
        senders, receivers = torch.cat([s.senders for s in sets]), torch.cat([s.receivers for s in sets])
        scene = self.cloth.vertex_scene[receivers]
        number = torch.cat([torch.full_like(s.senders, i) for i, s in enumerate(sets)])
        segment = number * self.cloth.num_scenes + scene
        return EdgeRows(
            senders=senders,
            receivers=receivers,
            scene=scene,
            segment=segment,
            num_segments=len(sets) * self.cloth.num_scenes,
            fabric=torch.cat([self._fabric(name) for name in self.cloth_sets]),
        )

    def _fabric(self, name: str) -> Tensor:
        """Fabric per edge: the mesh edge's own where it is one, else the mean of its two vertices."""
        edges = self.graph.edge_sets[name]
        ends = 0.5 * (self.cloth.vertex_fabric[edges.senders] + self.cloth.vertex_fabric[edges.receivers])
        if name != MESH or edges.num_edges == 0:
            return ends
        own = (edges.source < self.graph.num_mesh_edges).unsqueeze(1)
        return torch.where(own, self.cloth.edge_fabric[edges.source.clamp_max(self.graph.num_mesh_edges - 1)], ends)


def rest_vectors(cloth: Cloth, graph: Graph, name: str) -> Tensor:
    """(N, 3) m: the edges of a set at rest, from receiver to sender; those of a mesh are as long as in its flat pattern."""
    edges, pos = graph.edge_sets[name], cloth.rest_pos
    vector = pos.index_select(0, edges.senders) - pos.index_select(0, edges.receivers)
    if cloth.flat is None or name != MESH or edges.num_edges == 0:
        return vector
    own, last = (edges.source < graph.num_mesh_edges).unsqueeze(1), graph.num_mesh_edges - 1
    length = cloth.rest_length.index_select(0, edges.source.clamp_max(last)).unsqueeze(1)
    return torch.where(own, vector * (length / vector.norm(dim=1, keepdim=True)), vector)

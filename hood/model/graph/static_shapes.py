"""The graph of one step in arrays whose sizes do not depend on the positions, built without waiting for the device.

:func:`hood.model.graph.builder.build_graph` gives body edges exactly as many rows as there are; their number changes every step
and has to be known on the host. Here they get a fixed :class:`Capacity`. Places that no edge fills are edges from a spare
body node to itself: it is a node of the graph that no other node hears of, so what is computed there changes nothing.
A step that needs more places than it has loses edges; :class:`FixedGraph` counts them, so that whoever reads the result
can tell and repeat the step with more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from hood.cloth.state import Attachments, Obstacle
from hood.mesh.closest_point.vertices import Nearest
from hood.model.graph.builder import BODY, LAYERS, MESH, EdgeSet, Graph, StaticGraph, Subset, mesh_set, set_level
from hood.tensors.batch import gather_true

#: Capacities are multiples of this.
_UNIT = 64


@dataclass(frozen=True)
class Capacity:
    """Places of a fixed graph; the last of each is spare and stands for all places that are not filled.

    Args:
        edges: places for (undirected) body edges.
        vertices: places for body vertices that carry one.
        faces: places for body faces that every cloth vertex is tested against, where there are any; none of them spare.
    """

    edges: int
    vertices: int
    faces: int = 0

    def __post_init__(self) -> None:
        if self.edges < 1 or self.vertices < 1 or self.faces < 0:
            raise ValueError(
                f"capacity is {self.edges} edges, {self.vertices} vertices and {self.faces} faces; the first two need at least "
                "the spare one, 1, the last is at least 0"
            )

    def holds(self, counts: tuple[int, int, int]) -> bool:
        """Whether ``counts`` edges and vertices fit beside the spare places, and the faces into theirs."""
        return counts[0] < self.edges and counts[1] < self.vertices and counts[2] <= self.faces


def capacity_for(counts: tuple[int, int, int], limits: tuple[int, int, int], headroom: float = 0.25) -> Capacity:
    """Room for ``counts`` body edges, vertices and faces and ``headroom`` times as many more.

    Args:
        limits: most there can ever be: cloth vertices, the smaller of cloth and body vertices, and body faces.
    """
    room = [min(_round_up((1 + headroom) * count + 1), most + 1) for count, most in zip(counts, limits, strict=True)]
    # Few bodies have such faces, and all of them are tested at once: no place more than needed.
    return Capacity(room[0], room[1], min(counts[2], limits[2]))


@dataclass(frozen=True)
class StaticLayout:
    """What a fixed graph knows before the step. Make it with :func:`lay_out`."""

    static: StaticGraph
    edge_sets: dict[str, EdgeSet]  # the cloth's, attachments that are closed included
    capacity: Capacity
    num_deeper: tuple[int, ...]  # cloth nodes on level l or deeper, for every level that the network works on


@dataclass(frozen=True)
class FixedGraph(Graph):
    """A graph with places to spare. ``body_vertex`` holds ``Capacity.vertices`` entries, those behind the active ones mean
    nothing; ``num_found`` (2,) counts the body edges and active body vertices that there are, with or without a place.

    Its body edge set is sorted by ``local_receivers``; ``nodes`` begins with the places' cloth nodes and lists the spare
    node once for every place that is not filled.
    """

    num_found: Tensor

    def filled(self) -> Filled:
        """Which rows of its tables are of nodes and edges that there are."""
        num_edges, num_vertices = self.num_found.unbind()
        device, half = self.node_level.device, self.edge_sets[BODY].num_edges // 2
        body = torch.arange(len(self.body_vertex), device=device) < num_vertices
        # The filled places come first, as cloth's edges and, sorted by body node, as the body's.
        edges = torch.arange(half, device=device) < num_edges
        num_cloth_edges = sum(edge_set.num_edges for name, edge_set in self.edge_sets.items() if name not in (BODY, LAYERS))
        return Filled(
            torch.cat([torch.ones_like(self.node_level, dtype=torch.bool), body]),
            torch.ones(num_cloth_edges, dtype=torch.bool, device=device),
            torch.cat([edges, edges]),
        )


class Filled(NamedTuple):
    """Rows (N,) bool of the tables of nodes, cloth edges and body edges that are not spare; None: all of them."""

    nodes: Tensor | None
    edges: Tensor | None
    body_edges: Tensor | None


@dataclass(frozen=True)
class _Places:
    """Body edges in K places: place p is the edge between graph node ``cloth[p]`` and body node ``body[p]``.

    ``order`` lists the places by body node and then cloth node, and ``key`` their body nodes in that order.
    """

    cloth: Tensor  # (K,)
    body: Tensor  # (K,) 0 … C − 1
    order: Tensor  # (K,)
    key: Tensor  # (K,) ascending


def lay_out(static: StaticGraph, capacity: Capacity, attachments: Attachments | None = None) -> StaticLayout:
    """Sizes of the graphs of steps that have these ``attachments``. Reads values from the device: not for within a step."""
    sets = dict(static.edge_sets)
    if MESH in sets:
        sets[MESH] = mesh_set(static, attachments, None)
    depth = max((set_level(name) for name in static.edge_sets), default=0)
    deeper = torch.stack([(static.node_level >= level).sum() for level in range(depth + 1)]).tolist()
    return StaticLayout(static, sets, capacity, tuple(deeper))


def build_fixed_graph(layout: StaticLayout, obstacle: Obstacle | None, nearest: Nearest | None, radius: float) -> FixedGraph:
    """The graph that :func:`hood.model.graph.builder.build_graph` builds, with places to spare.

    Args:
        layout: see :func:`lay_out`.
        obstacle: tells which body vertices are omitted.
        nearest: nearest body vertices of the cloth's; None without a body.
        radius: reach of body edges [m].
    """
    if obstacle is None or nearest is None:
        return _without_body(layout)
    static, capacity = layout.static, layout.capacity
    num_cloth, size = static.num_cloth, capacity.edges
    near = nearest.dist < radius
    if obstacle.omitted is not None:
        near = near & ~obstacle.omitted.index_select(0, nearest.vertex)
    used, body_node = _active_vertices(near, nearest.vertex, len(obstacle.pos), capacity.vertices)
    cloth_node = gather_true(near, size)
    body = functional.pad(body_node, (0, 1), value=capacity.vertices - 1).index_select(0, cloth_node)
    key, order = body.sort(stable=True)
    spare = num_cloth + capacity.vertices - 1
    places = _Places(torch.where(cloth_node < num_cloth, cloth_node, spare), body, order, key)
    subsets = {0: Subset(_edges_of(places, num_cloth, capacity.vertices), None)}
    level = functional.pad(static.node_level, (0, 1), value=-1).index_select(0, cloth_node)
    for least, count in enumerate(layout.num_deeper[1:], start=1):
        subsets[least] = _deeper(places, level >= least, min(size, count + 1), num_cloth, capacity.vertices)
    return FixedGraph(
        num_cloth=num_cloth,
        body_vertex=gather_true(used, capacity.vertices).clamp_max(len(obstacle.pos) - 1),
        edge_sets={**layout.edge_sets, BODY: subsets[0].edges},
        body_subsets=subsets,
        node_level=static.node_level,
        num_mesh_edges=static.mesh_edges.shape[0],
        num_found=torch.stack([near.sum(), used.sum()]),
    )


def _without_body(layout: StaticLayout) -> FixedGraph:
    static = layout.static
    none = static.node_level.new_zeros(0)
    body = EdgeSet(none, none, none, none, none, none, none, static.node_level.new_zeros(1))
    return FixedGraph(
        num_cloth=static.num_cloth,
        body_vertex=none,
        edge_sets={**layout.edge_sets, BODY: body},
        body_subsets={level: Subset(body, None) for level in range(len(layout.num_deeper))},
        node_level=static.node_level,
        num_mesh_edges=static.mesh_edges.shape[0],
        num_found=static.node_level.new_zeros(2),
    )


def _active_vertices(near: Tensor, vertex: Tensor, num_vertices: int, size: int) -> tuple[Tensor, Tensor]:
    """Body vertices that carry an edge, (W,) bool, and the body node (V,) of every cloth node's edge: the number of
    active vertices before its own; ``size`` − 1 where there is no edge or no place."""
    count = vertex.new_zeros(num_vertices + 1)  # the last one collects the edges that there are not
    count = count.scatter(0, torch.where(near, vertex, num_vertices), 1)[:num_vertices]
    rank = (count.cumsum(0) - 1).index_select(0, vertex)
    return count > 0, torch.where(near, rank, size - 1).clamp_max(size - 1)


def _edges_of(places: _Places, num_cloth: int, num_body: int) -> EdgeSet:
    """Both directions: rows 0 … K − 1 lead to the cloth nodes, one each, rows K … 2K − 1 to the body nodes."""
    size, device = places.cloth.shape[0], places.cloth.device
    place, body = torch.arange(size, device=device), torch.arange(num_body + 1, device=device)
    nodes = torch.cat([places.cloth, num_cloth + body[:-1]])
    receivers, senders = torch.cat([place, size + places.key]), torch.cat([size + places.body, places.order])
    # Of a part the order names spare places once; the others are found at the end, where all are spare.
    position = torch.full_like(place, size - 1).scatter(0, places.order, place)
    return EdgeSet(
        senders=nodes.index_select(0, senders),
        receivers=nodes.index_select(0, receivers),
        source=torch.cat([place, places.order]),
        reverse=torch.cat([size + position, places.order]),
        nodes=nodes,
        local_senders=senders,
        local_receivers=receivers,
        offsets=torch.cat([place, size + torch.searchsorted(places.key, body)]),
    )


def _deeper(places: _Places, keep: Tensor, size: int, num_cloth: int, num_body: int) -> Subset:
    """The places ``keep`` (K,) in ``size`` places of their own; the spare one stays spare."""
    last = places.cloth.shape[0] - 1
    chosen = gather_true(keep, size).clamp_max(last)
    # Their order among the body nodes is that of the whole set: no second sort.
    in_order = gather_true(keep.index_select(0, places.order), size).clamp_max(last)
    renumbered = torch.where(keep, keep.cumsum(0) - 1, size - 1)
    part = _Places(
        cloth=places.cloth.index_select(0, chosen),
        body=places.body.index_select(0, chosen),
        order=renumbered.index_select(0, places.order.index_select(0, in_order)),
        key=places.key.index_select(0, in_order),
    )
    rows = torch.cat([chosen, last + 1 + in_order])
    return Subset(_edges_of(part, num_cloth, num_body), rows)


def _round_up(count: float) -> int:
    return -(-int(count + 1) // _UNIT) * _UNIT

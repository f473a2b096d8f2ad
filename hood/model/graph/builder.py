"""The graph of one step: static mesh and coarse edges, and the edges that change every step: to the body, between layers of
cloth that are near each other, and attachments.

Which edge sets every processor step works on, written as a string such as ``3x(mesh+coarse0) 3x(coarse0)``; ``|`` ends a
pass, whose prediction is decoded before the next one begins.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import Attachments, Obstacle, StepInput
from hood.mesh.closest_point.vertices import Nearest
from hood.mesh.topology import Rings, connected_components
from hood.model.graph.hierarchy import Hierarchy
from hood.tensors.batch import made_of

MESH = "mesh"
BODY = "body"
LAYERS = "layers"
#: Vertices of one piece of cloth that are nearer at rest than so many radii lie side by side, however fine the mesh is: they
#: are no layers.
_FLAT = 1.5


def coarse_name(level: int) -> str:
    """Name of the coarse set c_k: ``coarse0`` is level 1."""
    return f"coarse{level}"


def set_level(name: str) -> int:
    """Level of a cloth edge set: 0 for the mesh, k + 1 for ``coarse{k}``."""
    return int(name.removeprefix("coarse")) + 1 if name.startswith("coarse") else 0


@dataclass(frozen=True)
class EdgeSet:
    """Directed edges, both directions of every undirected edge, sorted by receiver and then sender.

    Sums over the edges of a node are sums over consecutive rows (``offsets``). The network works on the M nodes that
    have an edge; ``nodes`` maps them to the graph's nodes and the ``local_*`` indices point into them. Row
    ``reverse[i]`` is row i in the other direction, so ``reverse`` also lists the edges in the order of their senders.
    """

    senders: Tensor  # (N,) graph nodes
    receivers: Tensor  # (N,) graph nodes, ascending
    source: Tensor  # (N,) row of the undirected edge in the list the set was built from
    reverse: Tensor  # (N,)
    nodes: Tensor  # (M,) ascending
    local_senders: Tensor  # (N,) into nodes
    local_receivers: Tensor  # (N,) into nodes, ascending
    offsets: Tensor  # (M + 1,) rows of node m: offsets[m] … offsets[m + 1]

    @cached_property
    def rows(self) -> Tensor:
        """0 … N − 1."""
        return torch.arange(self.num_edges, device=self.senders.device)

    @cached_property
    def ends(self) -> Tensor:
        """2 · receiver and 2 · sender + 1 of every edge, (N, 2): rows of a table of two values per node."""
        return torch.stack([2 * self.local_receivers, 2 * self.local_senders + 1], dim=1)

    def spans(self, length: int) -> list[tuple[slice, Tensor]]:
        """For every ``length`` consecutive rows the nodes that receive them, and their offsets within those rows."""
        if length not in self._spans:
            self._spans[length] = self._find_spans(length)
        return self._spans[length]

    @cached_property
    def _spans(self) -> dict[int, list[tuple[slice, Tensor]]]:
        return {}

    def _find_spans(self, length: int) -> list[tuple[slice, Tensor]]:
        count = self.num_edges
        if length >= count:
            return [(slice(0, self.nodes.shape[0]), self.offsets)]
        starts = list(range(0, count, length))
        stops = [min(start + length, count) for start in starts]
        first = self.local_receivers[starts].tolist()
        last = self.local_receivers[[stop - 1 for stop in stops]].tolist()
        return [
            (slice(a, b + 1), self.offsets[a : b + 2].clamp(start, stop) - start)
            for a, b, start, stop in zip(first, last, starts, stops, strict=True)
        ]

    @property
    def num_edges(self) -> int:
        return self.senders.shape[0]


@dataclass(frozen=True)
class Subset:
    """Part of an edge set: ``edges`` are its rows ``rows`` (None: all of them)."""

    edges: EdgeSet
    rows: Tensor | None


@dataclass(frozen=True)
class StaticGraph:
    """What does not change during a rollout; built once per cloth (or batch of cloths)."""

    num_cloth: int
    mesh_edges: Tensor  # (E, 2) undirected
    edge_sets: dict[str, EdgeSet]  # mesh and the coarse sets the network uses
    node_level: Tensor  # (V,)


@dataclass(frozen=True)
class Graph:
    """Nodes 0 … V − 1 are the cloth's, the rest the body vertices that carry an edge now, in the order of
    ``body_vertex`` (indices into the obstacle's vertices).

    ``body_subsets[l]`` holds the body edges of cloth nodes on level l or deeper: a processor step that works on
    levels ≥ l only (paper, section 4.2) uses these. ``layer_subsets[l]`` holds the edges between layers of cloth both of
    whose nodes are: there are none in graphs of models that know no such edges.
    """

    num_cloth: int
    body_vertex: Tensor  # (W_active,)
    edge_sets: dict[str, EdgeSet]  # mesh, coarse0, …, body (always present, possibly without edges), layers
    body_subsets: dict[int, Subset]
    node_level: Tensor  # (V,)
    num_mesh_edges: int  # undirected mesh edges; mesh rows with a larger ``source`` are attachments
    layer_subsets: dict[int, Subset] = field(default_factory=dict, kw_only=True)

    def subset(self, name: str, level: int) -> Subset:
        """The edges of a set that a processor step on levels ≥ ``level`` works on; all of a static one."""
        if name == BODY:
            return self.body_subsets[level]
        return self.layer_subsets[level] if name == LAYERS else Subset(self.edge_sets[name], None)

    @property
    def num_nodes(self) -> int:
        return self.num_cloth + self.body_vertex.shape[0]


def edge_set(pairs: Tensor) -> EdgeSet:
    """Both directions of undirected ``pairs`` (E, 2) as a sorted set of 2E rows."""
    count = pairs.shape[0]
    receivers, senders = torch.cat([pairs, pairs.flip(1)]).unbind(1)
    width = int(pairs.max()) + 1 if count else 1
    order = torch.argsort(receivers * width + senders, stable=True)
    position = torch.empty_like(order)
    position[order] = torch.arange(2 * count, device=order.device)
    # Row i of the unsorted list and row i + E are the two directions of one edge.
    reverse = position[(order + count) % max(2 * count, 1)]
    receivers = receivers[order].contiguous()
    nodes, local, degree = torch.unique_consecutive(receivers, return_inverse=True, return_counts=True)
    return EdgeSet(
        senders=senders[order],
        receivers=receivers,
        source=order % max(count, 1),
        reverse=reverse,
        nodes=nodes,
        local_senders=local[reverse],
        local_receivers=local,
        offsets=torch.cat([degree.new_zeros(1), degree.cumsum(0)]),
    )


def build_static(cloth: Cloth, hierarchy: Hierarchy, names: Sequence[str]) -> StaticGraph:
    """Static edge sets ``names`` of a cloth: ``mesh`` and the coarse sets that the network's schedule uses.

    ``node_level`` keeps all levels of the hierarchy, also those without a set here.
    """
    device = cloth.edges.device
    available = {MESH: cloth.edges}
    available |= {coarse_name(k): edges.to(device) for k, edges in enumerate(hierarchy.coarse_edges)}
    missing = [name for name in names if name not in available and name != BODY]
    if missing:
        raise ValueError(
            f"graph: no edge set {missing[0]!r}; the hierarchy has {len(hierarchy.coarse_edges)} coarse levels, "
            f"build it with more (available: {', '.join(available)})"
        )
    if hierarchy.num_vertices != cloth.num_vertices:
        raise ValueError(
            f"graph: the hierarchy is of {hierarchy.num_vertices} vertices but the cloth has {cloth.num_vertices}; "
            "build it from the same garments in the same order"
        )
    sets = {name: edge_set(available[name]) for name in names if name != BODY}
    return StaticGraph(cloth.num_vertices, cloth.edges, sets, hierarchy.node_level.to(device))


def build_graph(
    static: StaticGraph,
    step: StepInput,
    nearest: Nearest | None = None,
    radius: float = 0.03,
    active_edges: Tensor | None = None,
    layers: Tensor | None = None,
) -> Graph:
    """Graph of one step.

    Args:
        static: the cloth's static part.
        step: its closed ``attachments`` join the mesh edges; its ``obstacle`` tells which body vertices are omitted.
        nearest: nearest body vertices of the cloth's; None without a body.
        radius: body edges are kept where the nearest body vertex is closer than this [m] (paper: 3 cm).
        active_edges: (E,) bool, mesh edges that exist in this step; None for all of them.
        layers: (L, 2) cloth nodes near each other (:func:`find_near_cloth`); None for models that
            know no such edges.
    """
    sets = dict(static.edge_sets)
    if MESH in sets:
        sets[MESH] = mesh_set(static, step.attachments, active_edges)
    cloth_node, body_vertex = _body_pairs(static, step.obstacle, nearest, radius)
    body_vertex, compact = torch.unique(body_vertex, return_inverse=True)
    pairs = torch.stack([cloth_node, static.num_cloth + compact], dim=1)
    body = edge_set(pairs)
    sets[BODY] = body
    row_level = static.node_level[cloth_node][body.source]
    depth = max((set_level(name) for name in static.edge_sets), default=0)
    graph = Graph(
        static.num_cloth, body_vertex, sets, _by_level(body, row_level, depth), static.node_level, static.mesh_edges.shape[0]
    )
    return graph if layers is None else _with_layers(graph, layers, depth)


def _with_layers(graph: Graph, pairs: Tensor, depth: int) -> Graph:
    edges = edge_set(pairs)
    level = torch.minimum(graph.node_level[edges.senders], graph.node_level[edges.receivers])
    sets = {**graph.edge_sets, LAYERS: edges}
    return replace(graph, edge_sets=sets, layer_subsets=_by_level(edges, level, depth))


def _by_level(edges: EdgeSet, row_level: Tensor, depth: int) -> dict[int, Subset]:
    """The rows on every level or deeper, by level."""
    return {0: Subset(edges, None)} | {level: _subset(edges, row_level >= level) for level in range(1, depth + 1)}


def mesh_set(static: StaticGraph, attachments: Attachments | None, active_edges: Tensor | None) -> EdgeSet:
    """Mesh edges that exist in a step (all of them if ``active_edges`` is None) and the attachments closed in it."""
    closed = attachments is not None and bool(attachments.active.any())
    if active_edges is None and not closed:
        return static.edge_sets[MESH]
    # Sources keep pointing into the full lists [mesh edges, attachments], which the features read.
    keep = torch.ones(len(static.mesh_edges), dtype=torch.bool, device=static.mesh_edges.device)
    keep = keep if active_edges is None else active_edges
    pairs = static.mesh_edges
    if attachments is not None:
        pairs = torch.cat([pairs, attachments.edges])
        keep = torch.cat([keep, attachments.active])
    kept = keep.nonzero().squeeze(1)
    built = edge_set(pairs[kept])
    return replace(built, source=kept[built.source])


def _body_pairs(
    static: StaticGraph, obstacle: Obstacle | None, nearest: Nearest | None, radius: float
) -> tuple[Tensor, Tensor]:
    """Cloth node and body vertex of every body edge; omitted vertices drop out after the search, not before it."""
    if obstacle is None or nearest is None:
        none = static.node_level.new_zeros(0)
        return none, none
    near = nearest.dist < radius
    if obstacle.omitted is not None:
        near = near & ~obstacle.omitted[nearest.vertex]
    cloth_node = near.nonzero().squeeze(1)
    return cloth_node, nearest.vertex[cloth_node]


def _subset(edges: EdgeSet, keep: Tensor) -> Subset:
    """Rows ``keep`` of a set; both directions of an edge must be kept or dropped together."""
    rows = keep.nonzero().squeeze(1)
    if rows.shape[0] == edges.num_edges:
        return Subset(edges, None)
    position = torch.cumsum(keep, 0) - 1
    receivers = edges.receivers[rows]
    nodes, local, degree = torch.unique_consecutive(receivers, return_inverse=True, return_counts=True)
    reverse = position[edges.reverse[rows]]
    part = EdgeSet(
        senders=edges.senders[rows],
        receivers=receivers,
        source=edges.source[rows],
        reverse=reverse,
        nodes=nodes,
        local_senders=local[reverse],
        local_receivers=local,
        offsets=torch.cat([degree.new_zeros(1), degree.cumsum(0)]),
    )
    return Subset(part, rows)


@dataclass(frozen=True)
class _Rest:
    """What is known of a cloth at rest."""

    pos: np.ndarray  # (V, 3) m, float64
    piece: np.ndarray  # (V,) connected part, over all scenes
    rings: Rings
    bounds: list[int]  # first vertex of every scene, and the end


@torch.no_grad()
def find_near_cloth(cloth: Cloth, pos: Tensor, radius: float) -> Tensor:
    """Pairs (E, 2) of vertices of one scene closer than ``radius`` [m] at ``pos`` (V, 3), the lower number first, ascending.

    Of two connected parts, or of one folded on itself: neighbours within two edges, and what was as near at rest as cloth side
    by side is, are left out. Places that are not finite are near nothing. The search is done on the CPU.
    """
    rest, here = _rest_of(cloth), pos.detach().cpu().double().numpy()
    pairs = [_pairs(here[first:last], radius) + first for first, last in zip(rest.bounds, rest.bounds[1:], strict=False)]
    first, second = np.concatenate(pairs).T if pairs else np.zeros((2, 0), dtype=np.int64)
    side_by_side = np.linalg.norm(rest.pos[first] - rest.pos[second], axis=1) < _FLAT * radius
    same = rest.piece[first] == rest.piece[second]
    kept = ~(same & side_by_side) & ~rest.rings.hold(first, second)
    return torch.as_tensor(np.stack([first[kept], second[kept]], axis=1), device=pos.device)


def _pairs(pos: np.ndarray, radius: float) -> np.ndarray:
    """(E, 2) int64, ascending."""
    finite = np.flatnonzero(np.isfinite(pos).all(axis=1))
    if len(finite) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    found = finite[cKDTree(pos[finite]).query_pairs(radius, output_type="ndarray")].reshape(-1, 2)
    found.sort(axis=1)
    return np.asarray(found[np.lexsort((found[:, 1], found[:, 0]))])


def _rest_of(cloth: Cloth) -> _Rest:
    """Kept as long as the cloth's edges live."""
    made = made_of(cloth.edges)
    if "rest" in made:
        return made["rest"]
    edges = cloth.edges.cpu().numpy()
    bounds = torch.searchsorted(cloth.vertex_scene.cpu(), torch.arange(cloth.num_scenes + 1)).tolist()
    count = cloth.num_vertices
    rest = _Rest(cloth.rest_pos.cpu().double().numpy(), connected_components(count, edges), Rings(count, edges), bounds)
    made["rest"] = rest
    return rest


Step = tuple[str, ...]

#: The architectures of the paper (section 4.2 and Table 1) by name.
SCHEDULES: dict[str, str] = {
    "ours": "3x(mesh+coarse0) 3x(coarse0+coarse1) 3x(coarse1) 3x(coarse0+coarse1) 3x(mesh+coarse0)",
    "fine15": "15x(mesh)",
    "fine48": "48x(mesh)",
}
#: Steps of a schedule at most: twenty times the longest published one.
_MOST_STEPS = 1000
_BLOCK = re.compile(r"\s*(?:(\d+)\s*x\s*)?\(([^()]*)\)\s*")
_COARSE = re.compile(r"coarse(\d+)")


def parse_schedule(text: str) -> tuple[Step, ...]:
    """Steps of a schedule, each a tuple of cloth edge sets in the order of the node network's input: coarse sets
    ascending, then the mesh. Body edges belong to every step and are not written.

    ``text`` is a name from :data:`SCHEDULES` or blocks ``Nx(set+set)``, with ``|`` between passes (:func:`parse_passes`).
    Raises ValueError for anything misspelt.
    """
    source = SCHEDULES.get(text.strip(), text).replace("|", " ")
    if "(" not in source:
        hint = difflib.get_close_matches(text, SCHEDULES, n=1)
        guess = f"; did you mean {hint[0]!r}?" if hint else ""
        raise ValueError(f"unknown schedule {text!r}{guess} (known: {', '.join(SCHEDULES)}, or 'Nx(mesh+coarse0) …')")
    steps: list[Step] = []
    position = 0
    while position < len(source):
        block = _BLOCK.match(source, position)
        if block is None:
            raise ValueError(f"schedule {source!r}: cannot read {source[position:]!r}; write '3x(mesh+coarse0)'")
        repeats = int(block[1] or 1)
        if repeats < 1:
            raise ValueError(f"schedule {source!r}: {block[0].strip()!r} repeats 0 times; remove it")
        if len(steps) + repeats > _MOST_STEPS:
            raise ValueError(f"schedule {source[:80]!r}: more than {_MOST_STEPS} steps; the longest published one has 48")
        steps += [_parse_sets(block[2], source)] * repeats
        position = block.end()
    return tuple(steps)


def parse_passes(text: str) -> tuple[int, ...]:
    """Number of steps in each pass of a schedule, at least one pass. Raises ValueError for a pass without steps."""
    parts = SCHEDULES.get(text.strip(), text).split("|")
    for index, part in enumerate(parts):
        if len(parts) > 1 and not part.strip():
            raise ValueError(f"schedule {text!r}: pass {index} of {len(parts)} has no steps; remove a '|'")
    return tuple(len(parse_schedule(part)) for part in parts)


def edge_set_names(schedule: Sequence[Step]) -> tuple[str, ...]:
    """Cloth edge sets that some step uses: the mesh first, then the coarse sets ascending."""
    return tuple(sorted({name for step in schedule for name in step}, key=set_level))


def finest_level(step: Step) -> int:
    """Finest level of a step; body edges of nodes that exist only on finer levels do not take part in it."""
    return min(set_level(name) for name in step)


def radius(schedule: Sequence[Step], passed_over: int = 0) -> int:
    """Propagation radius in mesh edges: the sum over the steps of the longest edge processed (paper, Table 1).

    Where levels are passed over (:func:`hood.model.graph.hierarchy.num_passed_over`), coarse edges are so many times twice as
    long.
    """
    levels = [max(map(set_level, step)) for step in schedule]
    return sum(2 ** (level + passed_over) if level else 1 for level in levels)


def _parse_sets(text: str, source: str) -> Step:
    names = [name.strip() for name in text.split("+")]
    for name in names:
        if name != MESH and not _COARSE.fullmatch(name):
            hint = difflib.get_close_matches(name, ["mesh", "coarse0", "coarse1", "coarse2", "coarse3"], n=1)
            guess = f"; did you mean {hint[0]!r}?" if hint else ""
            raise ValueError(f"schedule {source!r}: unknown edge set {name!r}{guess} (mesh, coarse0, coarse1, …)")
    if len(set(names)) < len(names):
        raise ValueError(f"schedule {source!r}: ({text}) names a set twice")
    return tuple(sorted(names, key=lambda name: (name == MESH, set_level(name))))

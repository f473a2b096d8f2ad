"""Feature groups. A group knows its width and computes its columns; a :class:`FeatureSet` is three lists of groups.

A new group is one class. In a package of your own it is registered (docs/extending.md); here it is one entry in such a
list. Groups with ``normalized = False`` bypass the running statistics and stand at the end of their list. Relative vectors
are sender − receiver; positions are read only as differences, so features do not depend on where the scene is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from hood.assets.material import RANGES
from hood.model.features.inputs import Inputs
from hood.model.features.normalizer import RunningNormalizer
from hood.model.graph.builder import BODY, LAYERS

# Types of the reference implementation. Omitted body vertices (2) never carry an edge and so never become nodes.
CLOTH_TYPE, BODY_TYPE, PINNED_TYPE = 0, 1, 3


class NodeGroup(nn.Module):
    """Columns of the node features: (V, width) for the cloth and (W_active, width) for the body below it."""

    width: int
    of = "nodes"  # whose columns these are
    normalized = True
    needs_contact = False  # reads ``inputs.contact``, or what was computed with it
    needs_base = False  # reads ``inputs.base``
    needs_residual = False  # reads ``inputs.residual``
    needs_feedback = False  # reads ``inputs.local_step`` or ``inputs.wide_residual``
    needs_global_step = False  # reads ``inputs.global_step``

    def cloth(self, inputs: Inputs) -> Tensor:
        raise NotImplementedError

    def body(self, inputs: Inputs) -> Tensor:
        raise NotImplementedError

    def forward(self, inputs: Inputs) -> Tensor:
        """(V + W_active, width)."""
        cloth = self.cloth(inputs)
        return cloth if inputs.num_body == 0 else torch.cat([cloth, self.body(inputs)])

    def columns(self, inputs: Inputs) -> Sequence[Tensor]:
        """The same as a list of one."""
        return (self(inputs),)


class EdgeGroup(nn.Module):
    """Columns of the features of cloth edges (rows: ``inputs.edges``), of body edges (``inputs.body_edges``) or of those
    between layers of cloth (``inputs.layer_edges``)."""

    width: int
    normalized = True
    of = "edges"  # whose columns these are: of edges (of the cloth), body_edges or layer_edges
    needs_contact = needs_base = needs_residual = needs_feedback = needs_global_step = False  # as of a NodeGroup

    def forward(self, inputs: Inputs) -> Tensor:
        """(N, width)."""
        raise NotImplementedError

    def columns(self, inputs: Inputs) -> Sequence[Tensor]:
        """The same in parts: spares a group of many rows the copy that puts its own together."""
        return (self(inputs),)


# ---- the paper's node features, in its order -------------------------------------------------------------------------


class Velocity(NodeGroup):
    """Displacement per frame [m]: vel·dt; of the body, position now − before, or next − now."""

    width = 3

    def __init__(self, body: str = "previous") -> None:
        super().__init__()
        if body not in ("previous", "next"):
            raise ValueError(f"feature 'velocity': body is {body!r}; choose 'previous' or 'next' (displacement)")
        self.of_body = body

    def cloth(self, inputs: Inputs) -> Tensor:
        return inputs.state.vel * inputs.vertex_dt

    def body(self, inputs: Inputs) -> Tensor:
        obstacle = inputs.obstacle
        step = obstacle.pos - obstacle.prev_pos if self.of_body == "previous" else obstacle.next_pos - obstacle.pos
        return inputs.body(step)


class TypeEmbedding(NodeGroup):
    """Learned vector per node type; the table has the reference's 9 rows, of which cloth, body and pinned are read."""

    def __init__(self, num_types: int = 9, width: int = 9) -> None:
        super().__init__()
        self.width = width
        self.table = nn.Embedding(num_types, width)

    def cloth(self, inputs: Inputs) -> Tensor:
        kind = torch.where(inputs.cloth.pinned, PINNED_TYPE, CLOTH_TYPE)
        return self.table.weight.index_select(0, kind)

    def body(self, inputs: Inputs) -> Tensor:
        return self.table.weight[BODY_TYPE].expand(inputs.num_body, -1)


class LevelEmbedding(NodeGroup):
    """Learned vector per level (deepest level in which the node has an edge); body nodes are on level 0."""

    def __init__(self, num_levels: int = 3, width: int = 4) -> None:
        super().__init__()
        self.width = width
        self.table = nn.Embedding(num_levels, width)

    def cloth(self, inputs: Inputs) -> Tensor:
        level = inputs.graph.node_level.clamp_max(self.table.num_embeddings - 1)
        return self.table.weight.index_select(0, level)

    def body(self, inputs: Inputs) -> Tensor:
        return self.table.weight[0].expand(inputs.num_body, -1)


class Normal(NodeGroup):
    """Area-weighted unit vertex normal at t."""

    width = 3

    def cloth(self, inputs: Inputs) -> Tensor:
        return inputs.cloth_normal

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.body_normal


class Timestep(NodeGroup):
    """Timestep feature [s]."""

    width = 1

    def cloth(self, inputs: Inputs) -> Tensor:
        return inputs.node_timestep[: inputs.num_cloth].unsqueeze(1)

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.node_timestep[inputs.num_cloth :].unsqueeze(1)


class LogMass(NodeGroup):
    """log of the vertex mass [kg]; −1 on the body. Clamped from below: isolated vertices have no mass."""

    width = 1

    def __init__(self, smallest: float = 1e-9) -> None:
        super().__init__()
        self.smallest = smallest

    def cloth(self, inputs: Inputs) -> Tensor:
        return inputs.cloth.mass.clamp_min(self.smallest).log().unsqueeze(1)

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.state.pos.new_full((inputs.num_body, 1), -1.0)


class NodeMaterial(NodeGroup):
    """Bending, μ, λ mapped to [0, 1] over the training ranges; −1 on the body."""

    width = 3
    normalized = False

    def cloth(self, inputs: Inputs) -> Tensor:
        return unit_fabric(inputs.cloth.vertex_fabric)

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.state.pos.new_full((inputs.num_body, 3), -1.0)


def unit_fabric(fabric: Tensor, log_lambda: bool = False) -> Tensor:
    """(N, 3) lame_mu [Pa], lame_lambda [Pa], bending_stiffness [J] → (N, 3) bending, μ, λ over their training ranges.

    (log v − log min)/(log max − log min) for bending and μ, λ linear, not clamped to [0, 1].
    Values below a thousandth of a range's start are raised to it before a logarithm: bending may be 0.
    """
    mu, lam, bending = fabric.unbind(1)
    low, high = RANGES["lame_lambda"]
    linear = (lam - low) / (high - low)
    columns = [_log_unit(bending, "bending_stiffness"), _log_unit(mu, "lame_mu")]
    columns.append(_log_unit(lam, "lame_lambda") if log_lambda else linear)
    return torch.stack(columns, dim=1)


def _log_unit(value: Tensor, name: str) -> Tensor:
    low, high = RANGES[name]
    return (value.clamp_min(1e-3 * low).log() - math.log(low)) / (math.log(high) - math.log(low))


# ---- the paper's edge features ---------------------------------------------------------------------------------------


class CurrentRelative(EdgeGroup):
    """Relative position at t and its norm [m]."""

    width = 4

    def forward(self, inputs: Inputs) -> Tensor:
        return torch.cat(self.columns(inputs), dim=1)

    def columns(self, inputs: Inputs) -> tuple[Tensor, Tensor]:
        vector = cloth_difference(inputs.state.pos, inputs)
        return vector, vector.norm(dim=1, keepdim=True)


class RestRelative(EdgeGroup):
    """Relative rest position and its norm [m]."""

    width = 4

    def forward(self, inputs: Inputs) -> Tensor:
        return inputs.edges.once("rest", lambda: with_norm(cloth_difference(inputs.cloth.rest_pos, inputs)))


class EdgeTimestep(EdgeGroup):
    """Timestep feature [s]."""

    width = 1

    def forward(self, inputs: Inputs) -> Tensor:
        return inputs.edge_timestep(inputs.edges.receivers)


class EdgeMaterial(EdgeGroup):
    """Bending, μ, λ mapped to [0, 1] over the training ranges."""

    width = 3
    normalized = False

    def forward(self, inputs: Inputs) -> Tensor:
        return inputs.edges.once("unit fabric", lambda: unit_fabric(inputs.edges.fabric))


class BodyRelative(EdgeGroup):
    """Relative position and norm [m] between the cloth at t and the body at t, or at t + 1 with ``body="next"``."""

    width = 4
    of = "body_edges"

    def __init__(self, body: str = "current") -> None:
        super().__init__()
        if body not in ("current", "next"):
            raise ValueError(f"feature 'body relative': body is {body!r}; choose 'current' or 'next'")
        self.of_body = body

    def forward(self, inputs: Inputs) -> Tensor:
        obstacle = inputs.obstacle
        target = obstacle.pos if self.of_body == "current" else obstacle.next_pos
        return with_norm(body_difference(inputs.state.pos, target, inputs))


class BodyTimestep(EdgeGroup):
    """Timestep feature [s]."""

    width = 1
    of = "body_edges"

    def forward(self, inputs: Inputs) -> Tensor:
        return inputs.edge_timestep(inputs.body_edges.receivers)


class LayerRelative(EdgeGroup):
    """Relative position and norm [m] between layers of cloth at t, or where they go on to with ``moved``: at x + dt v."""

    width = 4
    of = "layer_edges"

    def __init__(self, moved: bool = False) -> None:
        super().__init__()
        self.moved = moved

    def forward(self, inputs: Inputs) -> Tensor:
        pos = inputs.state.pos
        return with_norm(layer_difference(pos + inputs.vertex_dt * inputs.state.vel if self.moved else pos, inputs))


class LayerTimestep(EdgeGroup):
    """Timestep feature [s]."""

    width = 1
    of = "layer_edges"

    def forward(self, inputs: Inputs) -> Tensor:
        return inputs.edge_timestep(inputs.layer_edges.receivers)


def layer_difference(pos: Tensor, inputs: Inputs) -> Tensor:
    return pos.index_select(0, inputs.layer_edges.senders).sub_(pos.index_select(0, inputs.layer_edges.receivers))


def cloth_difference(pos: Tensor, inputs: Inputs) -> Tensor:
    return pos.index_select(0, inputs.edges.senders).sub_(pos.index_select(0, inputs.edges.receivers))


def body_difference(cloth_pos: Tensor, body_pos: Tensor, inputs: Inputs) -> Tensor:
    pos = torch.cat([cloth_pos, inputs.body(body_pos)])
    return pos.index_select(0, inputs.body_edges.senders).sub_(pos.index_select(0, inputs.body_edges.receivers))


def with_norm(vector: Tensor) -> Tensor:
    return torch.cat([vector, vector.norm(dim=1, keepdim=True)], dim=1)


# ---- assembly --------------------------------------------------------------------------------------------------------


class FeatureSet(nn.Module):
    """Node, cloth edge and body edge features of a step, normalised, and those of edges between layers of cloth where there
    are groups for them.

    One normaliser for nodes, one shared by mesh and coarse edges, one for body edges, one for those between layers, each over
    the groups that ask for it; ``decay`` None normalises nothing (groups that bring their own scales). The ``more`` groups take
    their places in the lists behind what is there, those that are normalised before those that are not.
    """

    def __init__(
        self,
        node: Sequence[NodeGroup],
        edge: Sequence[EdgeGroup],
        body_edge: Sequence[EdgeGroup],
        decay: float | None = 0.999,
        divisor_floor: float | None = None,
        layer_edge: Sequence[EdgeGroup] = (),
        more: Sequence[NodeGroup | EdgeGroup] = (),
    ) -> None:
        super().__init__()
        node, edge, body_edge = (
            _joined(node, more, "nodes"),
            _joined(edge, more, "edges"),
            _joined(body_edge, more, "body_edges"),
        )
        layer_edge = _joined(layer_edge, more, "layer_edges")
        self.node, self.edge, self.body_edge = nn.ModuleList(node), nn.ModuleList(edge), nn.ModuleList(body_edge)
        self.layer_edge = nn.ModuleList(layer_edge)
        self.node_normalizer = _normalizer("node", node, decay, divisor_floor)
        self.edge_normalizer = _normalizer("edge", edge, decay, divisor_floor)
        self.body_edge_normalizer = _normalizer("body edge", body_edge, decay, divisor_floor)
        self.layer_edge_normalizer = _normalizer("layer edge", layer_edge, decay, divisor_floor) if layer_edge else None

    @property
    def node_width(self) -> int:
        return _width(self.node)

    def needs(self, what: str) -> bool:
        """Whether a group needs ``contact``, ``base``, ``residual``, ``feedback`` or ``global_step``."""
        lists = (self.node, self.edge, self.body_edge, self.layer_edge)
        return any(bool(getattr(group, f"needs_{what}")) for groups in lists for group in groups)

    @property
    def edge_widths(self) -> dict[str, int]:
        """Widths by edge set as the network takes them."""
        widths = {"mesh": _width(self.edge), "coarse": _width(self.edge), BODY: _width(self.body_edge)}
        return widths | {LAYERS: _width(self.layer_edge)} if len(self.layer_edge) else widths

    def forward(self, inputs: Inputs, columns: Columns | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """Node features (V + W_active, node_width) and edge features by set, rows as in the graph; the columns by torch if not
        said otherwise."""
        columns = columns or IN_TORCH
        nodes = _normalized(columns.nodes(self, inputs), self.node_normalizer)
        rows = _normalized(columns.edges(self, inputs), self.edge_normalizer)
        counts = [inputs.graph.edge_sets[name].num_edges for name in inputs.cloth_sets]
        edges = dict(zip(inputs.cloth_sets, rows.split(counts), strict=True))
        found = columns.body_edges(self, inputs) if inputs.body_edges.num_edges else None
        edges[BODY] = _changing(found, nodes, self.edge_widths[BODY], self.body_edge_normalizer)
        if len(self.layer_edge):
            found = _together(self.layer_edge, inputs) if inputs.layer_edges.num_edges else None
            edges[LAYERS] = _changing(found, nodes, self.edge_widths[LAYERS], self.layer_edge_normalizer)
        return nodes, edges


class Columns(NamedTuple):
    """Who computes the columns of a feature set, before they are normalised: of nodes, cloth edges and body edges."""

    nodes: Callable[[FeatureSet, Inputs], Tensor]
    edges: Callable[[FeatureSet, Inputs], Tensor]
    body_edges: Callable[[FeatureSet, Inputs], Tensor]


def _together(groups: Iterable[Any], inputs: Inputs) -> Tensor:
    return torch.cat([part for group in groups for part in group.columns(inputs)], dim=1)


IN_TORCH = Columns(
    nodes=lambda features, inputs: _together(features.node, inputs),
    edges=lambda features, inputs: _together(features.edge, inputs),
    body_edges=lambda features, inputs: _together(features.body_edge, inputs),
)


def _normalized(values: Tensor, normalizer: RunningNormalizer | None) -> Tensor:
    return values if normalizer is None else normalizer.leading(values)


def _changing(found: Tensor | None, like: Tensor, width: int, normalizer: RunningNormalizer | None) -> Tensor:
    """Columns of edges that a step may have none of, normalised."""
    if found is not None:
        return _normalized(found, normalizer)
    none = like.new_zeros(0, width)
    if normalizer is not None:
        # No rows count as nothing, but processes that share a batch all have to be heard.
        normalizer(none[:, : normalizer.width])
    return none


def _joined(groups: Sequence[Any], more: Sequence[NodeGroup | EdgeGroup], of: str) -> list[Any]:
    """The groups and those of ``more`` whose columns are those of the same rows; a set's own order is kept."""
    added = [group for group in more if group.of == of]
    if not added:
        return list(groups)
    return sorted([*groups, *added], key=lambda group: not group.normalized)


def _width(groups: Iterable[Any]) -> int:
    return sum(int(group.width) for group in groups)


def _normalizer(
    name: str, groups: Sequence[NodeGroup | EdgeGroup], decay: float | None, divisor_floor: float | None
) -> RunningNormalizer | None:
    if decay is None:
        return None
    flags = [group.normalized for group in groups]
    if flags != sorted(flags, reverse=True):
        raise ValueError(f"{name} features: a normalised group follows an unnormalised one; move the latter to the end")
    return RunningNormalizer(_width(g for g in groups if g.normalized), decay, divisor_floor=divisor_floor)


def paper(
    num_levels: int = 3,
    body_velocity: str = "previous",
    decay: float = 0.999,
    divisor_floor: float | None = None,
    layers: bool = False,
    more: Sequence[NodeGroup | EdgeGroup] = (),
) -> FeatureSet:
    """The paper's features: node 24 (20 with ``num_levels`` 1, which has no level embedding), edge 12, body edge 9; with
    ``layers`` edges between layers of cloth as well, 9. The columns of ``more`` groups are added to theirs.

    ``divisor_floor`` is that of :class:`hood.model.features.normalizer.RunningNormalizer`.
    """
    level = [LevelEmbedding(num_levels)] if num_levels > 1 else []
    return FeatureSet(
        node=[Velocity(body_velocity), TypeEmbedding(), *level, Normal(), Timestep(), LogMass(), NodeMaterial()],
        edge=[CurrentRelative(), RestRelative(), EdgeTimestep(), EdgeMaterial()],
        body_edge=[BodyRelative("current"), BodyRelative("next"), BodyTimestep()],
        decay=decay,
        divisor_floor=divisor_floor,
        more=more,
        layer_edge=[LayerRelative(), LayerRelative(moved=True), LayerTimestep()] if layers else [],
    )

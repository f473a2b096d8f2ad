"""A list of feature groups as one table of columns, normalised."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import takewhile
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from hood.model.features.groups import (
    BodyRelative,
    BodyTimestep,
    CurrentRelative,
    EdgeGroup,
    EdgeMaterial,
    EdgeTimestep,
    LayerRelative,
    LayerTimestep,
    LevelEmbedding,
    LogMass,
    NodeGroup,
    NodeMaterial,
    Normal,
    RestRelative,
    Timestep,
    TypeEmbedding,
    Velocity,
)
from hood.model.features.inputs import Inputs
from hood.model.features.normalizer import RunningNormalizer
from hood.model.graph.builder import BODY, LAYERS
from hood.model.graph.static_shapes import Filled, FixedGraph


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

    @property
    def places(self) -> dict[str, int]:
        """How many columns, the first of :attr:`edge_widths`, are relative places; by the same names."""
        lists = {"mesh": self.edge, "coarse": self.edge, BODY: self.body_edge, LAYERS: self.layer_edge}
        return {name: _width(takewhile(lambda group: bool(group.places), groups)) for name, groups in lists.items()}

    def forward(self, inputs: Inputs, columns: Columns | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """Node features (V + W_active, node_width) and edge features by set, rows as in the graph; the columns by torch if not
        said otherwise."""
        columns = columns or IN_TORCH
        there = inputs.graph.filled() if self.training and isinstance(inputs.graph, FixedGraph) else _ALL
        nodes = _normalized(columns.nodes(self, inputs), self.node_normalizer, there.nodes)
        rows = _normalized(columns.edges(self, inputs), self.edge_normalizer, there.edges)
        counts = [inputs.graph.edge_sets[name].num_edges for name in inputs.cloth_sets]
        edges = dict(zip(inputs.cloth_sets, rows.split(counts), strict=True))
        found = columns.body_edges(self, inputs) if inputs.body_edges.num_edges else None
        edges[BODY] = _changing(found, nodes, self.edge_widths[BODY], self.body_edge_normalizer, there.body_edges)
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


_ALL = Filled(None, None, None)


def _normalized(values: Tensor, normalizer: RunningNormalizer | None, filled: Tensor | None = None) -> Tensor:
    return values if normalizer is None else normalizer.leading(values, filled)


def _changing(
    found: Tensor | None, like: Tensor, width: int, normalizer: RunningNormalizer | None, filled: Tensor | None = None
) -> Tensor:
    """Columns of edges that a step may have none of, normalised."""
    if found is not None:
        return _normalized(found, normalizer, filled)
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

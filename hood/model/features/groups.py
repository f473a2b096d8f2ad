"""Feature groups. A group knows its width and computes its columns; a :class:`FeatureSet` is three lists of groups.

A new group is one class. In a package of your own it is registered (docs/extending.md); here it is one entry in such a
list. Groups with ``normalized = False`` bypass the running statistics and stand at the end of their list. Relative vectors
are sender − receiver; positions are read only as differences, so features do not depend on where the scene is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hood.assets.material import RANGES
from hood.model.features.inputs import Inputs

# Types of the reference implementation. Omitted body vertices (2) never carry an edge and so never become nodes.
CLOTH_TYPE, BODY_TYPE, PINNED_TYPE = 0, 1, 3


class NodeGroup(nn.Module):
    """Columns of the node features: (V, width) for the cloth and (W_active, width) for the body below it."""

    width: int  # number of columns
    of = "nodes"  # whose columns these are
    normalized = True
    needs_contact = False  # reads ``inputs.contact``, or what was computed with it
    needs_base = False  # reads ``inputs.base``
    needs_residual = False  # reads ``inputs.residual``
    needs_feedback = False  # reads ``inputs.local_step`` or ``inputs.wide_residual``
    needs_global_step = False  # reads ``inputs.global_step``

    def cloth(self, inputs: Inputs) -> Tensor:
        """(V, width) of the vertices of the cloth."""
        raise NotImplementedError

    def body(self, inputs: Inputs) -> Tensor:
        """(W_active, width) of the vertices of the body near the cloth."""
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

    width: int  # number of columns
    normalized = True
    places = False  # whether these are relative places and their lengths, which go together
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

    width, places = 4, True

    def forward(self, inputs: Inputs) -> Tensor:
        return torch.cat(self.columns(inputs), dim=1)

    def columns(self, inputs: Inputs) -> tuple[Tensor, Tensor]:
        vector = cloth_difference(inputs.state.pos, inputs)
        return vector, vector.norm(dim=1, keepdim=True)


class RestRelative(EdgeGroup):
    """Relative rest position and its norm [m]."""

    width, places = 4, True

    def forward(self, inputs: Inputs) -> Tensor:
        return inputs.edges.once("rest and norm", lambda: with_norm(inputs.rest))


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

    width, places = 4, True
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

    width, places = 4, True
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

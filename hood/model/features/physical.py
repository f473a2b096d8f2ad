"""Feature groups with fixed physical scales, relative to a base guess of the next positions: no statistics to collect,
no dependence on the frame's velocity (Galilean invariance), outliers compressed by asinh."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from hood.model.features.feature_set import FeatureSet
from hood.model.features.groups import (
    EdgeGroup,
    NodeGroup,
    Normal,
    body_difference,
    cloth_difference,
    layer_difference,
    unit_fabric,
)
from hood.model.features.inputs import Inputs
from hood.model.features.normalizer import FixedScale
from hood.tensors.dense import add_rows

GRAVITY = 9.81


class RelativeVelocity(NodeGroup):
    """asinh((vel·dt − base displacement)/scale): what the state's velocity adds to the base guess; of the body, the
    change of its displacement from the last frame to this one."""

    width = 3
    needs_base = True

    def __init__(self, scale: float = 0.01) -> None:
        super().__init__()
        self.scale = FixedScale(scale, asinh=True)

    def cloth(self, inputs: Inputs) -> Tensor:
        return self.scale(inputs.state.vel * inputs.vertex_dt - (inputs.base - inputs.state.pos))

    def body(self, inputs: Inputs) -> Tensor:
        obstacle = inputs.obstacle
        return self.scale(inputs.body(obstacle.next_pos - 2 * obstacle.pos + obstacle.prev_pos))


class Residual(NodeGroup):
    """asinh(residual/g): the acceleration that the potential asks for at the base; 0 if not given and on the body."""

    width = 3
    needs_contact = True
    needs_residual = True

    def __init__(self, scale: float = GRAVITY) -> None:
        super().__init__()
        self.scale = FixedScale(scale, asinh=True)

    def cloth(self, inputs: Inputs) -> Tensor:
        if inputs.residual is None:
            return torch.zeros_like(inputs.state.pos)
        return self.scale(inputs.residual)

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.state.pos.new_zeros(inputs.num_body, 3)


class TypeOneHot(NodeGroup):
    """Free, pinned or body."""

    width = 3

    def cloth(self, inputs: Inputs) -> Tensor:
        return functional.one_hot(inputs.cloth.pinned.long(), 3).to(inputs.state.pos)

    def body(self, inputs: Inputs) -> Tensor:
        return functional.one_hot(inputs.graph.body_vertex.new_full((inputs.num_body,), 2), 3).to(inputs.state.pos)


class LevelOneHot(NodeGroup):
    """Deepest level in which the node has an edge; zeros on the body."""

    def __init__(self, num_levels: int = 3) -> None:
        super().__init__()
        self.width = num_levels

    def cloth(self, inputs: Inputs) -> Tensor:
        level = inputs.graph.node_level.clamp_max(self.width - 1)
        return functional.one_hot(level, self.width).to(inputs.state.pos)

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.state.pos.new_zeros(inputs.num_body, self.width)


class ContactDistance(NodeGroup):
    """Signed distance of the base guess to the body at t + 1 (clamped to ±``reach`` m, over ``scale``) and the body's
    normal there; without contact the full reach and no direction. Body rows hold their own normal."""

    width = 4
    needs_contact = True
    needs_base = True

    def __init__(self, reach: float = 0.05, scale: float = 0.02) -> None:
        super().__init__()
        self.reach, self.scale = reach, scale

    def cloth(self, inputs: Inputs) -> Tensor:
        contact, base = inputs.contact, inputs.base
        if contact is None:
            far = base.new_full((inputs.num_cloth, 1), self.reach / self.scale)
            return torch.cat([far, torch.zeros_like(base)], dim=1)
        dist = torch.where(contact.valid, contact.next_dist(base), self.reach).clamp(-self.reach, self.reach)
        normal = torch.where(contact.valid.unsqueeze(1), contact.next_normal, 0.0)
        return torch.cat([dist.unsqueeze(1) / self.scale, normal], dim=1)

    def body(self, inputs: Inputs) -> Tensor:
        normal = inputs.body_next_normal
        return torch.cat([normal.new_zeros(inputs.num_body, 1), normal], dim=1)


class ScaledMass(NodeGroup):
    """log(mass/typical), typical = 0.2 g; 0 on the body and where there is no mass."""

    width = 1

    def __init__(self, typical: float = 2e-4) -> None:
        super().__init__()
        self.typical = typical

    def cloth(self, inputs: Inputs) -> Tensor:
        mass = inputs.cloth.mass
        return torch.where(mass > 0, mass / self.typical, 1.0).log().unsqueeze(1)

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.state.pos.new_zeros(inputs.num_body, 1)


class LogMaterial(NodeGroup):
    """Logarithms of bending, μ, λ mapped to [−1, 1] over the training ranges; 0 on the body."""

    width = 3

    def cloth(self, inputs: Inputs) -> Tensor:
        return 2 * unit_fabric(inputs.cloth.vertex_fabric, log_lambda=True) - 1

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.state.pos.new_zeros(inputs.num_body, 3)


class LogTimestep(NodeGroup):
    """log(30 Hz · timestep)."""

    width = 1

    def cloth(self, inputs: Inputs) -> Tensor:
        return (30 * inputs.node_timestep[: inputs.num_cloth]).log().unsqueeze(1)

    def body(self, inputs: Inputs) -> Tensor:
        return (30 * inputs.node_timestep[inputs.num_cloth :]).log().unsqueeze(1)


class ScaledShape(EdgeGroup):
    """Relative positions at t and at rest with norms, over the mean rest length of the edge's set in its scene."""

    width = 8

    def forward(self, inputs: Inputs) -> Tensor:
        current, rest = cloth_difference(inputs.state.pos, inputs), inputs.rest
        columns = torch.cat([current, edge_length(current), rest, edge_length(rest)], dim=1)
        return columns / inputs.edges.once("mean length", lambda: mean_rest_length(inputs))


class Strain(EdgeGroup):
    """asinh(gain·(length/rest length − 1)) at t and at the base guess; 0 for edges of no rest length (buttons)."""

    width = 2
    needs_base = True

    def __init__(self, gain: float = 100.0) -> None:
        super().__init__()
        self.scale = FixedScale(1.0 / gain, asinh=True)

    def forward(self, inputs: Inputs) -> Tensor:
        rest = rest_length(inputs)
        lengths = torch.cat([edge_length(cloth_difference(pos, inputs)) for pos in (inputs.state.pos, inputs.base)], dim=1)
        proper = rest > 1e-6
        return self.scale(torch.where(proper, lengths / torch.where(proper, rest, 1.0) - 1, 0.0))


class EdgeLogMaterial(EdgeGroup):
    """Logarithms of bending, μ, λ mapped to [−1, 1] over the training ranges."""

    width = 3

    def forward(self, inputs: Inputs) -> Tensor:
        return 2 * unit_fabric(inputs.edges.fabric, log_lambda=True) - 1


class BaseBodyRelative(EdgeGroup):
    """Relative position and norm between the base guess and the body at t + 1, over ``scale`` [m]."""

    width = 4
    of = "body_edges"
    needs_base = True

    def __init__(self, scale: float = 0.01) -> None:
        super().__init__()
        self.scale = FixedScale(scale)

    def forward(self, inputs: Inputs) -> Tensor:
        vector = body_difference(inputs.base, inputs.obstacle.next_pos, inputs)
        return self.scale(torch.cat([vector, edge_length(vector)], dim=1))


class BaseLayerRelative(EdgeGroup):
    """Relative position and norm between layers of cloth at t and at the base guess, over ``scale`` [m]."""

    width = 8
    of = "layer_edges"
    needs_base = True

    def __init__(self, scale: float = 0.01) -> None:
        super().__init__()
        self.scale = FixedScale(scale)

    def forward(self, inputs: Inputs) -> Tensor:
        vectors = [layer_difference(pos, inputs) for pos in (inputs.state.pos, inputs.base)]
        return self.scale(torch.cat([part for vector in vectors for part in (vector, edge_length(vector))], dim=1))


def edge_length(vector: Tensor) -> Tensor:
    """Norms (N, 1) of the rows of ``vector`` (N, 3)."""
    return vector.norm(dim=1, keepdim=True)


def rest_length(inputs: Inputs) -> Tensor:
    """Rest lengths of the cloth edges [m], (N, 1)."""
    return edge_length(inputs.rest)


def mean_rest_length(inputs: Inputs) -> Tensor:
    """Mean rest length [m] of the edges in the same set and scene, at least 1 µm, per edge (N, 1)."""
    edges, rest = inputs.edges, rest_length(inputs)
    ends = torch.cat([rest, torch.ones_like(rest)], dim=1)
    total = add_rows(rest.new_zeros(edges.num_segments, 2), edges.segment, ends)
    return (total[:, :1] / total[:, 1:].clamp_min(1.0)).index_select(0, edges.segment).clamp_min(1e-6)


def physical(
    num_levels: int = 3,
    views: Sequence[NodeGroup | EdgeGroup] = (),
    layers: bool = False,
    more: Sequence[NodeGroup | EdgeGroup] = (),
) -> FeatureSet:
    """Scaled features for training without a warm-up of statistics, with ``views`` beside the residual; they need
    ``Inputs.base_pos``. With ``layers`` there are edges between layers of cloth. The columns of ``more`` groups are added."""
    level = [LevelOneHot(num_levels)] if num_levels > 1 else []
    return FeatureSet(
        node=[
            RelativeVelocity(),
            Normal(),
            Residual(),
            *(view for view in views if isinstance(view, NodeGroup)),
            TypeOneHot(),
            *level,
            ContactDistance(),
            ScaledMass(),
            LogMaterial(),
            LogTimestep(),
        ],
        edge=[ScaledShape(), Strain(), EdgeLogMaterial(), *(view for view in views if isinstance(view, EdgeGroup))],
        body_edge=[BaseBodyRelative()],
        decay=None,
        layer_edge=[BaseLayerRelative()] if layers else [],
        more=more,
    )

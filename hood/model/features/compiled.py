"""Features by the compiled library (``hood/native/features.cpp``): the columns that the groups compute in torch, to rounding.

Groups that are not known here, a new one for example, are computed in torch and put in their place. Columns that say
nothing but what the cloth is are computed once per cloth.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from hood.contact.contact import Contact
from hood.mesh.closest_point.search import build_incidence
from hood.model.features import local, physical
from hood.model.features.feature_set import Columns, FeatureSet
from hood.model.features.groups import Normal
from hood.model.features.inputs import EdgeRows, Inputs
from hood.model.graph.static_shapes import FixedGraph
from hood.native import features as native

#: Writes a group's columns at an address, into rows of so many numbers.
Fill = Callable[[Any, Inputs, int, int], None]
#: Groups whose rows of the cloth depend on the cloth alone.
CONSTANT = (physical.TypeOneHot, physical.LevelOneHot, physical.ScaledMass, physical.LogMaterial, physical.EdgeLogMaterial)


def applies(inputs: Inputs) -> bool:
    """Whether the features of ``inputs`` can be had this way."""
    state, obstacle = inputs.state, inputs.step.obstacle
    body = () if obstacle is None else (obstacle.pos, obstacle.next_pos, obstacle.prev_pos)
    real = (state.pos, state.vel, inputs.cloth.rest_pos, inputs.base_pos, *body)
    return native.applies(*real) and not isinstance(inputs.graph, FixedGraph)


def planes_of(contact: Contact | None) -> native.Planes:
    """The contact as the library reads it; valid as long as its tensors live."""
    if contact is None:
        return native.Planes()
    tables = (contact.valid, contact.dist, contact.point, contact.next_point, contact.next_normal)
    assert all(table.is_contiguous() for table in tables), "a table of the contact has gaps"
    return native.Planes(*(table.data_ptr() for table in tables))


# ---- columns ---------------------------------------------------------------------------------------------------------


def _compressed(values: Tensor, scale: float, at: int, stride: int) -> None:
    native.call("asinh", values.contiguous(), *values.shape, scale, at, stride)


def _scale(group: Any) -> float:
    return float(group.scale.scale)


def _moved(inputs: Inputs, scale: float, at: int, stride: int) -> None:
    state, dt = inputs.state, inputs.vertex_dt.contiguous()
    tables = (state.pos.contiguous(), state.vel.contiguous(), dt, inputs.base.contiguous())
    native.call("moved", *tables, inputs.num_cloth, scale, at, stride)


def _relative_velocity(group: physical.RelativeVelocity, inputs: Inputs, at: int, stride: int) -> None:
    _moved(inputs, _scale(group), at, stride)
    if inputs.num_body:
        places = (inputs.obstacle.pos, inputs.obstacle.next_pos, inputs.obstacle.prev_pos)
        tables = (*(place.contiguous() for place in places), inputs.graph.body_vertex)
        native.call("swing", *tables, inputs.num_body, _scale(group), at + 4 * stride * inputs.num_cloth, stride)


def _normals(pos: Tensor, faces: Tensor, rows: Tensor | None, count: int, at: int, stride: int) -> None:
    if len(faces) == 0:
        return  # zero, as the table is made
    found = build_incidence(faces, len(pos))
    tables = (pos.contiguous(), faces.contiguous(), found.around, found.first, found.valence, rows)
    native.call("normals", *tables, count, at, stride)


def _normal(group: Normal, inputs: Inputs, at: int, stride: int) -> None:
    _normals(inputs.state.pos, inputs.cloth.faces, None, inputs.num_cloth, at, stride)
    if inputs.num_body:
        below = at + 4 * stride * inputs.num_cloth
        _normals(inputs.obstacle.pos, inputs.obstacle.faces, inputs.graph.body_vertex, inputs.num_body, below, stride)


def _view(name: str) -> Fill:
    """Columns asinh(value / scale) of a field of the inputs."""

    def fill(group: Any, inputs: Inputs, at: int, stride: int) -> None:
        value = getattr(inputs, name)
        if value is None:
            group.cloth(inputs)  # says what is missing, or that it counts as nothing
            return
        _compressed(value, _scale(group), at, stride)

    return fill


def _contact(group: physical.ContactDistance, inputs: Inputs, at: int, stride: int, width: int = 4) -> None:
    planes = planes_of(inputs.contact)
    native.call("contact", planes, inputs.base.contiguous(), inputs.num_cloth, group.reach, group.scale, width, at, stride)
    if width > 1 and inputs.num_body:
        below, obstacle = at + 4 * (stride * inputs.num_cloth + 1), inputs.obstacle
        _normals(obstacle.next_pos, obstacle.faces, inputs.graph.body_vertex, inputs.num_body, below, stride)


def _scaled_shape(group: physical.ScaledShape, inputs: Inputs, at: int, stride: int) -> None:
    rows = inputs.edges
    unit = rows.once("mean length", lambda: physical.mean_rest_length(inputs))
    ends = (inputs.state.pos.contiguous(), rows.senders, rows.receivers)
    native.call("relative", *ends, len(rows.senders), 1.0, unit, at, stride)


def _strain(group: physical.Strain, inputs: Inputs, at: int, stride: int) -> None:
    rows, scale = inputs.edges, _scale(group)
    rest = rows.once("rest length", lambda: physical.rest_length(inputs))
    for column, pos in enumerate((inputs.state.pos, inputs.base)):
        ends = (pos.contiguous(), rows.senders, rows.receivers, rest)
        native.call("strain", *ends, len(rows.senders), scale, at + 4 * column, stride)


def _base_body(group: physical.BaseBodyRelative, inputs: Inputs, at: int, stride: int) -> None:
    edges = inputs.body_edges
    pos = torch.cat([inputs.base, inputs.body(inputs.obstacle.next_pos)])
    native.call("relative", pos, edges.senders, edges.receivers, edges.num_edges, _scale(group), None, at, stride)


#: Groups that the library knows. Of what they leave out, all rows of zeros: the table begins with them.
FILLS: dict[type[nn.Module], Fill] = {
    physical.RelativeVelocity: _relative_velocity,
    Normal: _normal,
    physical.Residual: _view("residual"),
    local.LocalStep: _view("local_step"),
    local.WideResidual: _view("wide_residual"),
    local.GlobalStep: _view("global_step"),
    physical.ContactDistance: _contact,
    physical.ScaledShape: _scaled_shape,
    physical.Strain: _strain,
    physical.BaseBodyRelative: _base_body,
}


# ---- assembly --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Constants:
    """Tables of one cloth with the columns that stay, and zeros elsewhere."""

    rows: EdgeRows  # of this cloth
    nodes: Tensor  # (V, node width)
    edges: Tensor  # (N, edge width)


_CONSTANTS: weakref.WeakKeyDictionary[FeatureSet, _Constants] = weakref.WeakKeyDictionary()


def _constants(features: FeatureSet, inputs: Inputs) -> _Constants:
    known = _CONSTANTS.get(features)
    if known is None or known.rows is not inputs.edges:
        nodes = inputs.state.pos.new_zeros(inputs.num_cloth, features.node_width)
        edges = inputs.state.pos.new_zeros(len(inputs.edges.senders), _width(features.edge))
        for place, group in _places(features.node):
            if type(group) in CONSTANT:
                nodes[:, place : place + group.width] = group.cloth(inputs)
        for place, group in _places(features.edge):
            if type(group) in CONSTANT:
                edges[:, place : place + group.width] = group(inputs)
            elif type(group) is physical.ScaledShape:
                edges[:, place + 4 : place + 8] = group(inputs)[:, 4:]  # the rest shape
        known = _CONSTANTS[features] = _Constants(inputs.edges, nodes, edges)
    return known


def _places(groups: Iterable[Any]) -> list[tuple[int, Any]]:
    """First columns of groups, and the groups."""
    place, result = 0, []
    for group in groups:
        result.append((place, group))
        place += int(group.width)
    return result


def _width(groups: Iterable[Any]) -> int:
    return sum(int(group.width) for group in groups)


def node_columns(features: FeatureSet, inputs: Inputs) -> Tensor:
    """(V + W_active, node width), not normalised."""
    known = _constants(features, inputs).nodes
    out = known.new_zeros(inputs.num_cloth + inputs.num_body, known.shape[1])
    out[: inputs.num_cloth] = known
    for place, group in _places(features.node):
        if type(group) in CONSTANT:
            if inputs.num_body and type(group) is physical.TypeOneHot:
                out[inputs.num_cloth :, place + 2] = 1.0
        elif type(group) is physical.LogTimestep and inputs.cloth.num_scenes == 1:
            timestep = inputs.step.dt if inputs.timestep is None else inputs.timestep
            out[:, place] = math.log(30 * float(timestep))
        else:
            _fill(group, inputs, out, place)
    return out


def edge_columns(features: FeatureSet, inputs: Inputs) -> Tensor:
    """(N, edge width) of all cloth edges, not normalised."""
    out = _constants(features, inputs).edges.clone()
    for place, group in _places(features.edge):
        if type(group) not in CONSTANT:
            _fill(group, inputs, out, place)
    return out


def body_edge_columns(features: FeatureSet, inputs: Inputs) -> Tensor:
    """(N, body edge width), not normalised."""
    out = inputs.state.pos.new_zeros(inputs.body_edges.num_edges, _width(features.body_edge))
    for place, group in _places(features.body_edge):
        _fill(group, inputs, out, place)
    return out


def _fill(group: Any, inputs: Inputs, out: Tensor, place: int) -> None:
    fill = FILLS.get(type(group))
    if fill is None:
        out[:, place : place + group.width] = group(inputs)
    else:
        fill(group, inputs, out.data_ptr() + 4 * place, out.shape[1])


COMPILED_COLUMNS = Columns(node_columns, edge_columns, body_edge_columns)


# ---- between passes --------------------------------------------------------------------------------------------------


def look(inputs: Inputs, sets: Sequence[str]) -> tuple[Tensor, dict[str, Tensor]]:
    """What :func:`hood.model.features.local.look_local` shows."""
    assert inputs.residual is not None
    assert inputs.local_step is not None
    assert inputs.wide_residual is not None
    width = (local.LOOK_WIDTHS if inputs.global_step is None else local.GLOBAL_LOOK_WIDTHS)[0]
    out = inputs.base.new_empty(inputs.num_cloth, width)
    at, stride = out.data_ptr(), out.shape[1]
    _compressed(inputs.residual, physical.GRAVITY, at, stride)
    _compressed(inputs.local_step, local.STEP, at + 12, stride)
    _moved(inputs, local.MOVE, at + 24, stride)
    _contact(local.CONTACT, inputs, at + 36, stride, width=1)
    native.call("size", inputs.local_step.contiguous(), inputs.num_cloth, local.STEP, at + 40, stride)
    _compressed(inputs.wide_residual, physical.GRAVITY, at + 44, stride)
    if inputs.global_step is not None:
        _compressed(inputs.global_step, local.WAVE, at + 68, stride)
        native.call("size", inputs.global_step.contiguous(), inputs.num_cloth, local.WAVE, at + 80, stride)
    return out, {name: _strain_of(inputs, name) for name in sets}


def _strain_of(inputs: Inputs, name: str) -> Tensor:
    edges = inputs.graph.edge_sets[name]
    rest = inputs.edges.once("rest length", lambda: physical.rest_length(inputs))
    before = inputs.cloth_sets[: inputs.cloth_sets.index(name)]
    start = sum(inputs.graph.edge_sets[other].num_edges for other in before)
    own = rest[start : start + edges.num_edges]
    out = own.new_empty(edges.num_edges, 1)
    ends = (inputs.base.contiguous(), edges.senders, edges.receivers, own)
    native.call("strain", *ends, edges.num_edges, 1.0 / local.GAIN, out, 1)
    return out

"""Feature groups of models that correct their own predictions: what the potential says about positions, of single vertices
and of neighbourhoods. The same columns, fewer, are seen again between the passes of such a model (:func:`look_local`).

Averages over growing neighbourhoods of a mesh, and the adjoint: long waves out of short ones.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from hood.model.features.feature_set import FeatureSet
from hood.model.features.groups import EdgeGroup, NodeGroup, cloth_difference
from hood.model.features.inputs import Inputs, rest_vectors
from hood.model.features.normalizer import FixedScale
from hood.model.features.physical import GRAVITY, ContactDistance, Residual, edge_length, mean_rest_length, physical
from hood.native import features as native
from hood.tensors.batch import made_of
from hood.tensors.dense import RowSums

#: Rounds of diffusion of the residuals of small and of large neighbourhoods.
WIDE_ROUNDS = (4, 16)
#: Local steps of stiff cloth are of this size [m]; displacements of a pass of that one; strains of a percent matter.
STEP, MOVE, GAIN = 1e-4, 1e-2, 100.0
#: Global steps are of this size [m]; they turn and stretch edges by such shares of their lengths.
WAVE, TURN, STRETCH = 1e-3, 0.03, 0.01


class _View(NodeGroup, ABC):
    """asinh(value/scale) of what the potential says about the cloth; 0 on the body."""

    needs_contact = True
    needs_feedback = True

    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = FixedScale(scale, asinh=True)

    @abstractmethod
    def value(self, inputs: Inputs) -> Tensor | None:
        """(V, width), None where it was not computed."""

    def cloth(self, inputs: Inputs) -> Tensor:
        return self.scale(_demand(self.value(inputs)))

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.state.pos.new_zeros(inputs.num_body, self.width)


class LocalStep(_View):
    """What a vertex alone would do about the residual [m], in the unit of stiff cloth's errors."""

    width = 3

    def __init__(self, scale: float = STEP) -> None:
        super().__init__(scale)

    def value(self, inputs: Inputs) -> Tensor | None:
        return inputs.local_step


class GlobalStep(_View):
    """What all vertices together would do about the residual [m]."""

    width = 3
    needs_global_step = True

    def __init__(self, scale: float = WAVE) -> None:
        super().__init__(scale)

    def value(self, inputs: Inputs) -> Tensor | None:
        return inputs.global_step


class WideResidual(_View):
    """The residual [m/s²] of neighbourhoods instead of single vertices: what is left where internal forces cancel. Sums over
    compressed residuals of single vertices could not recover it."""

    width = 3 * len(WIDE_ROUNDS)

    def __init__(self, scale: float = GRAVITY) -> None:
        super().__init__(scale)

    def value(self, inputs: Inputs) -> Tensor | None:
        return inputs.wide_residual


class EdgeGlobalStep(EdgeGroup):
    """What the global step makes of an edge: asinh(change/``turn``), in mean rest lengths of its set, and of its length,
    asinh(change/``stretch``). Differences of compressed columns of the two vertices could not recover either."""

    width = 4
    needs_base = True
    needs_global_step = True

    def __init__(self, turn: float = TURN, stretch: float = STRETCH) -> None:
        super().__init__()
        self.turn, self.stretch = FixedScale(turn, asinh=True), FixedScale(stretch, asinh=True)

    def forward(self, inputs: Inputs) -> Tensor:
        unit = inputs.edges.once("mean length", lambda: mean_rest_length(inputs))
        change, before = (cloth_difference(pos, inputs) for pos in (_demand(inputs.global_step), inputs.base))
        longer = edge_length(before + change) - edge_length(before)
        return torch.cat([self.turn(change / unit), self.stretch(longer / unit)], dim=1)


#: What :func:`look_local` reads; they have no parameters.
_RESIDUAL, _LOCAL_STEP, _WIDE, CONTACT, _GLOBAL = Residual(), LocalStep(), WideResidual(), ContactDistance(), GlobalStep()

#: Columns of :func:`look_local` of nodes and of edges.
LOOK_WIDTHS = (3 + 3 + 3 + 1 + 1 + WideResidual.width, 1)
#: The same where global steps are seen.
GLOBAL_LOOK_WIDTHS = (LOOK_WIDTHS[0] + GlobalStep.width + 1, LOOK_WIDTHS[1])


def look_local(inputs: Inputs, sets: Sequence[str]) -> tuple[Tensor, dict[str, Tensor]]:
    """What is seen of a prediction ``inputs.base`` before the next pass: columns of the cloth nodes (V, 17), or (V, 21) with
    global steps, and the strain (N, 1) of the edge sets ``sets``; fixed scales, outliers compressed by asinh."""
    step = _demand(inputs.local_step)
    moved = inputs.state.vel * inputs.vertex_dt - (inputs.base - inputs.state.pos)
    nodes = [
        _RESIDUAL.cloth(inputs),
        _LOCAL_STEP.cloth(inputs),
        torch.asinh(moved / MOVE),
        CONTACT.cloth(inputs)[:, :1],
        _LOCAL_STEP.scale(edge_length(step)),
        _WIDE.cloth(inputs),
    ]
    if inputs.global_step is not None:
        nodes += [_GLOBAL.cloth(inputs), _GLOBAL.scale(edge_length(inputs.global_step))]
    return torch.cat(nodes, dim=1), {name: _strain(inputs, name) for name in sets}


def local(
    num_levels: int = 3,
    layers: bool = False,
    together: bool = False,
    more: Sequence[NodeGroup | EdgeGroup] = (),
    of_edges: bool = False,
) -> FeatureSet:
    """The physical features with local steps and wide residuals, and with global steps (``together``), of edges as well
    (``of_edges``)."""
    views: list[NodeGroup | EdgeGroup] = [LocalStep(), WideResidual()]
    views += [GlobalStep()] if together else []
    views += [EdgeGlobalStep()] if together and of_edges else []
    return physical(num_levels, views, layers, more)


def _strain(inputs: Inputs, name: str) -> Tensor:
    """asinh(100·(length/rest length − 1)) of the edges (N, 1) at the base; 0 for edges of no rest length."""
    rows = inputs.graph.edge_sets[name]
    now = edge_length(inputs.base[rows.senders] - inputs.base[rows.receivers])
    rest = edge_length(rest_vectors(inputs.cloth, inputs.graph, name))
    proper = rest > 1e-6
    return torch.asinh(GAIN * torch.where(proper, now / torch.where(proper, rest, 1.0) - 1, 0.0))


def _demand(values: Tensor | None) -> Tensor:
    if values is None:
        raise ValueError(
            "features: these features say what the potential does; pass Inputs(local_step=…, wide_residual=…), "
            "and global_step=… to models that see it"
        )
    return values


class Diffusion:
    """A round S replaces a vertex's value by half of it plus half of its neighbours' mean.

    Forces spread by its adjoint say what a whole neighbourhood feels, internal forces cancelling. Isolated vertices lose
    half of theirs in a round; give them zeros.
    """

    def __init__(self, edges: Tensor, num_vertices: int) -> None:
        start, end = edges.unbind(dim=1)
        senders, receivers = torch.cat([start, end]), torch.cat([end, start])
        degree = receivers.new_zeros(num_vertices).index_add(0, receivers, torch.ones_like(receivers))
        self._sum = RowSums(receivers, senders, num_vertices)
        self._half = (0.5 / degree.clamp_min(1)).unsqueeze(1)

    def spread(self, values: Tensor, rounds: int) -> Tensor:
        """``rounds`` rounds of the adjoint: the sums of the columns of values (V, C) stay what they are."""
        half = self._half.to(values)
        for _ in range(rounds):
            values = 0.5 * values + self._sum(half * values)
        return values


class _Neighbours(NamedTuple):
    """Neighbours of the vertices of a mesh, vertex by vertex."""

    first: Tensor  # (V + 1,) where those of each vertex begin
    other: Tensor  # (2E,)

    def pointers(self) -> native.Neighbours:
        """The tables as the compiled functions read them; valid as long as they live."""
        return native.Neighbours(len(self.first) - 1, self.first.data_ptr(), self.other.data_ptr())


def neighbours_of(edges: Tensor, num_vertices: int) -> _Neighbours:
    """Neighbours by undirected ``edges`` (E, 2), kept as long as that tensor lives."""
    made = made_of(edges)
    count, known = made.get("neighbours", (None, None))
    if known is not None and count == num_vertices:
        return known
    start, end = edges.unbind(dim=1)
    senders, receivers = torch.cat([start, end]), torch.cat([end, start])
    degree = torch.bincount(receivers, minlength=num_vertices)
    first = torch.cat([degree.new_zeros(1), degree.cumsum(0)])
    found = _Neighbours(first, senders[torch.argsort(receivers, stable=True)].contiguous())
    made["neighbours"] = num_vertices, found
    return found

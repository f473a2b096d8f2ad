"""Feature groups of models that correct their own predictions: what the potential says about positions, of single vertices
and of neighbourhoods. The same columns, fewer, are seen again between the passes of such a model (:func:`look`)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hood.features.groups import FeatureSet, NodeGroup
from hood.features.inputs import Inputs
from hood.features.normalizer import FixedScale
from hood.features.physical import GRAVITY, ContactDistance, Residual, length, physical

#: Rounds of diffusion of the residuals of small and of large neighbourhoods.
WIDE_ROUNDS = (4, 16)
#: Local steps of stiff cloth are of this size [m]; displacements of a pass of that one; strains of a percent matter.
_STEP, _MOVE, _GAIN = 1e-4, 1e-2, 100.0


class LocalStep(NodeGroup):
    """asinh(step/scale): what a vertex alone would do about the residual, in the unit of stiff cloth's errors; 0 on the
    body."""

    width = 3
    needs_contact = True

    def __init__(self, scale: float = _STEP) -> None:
        super().__init__()
        self.scale = FixedScale(scale, asinh=True)

    def cloth(self, inputs: Inputs) -> Tensor:
        return self.scale(_demand(inputs.local_step))

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.state.pos.new_zeros(inputs.num_body, self.width)


class WideResidual(NodeGroup):
    """asinh(residual/g) of neighbourhoods instead of single vertices: what is left where internal forces cancel; 0 on the
    body. Sums over compressed residuals of single vertices could not recover it."""

    width = 3 * len(WIDE_ROUNDS)
    needs_contact = True

    def __init__(self, scale: float = GRAVITY) -> None:
        super().__init__()
        self.scale = FixedScale(scale, asinh=True)

    def cloth(self, inputs: Inputs) -> Tensor:
        return self.scale(_demand(inputs.wide_residual))

    def body(self, inputs: Inputs) -> Tensor:
        return inputs.state.pos.new_zeros(inputs.num_body, self.width)


#: Columns of :func:`look` of nodes and of edges.
LOOK_WIDTHS = (3 + 3 + 3 + 1 + 1 + WideResidual.width, 1)


def look(inputs: Inputs, sets: Sequence[str]) -> tuple[Tensor, dict[str, Tensor]]:
    """What is seen of a prediction ``inputs.base`` before the next pass: columns (V, 17) of the cloth nodes, and the strain
    (N, 1) of the edge sets ``sets``; fixed scales, outliers compressed by asinh."""
    step = _demand(inputs.local_step)
    moved = inputs.state.vel * inputs.vertex_dt - (inputs.base - inputs.state.pos)
    nodes = [
        Residual().cloth(inputs),
        torch.asinh(step / _STEP),
        torch.asinh(moved / _MOVE),
        ContactDistance().cloth(inputs)[:, :1],
        torch.asinh(length(step) / _STEP),
        torch.asinh(_demand(inputs.wide_residual) / GRAVITY),
    ]
    return torch.cat(nodes, dim=1), {name: _strain(inputs, name) for name in sets}


def local(num_levels: int = 3) -> FeatureSet:
    """The physical features with local steps and wide residuals."""
    return physical(num_levels, [LocalStep(), WideResidual()])


def _strain(inputs: Inputs, name: str) -> Tensor:
    """asinh(100·(length/rest length − 1)) of the edges (N, 1) at the base; 0 for edges of no rest length."""
    rows = inputs.graph.edge_sets[name]
    now, rest = (length(pos[rows.senders] - pos[rows.receivers]) for pos in (inputs.base, inputs.cloth.rest_pos))
    proper = rest > 1e-6
    return torch.asinh(_GAIN * torch.where(proper, now / torch.where(proper, rest, 1.0) - 1, 0.0))


def _demand(values: Tensor | None) -> Tensor:
    if values is None:
        raise ValueError("features: these features say what the potential does; pass Inputs(local_step=…, wide_residual=…)")
    return values

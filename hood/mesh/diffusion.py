"""Averages over growing neighbourhoods of a mesh, and the adjoint: long waves out of short ones."""

from __future__ import annotations

import torch
from torch import Tensor


class Diffusion:
    """A round S replaces a vertex's value by half of it plus half of its neighbours' mean.

    Forces spread by its adjoint say what a whole neighbourhood feels, internal forces cancelling. Isolated vertices lose
    half of theirs in a round; give them zeros.
    """

    def __init__(self, edges: Tensor, num_vertices: int) -> None:
        start, end = edges.unbind(dim=1)
        self._senders, self._receivers = torch.cat([start, end]), torch.cat([end, start])
        degree = torch.bincount(self._receivers, minlength=num_vertices).clamp_min(1)
        self._half = (0.5 / degree).unsqueeze(1)

    def spread(self, values: Tensor, rounds: int) -> Tensor:
        """``rounds`` rounds of the adjoint: the sums of the columns of values (V, C) stay what they are."""
        half = self._half.to(values)
        for _ in range(rounds):
            values = 0.5 * values + self._sum(half * values)
        return values

    def _sum(self, values: Tensor) -> Tensor:
        return torch.zeros_like(values).index_add(0, self._receivers, values.index_select(0, self._senders))

"""Averages over growing neighbourhoods of a mesh, and the adjoint: long waves out of short ones."""

from __future__ import annotations

import weakref
from typing import NamedTuple

import torch
from torch import Tensor

from hood.native import features
from hood.tensors.batch import forget
from hood.tensors.dense import RowSums


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

    def pointers(self) -> features.Neighbours:
        """The tables as the compiled functions read them; valid as long as they live."""
        return features.Neighbours(len(self.first) - 1, self.first.data_ptr(), self.other.data_ptr())


_NEIGHBOURS: dict[int, tuple[weakref.ref[Tensor], int, _Neighbours]] = {}


def neighbours_of(edges: Tensor, num_vertices: int) -> _Neighbours:
    """Neighbours by undirected ``edges`` (E, 2), kept as long as that tensor lives."""
    key = id(edges)
    known = _NEIGHBOURS.get(key)
    if known is not None and known[0]() is edges and known[1] == num_vertices:
        return known[2]
    start, end = edges.unbind(dim=1)
    senders, receivers = torch.cat([start, end]), torch.cat([end, start])
    degree = torch.bincount(receivers, minlength=num_vertices)
    first = torch.cat([degree.new_zeros(1), degree.cumsum(0)])
    found = _Neighbours(first, senders[torch.argsort(receivers, stable=True)].contiguous())
    _NEIGHBOURS[key] = (weakref.ref(edges, forget(_NEIGHBOURS, key)), num_vertices, found)
    return found

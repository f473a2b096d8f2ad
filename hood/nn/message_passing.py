"""One processor step: every active edge set updates its edges, then one node network updates all nodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from hood.graph.builder import EdgeSet, Subset
from hood.nn.mlp import MLP


class _SumRows(torch.autograd.Function):
    """out[m] = Σ x[order[i]] over i in offsets[m] … offsets[m + 1], where row order[i] belongs to node m.

    ``owner`` (N,) is the node of every row of ``x``. Sums run in a fixed order, so results are deterministic.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, order: Tensor, offsets: Tensor, owner: Tensor) -> Tensor:
        ctx.save_for_backward(order, offsets, owner)
        # The fastest row sum on a CPU by a factor of 2 over CSR products and 2–5 over index_add (measured).
        return functional.embedding_bag(order, x, offsets, mode="sum", include_last_offset=True)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        order, offsets, owner = ctx.saved_tensors
        return _TakeRows.apply(grad, order, offsets, owner), None, None, None


class _TakeRows(torch.autograd.Function):
    """out[i] = x[owner[i]]; the transpose of :class:`_SumRows` and its backward."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, order: Tensor, offsets: Tensor, owner: Tensor) -> Tensor:
        ctx.save_for_backward(order, offsets, owner)
        return x.index_select(0, owner)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        order, offsets, owner = ctx.saved_tensors
        return _SumRows.apply(grad.contiguous(), order, offsets, owner), None, None, None


def sum_to_receivers(x: Tensor, edges: EdgeSet) -> Tensor:
    """Sum of edge rows ``x`` (N, d) at the receivers: (M, d), one row per node of ``edges.nodes``."""
    rows = torch.arange(edges.num_edges, device=x.device)
    return _SumRows.apply(x.contiguous(), rows, edges.offsets, edges.local_receivers)


def take_receivers(x: Tensor, edges: EdgeSet) -> Tensor:
    """Row of the receiver of every edge: (M, d) → (N, d)."""
    rows = torch.arange(edges.num_edges, device=x.device)
    return _TakeRows.apply(x, rows, edges.offsets, edges.local_receivers)


def take_senders(x: Tensor, edges: EdgeSet) -> Tensor:
    """Row of the sender of every edge: (M, d) → (N, d)."""
    return _TakeRows.apply(x, edges.reverse, edges.offsets, edges.local_senders)


class ProcessorStep(nn.Module):
    """e' = e + MLP_s([v_receiver, v_sender, e]) in every set s; v' = v + MLP([v, Σ_s1, Σ_s2, …]), where Σ_s is the sum of
    the edge networks' outputs (before their residual) over the incoming edges of s (paper, equations 2 and 3).

    First layers are split by columns, W [v_r, v_s, e] = W_r v_r + W_s v_s + W_e e, and the node parts are computed once
    per node instead of once per edge. Nodes without an edge in s receive zeros from it; every node is updated.

    Args:
        sets: edge sets in the order of the node network's input.
        latent_dim: width of all latents.
        aggregation: ``sum`` (the paper's formula) or ``mean`` (its prose).
    """

    def __init__(self, sets: Sequence[str], latent_dim: int, aggregation: str = "sum") -> None:
        super().__init__()
        if aggregation not in ("sum", "mean"):
            raise ValueError(f"aggregation is {aggregation!r}; choose 'sum' or 'mean'")
        self.sets = tuple(sets)
        self.latent_dim = latent_dim
        self.aggregation = aggregation
        self.edge_mlps = nn.ModuleDict({name: MLP(3 * latent_dim, latent_dim, latent_dim) for name in self.sets})
        self.node_mlp = MLP((1 + len(self.sets)) * latent_dim, latent_dim, latent_dim)

    def forward(
        self, nodes: Tensor, edges: dict[str, Tensor], subsets: dict[str, Subset]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Nodes (N, latent_dim) and edge latents by set; ``subsets`` says which rows of a set take part."""
        first = self.node_mlp.layers[0]
        own, *parts = first.weight.split(self.latent_dim, dim=1)
        hidden = functional.linear(nodes, own, first.bias)
        edges = dict(edges)
        for name, weight in zip(self.sets, parts, strict=True):
            subset = subsets[name]
            if subset.edges.num_edges == 0:
                continue
            edges[name], received = self._update_edges(name, nodes, edges[name], subset)
            hidden = hidden.index_add_(0, subset.edges.nodes, functional.linear(received, weight))
        return nodes + self.node_mlp.tail(hidden), edges

    def _update_edges(self, name: str, nodes: Tensor, latent: Tensor, subset: Subset) -> tuple[Tensor, Tensor]:
        """New latents of a set, and the aggregate (M, latent_dim) at the nodes that have an edge in it."""
        mlp, edges, rows = self.edge_mlps[name], subset.edges, subset.rows
        first = mlp.layers[0]
        to_receiver, to_sender, to_edge = first.weight.split(self.latent_dim, dim=1)
        present = nodes.index_select(0, edges.nodes)
        active = latent if rows is None else latent.index_select(0, rows)
        hidden = functional.linear(active, to_edge, first.bias)
        hidden = hidden + take_receivers(functional.linear(present, to_receiver), edges)
        hidden = hidden + take_senders(functional.linear(present, to_sender), edges)
        message = mlp.tail(hidden)
        received = sum_to_receivers(message, edges)
        if self.aggregation == "mean":
            received = received / edges.offsets.diff().unsqueeze(1).to(received.dtype)
        updated = latent + message if rows is None else latent.index_add(0, rows, message)
        return updated, received

"""One processor step: every active edge set updates its edges, then one node network updates all nodes.

The decoder of mesh edges, from an edge's latent and those of its two ends.

The edge network of one processor step as one differentiable operation, in cache-sized blocks of rows.

Composed from single operations the step streams every intermediate (N, d) array through memory in forward and backward;
here a block stays in cache from the first layer to the layer norm, and the backward pass is written out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from hood.model.graph.builder import EdgeSet, Subset
from hood.model.kernels import block, triton_step
from hood.model.network.mlp import MLP, Kept, Layers
from hood.tensors.dense import affine_plus, blocks, gram, linear, pad_rows, relu_, sum_rows, wants_padding


class EdgeDecoder(nn.Module):
    """(N, out_width) for the rows of an edge set, both directions apart: MLP([v_receiver, v_sender, e]).

    The first layer is evaluated in parts: at the nodes, where there are fewer rows than edges, and at the edges.
    """

    def __init__(self, latent_dim: int, out_width: int) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.mlp = MLP(3 * latent_dim, latent_dim, out_width, norm=False)

    def forward(self, nodes: Tensor, latent: Tensor, edges: EdgeSet) -> Tensor:
        """
        Args:
            nodes: (V, latent_dim) of the cloth.
            latent: (N, latent_dim) of the rows of ``edges``.
        """
        first = self.mlp.first
        at_receiver, at_sender, own = first.weight.split(self.latent_dim, dim=1)
        hidden = linear(latent[: edges.num_edges], own, first.bias)
        hidden = hidden + linear(nodes, at_receiver).index_select(0, edges.receivers)
        hidden = hidden + linear(nodes, at_sender).index_select(0, edges.senders)
        return self.mlp.tail(hidden)


def update_edges(mlp: MLP, nodes: Tensor, latent: Tensor, edges: EdgeSet, overwrite: bool = False) -> tuple[Tensor, Tensor]:
    """e' = e + m and Σ m at the receivers, m = MLP([v_receiver, v_sender, e]) with a layer norm at its output.

    The first layer is split by columns, W [v_r, v_s, e] = W_r v_r + W_s v_s + W_e e: its node parts are evaluated once
    per node instead of once per edge.

    Args:
        mlp: edge network, 3d → d.
        nodes: latents of ``edges.nodes`` in its first M rows; d columns. More rows are room for rounding up.
        latent: (N, d) edge latents.
        overwrite: ``latent`` may be used for the new latents; without gradients only.

    Returns:
        New edge latents (N, d) and the sums, as many rows as ``nodes``.
    """
    assert mlp.norm is not None, "edge networks end in a layer norm"
    to_receiver, to_sender, to_edge = mlp.first.weight.split(latent.shape[1], dim=1)
    # One product for both ends of an edge, and one table, from which one operation gathers and adds two rows.
    weight = torch.cat([to_receiver, to_sender])
    table = linear(nodes, weight, torch.cat([mlp.first.bias, torch.zeros_like(mlp.first.bias)]))
    keep = torch.is_grad_enabled()
    overwrite = overwrite and not keep
    parameters = mlp.tail_parameters()
    if mlp.compiled and block.applies(latent, parameters):
        setting = block.Setting(keep, mlp.norm.eps, edges, overwrite)
        return block.update_edges_compiled(latent, table, to_edge, setting, *parameters)
    result: tuple[Tensor, Tensor] = _EdgeUpdate.apply(latent, table, to_edge, edges, keep, overwrite, mlp.norm.eps, *parameters)
    return result


class _EdgeUpdate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        latent: Tensor,
        table: Tensor,
        to_edge: Tensor,
        edges: EdgeSet,
        keep: bool,
        overwrite: bool,
        eps: float,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:
        layers, weight = Layers(latent.dtype, eps, parameters), to_edge.to(latent.dtype)
        received = latent.new_zeros(table.shape[0], latent.shape[1])
        table = table.view(-1, latent.shape[1])
        updated = latent if overwrite else torch.empty_like(latent)
        saved: list[Tensor] = []
        parts = list(blocks(latent))
        spans = edges.spans(parts[0].stop) if parts else []
        for part, (nodes, offsets) in zip(parts, spans, strict=True):
            ends = functional.embedding_bag(edges.ends[part], table, mode="sum")
            message, kept = layers.forward(relu_(affine_plus(latent[part], weight, ends)))
            # A node's edges may lie in two blocks, so its sum is completed rather than set.
            received[nodes] += sum_rows(message, edges.rows[: part.stop - part.start], offsets)
            torch.add(latent[part], message, out=updated[part])
            if keep:
                saved += kept
        if keep:
            ctx.save_for_backward(latent, to_edge, *parameters, *saved)
            ctx.edges, ctx.eps, ctx.parts = edges, eps, parts
        return updated, received

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_updated: Tensor, grad_sum: Tensor) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors  # once: under activation checkpointing a second look would compute them again
        (latent, to_edge, *parameters), saved = tensors[:8], tensors[8:]
        edges: EdgeSet = ctx.edges
        layers, weight = Layers(latent.dtype, ctx.eps, tuple(parameters)), to_edge.to(latent.dtype).t()
        layers.start_backward()
        grad_latent, grad_hidden = torch.empty_like(latent), torch.empty_like(latent)
        grad_edge = torch.zeros_like(to_edge, memory_format=torch.contiguous_format)
        for i, part in enumerate(ctx.parts):
            grad = grad_sum.index_select(0, edges.local_receivers[part]).add_(grad_updated[part])
            before = layers.backward(grad, Kept(*saved[5 * i : 5 * i + 5]), out=grad_hidden[part])
            grad_edge += gram(before, latent[part])
            affine_plus(before, weight, grad_updated[part], out=grad_latent[part])
        grad_table = latent.new_zeros(grad_sum.shape[0], 2, latent.shape[1])
        grad_table[: len(edges.nodes), 0] = sum_rows(grad_hidden, edges.rows, edges.offsets)
        grad_table[: len(edges.nodes), 1] = sum_rows(grad_hidden, edges.reverse, edges.offsets)
        grad_table = grad_table.flatten(1)
        return grad_latent, grad_table, grad_edge, None, None, None, None, *layers.grads


class ProcessorStep(nn.Module):
    """e' = e + MLP_s([v_receiver, v_sender, e]) in every set s; v' = v + MLP([v, Σ_s1, Σ_s2, …]), where Σ_s is the
    sum of the edge networks' outputs (before their residual) over the incoming edges of s (paper, section 4.2).

    Nodes without an edge in s receive zeros from it; every node is updated.

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
        self,
        nodes: Tensor,
        edges: Mapping[str, Tensor],
        subsets: Mapping[str, Subset],
        overwrite: bool = False,
        memory: dict[tuple[str, ...], Tensor] | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Nodes (N, latent_dim) and edge latents by set; ``subsets`` says which rows of a set take part.

        With ``overwrite`` the edge latents given may be used for the new ones where no gradient is asked for. A CUDA device
        with Triton takes :mod:`hood.model.kernels.triton_step`, which without gradients keeps in ``memory`` what steps with the
        same sets and subsets write to.
        """
        if triton_step.applies(self.latent_dim, next(iter(edges.values())).dtype, nodes.device) and self._is_own():
            return triton_step.take(self, nodes, edges, subsets, overwrite, triton_step.input_precision(), memory)
        # The node network's first layer by columns: aggregates exist only at the nodes that have an edge in the set.
        first = self.node_mlp.first
        own, *parts = first.weight.split(self.latent_dim, dim=1)
        updated, low = dict(edges), nodes.to(next(iter(edges.values())).dtype)
        hidden = linear(low, own, first.bias)
        for name, weight in zip(self.sets, parts, strict=True):
            subset = subsets[name]
            if subset.edges.num_edges == 0:
                continue
            updated[name], received = self._update_set(name, low, edges[name], subset, overwrite)
            received, rows = linear(received, weight), subset.edges.nodes.shape[0]
            hidden.index_add_(0, subset.edges.nodes, received if len(received) == rows else received[:rows])
        return self.node_mlp.tail(hidden, nodes), updated

    def _is_own(self) -> bool:
        """Whether it is the function of hood's own classes."""
        parts = (self.node_mlp, *self.edge_mlps.values())
        return (
            type(self) is ProcessorStep
            and self.aggregation == "sum"
            and all(type(part) is MLP and part.norm is not None for part in parts)
        )

    def _update_set(self, name: str, nodes: Tensor, latent: Tensor, subset: Subset, overwrite: bool) -> tuple[Tensor, Tensor]:
        """New latents of a set, and the aggregate at the nodes that have an edge in it (and in rows of no meaning)."""
        mlp, edges, rows = cast(MLP, self.edge_mlps[name]), subset.edges, subset.rows
        padded = wants_padding(nodes)
        present = nodes.index_select(0, pad_rows(edges.nodes) if padded else edges.nodes)
        if rows is None:
            latent, received = update_edges(mlp, present, latent, edges, overwrite)
        else:
            part, received = update_edges(mlp, present, latent.index_select(0, rows), edges, overwrite=True)
            latent = latent.index_copy_(0, rows, part) if overwrite else latent.index_copy(0, rows, part)
        if self.aggregation == "mean":
            degree = edges.offsets.diff()
            degree = (pad_rows(degree) if padded else degree).clamp_min(1)
            received = received / degree.unsqueeze(1).to(received.dtype)
        return latent, received

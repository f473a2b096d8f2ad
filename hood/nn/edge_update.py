"""The edge network of one processor step as one differentiable operation, in cache-sized blocks of rows.

Composed from single operations the step streams every intermediate (N, d) array through memory in forward and backward;
here a block stays in cache from the first layer to the layer norm, and the backward pass is written out.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from hood.graph.builder import EdgeSet
from hood.nn import compiled_block, triton_edge
from hood.nn.dense import affine_plus, blocks, gram, linear, relu_, sum_rows
from hood.nn.mlp import MLP, Kept, Layers


def update_edges(mlp: MLP, nodes: Tensor, latent: Tensor, edges: EdgeSet, overwrite: bool = False) -> tuple[Tensor, Tensor]:
    """e' = e + m and Σ m at the receivers, m = MLP([v_receiver, v_sender, e]) with a layer norm at its output.

    The first layer is split by columns, W [v_r, v_s, e] = W_r v_r + W_s v_s + W_e e: its node parts are evaluated once
    per node instead of once per edge. Without gradients a CUDA device with Triton takes :mod:`hood.nn.triton_edge`.

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
    if triton_edge.applies(latent):
        precision = triton_edge.input_precision()
        return triton_edge.update_edges_fused(mlp, table, latent, edges, overwrite, precision)
    parameters = mlp.tail_parameters()
    if mlp.compiled and compiled_block.applies(latent, parameters):
        setting = compiled_block.Setting(keep, mlp.norm.eps, edges, overwrite)
        return compiled_block.update_edges_compiled(latent, table, to_edge, setting, *parameters)
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
            ctx.edges, ctx.eps = edges, eps
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
        for i, part in enumerate(blocks(latent)):
            grad = grad_sum.index_select(0, edges.local_receivers[part]).add_(grad_updated[part])
            before = layers.backward(grad, Kept(*saved[5 * i : 5 * i + 5]), out=grad_hidden[part])
            grad_edge += gram(before, latent[part])
            affine_plus(before, weight, grad_updated[part], out=grad_latent[part])
        grad_table = latent.new_zeros(grad_sum.shape[0], 2, latent.shape[1])
        grad_table[: len(edges.nodes), 0] = sum_rows(grad_hidden, edges.rows, edges.offsets)
        grad_table[: len(edges.nodes), 1] = sum_rows(grad_hidden, edges.reverse, edges.offsets)
        grad_table = grad_table.flatten(1)
        return grad_latent, grad_table, grad_edge, None, None, None, None, *layers.grads

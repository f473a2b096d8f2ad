"""Blocks of the network by the compiled kernels: an edge update, or the layers behind the first one of any perceptron.

The same functions as :func:`hood.nn.edge_update.update_edges` and :meth:`hood.nn.mlp.MLP.tail`, which stay the reference.
Latents, factors of products and what is kept for the backward pass are in the precision of the input; sums, biases, layer norm,
residual and the gradients of parameters are float32.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hood.graph.builder import EdgeSet
from hood.nn.compiled import LANES, Block, Gradient, call, panel, point
from hood.nn.dense import is_whole


def applies(x: Tensor, parameters: tuple[Tensor, ...]) -> bool:
    """Whether a block of ``x`` (N, d) can go this way: float32 or bfloat16 on a CPU, not traced, float32 parameters, as many
    outputs as inputs, d a multiple of :data:`hood.nn.compiled.LANES`."""
    if type(x) is not Tensor or x.device.type != "cpu" or is_whole() or torch.compiler.is_compiling():
        return False
    square = parameters[0].shape == parameters[2].shape == (x.shape[1], x.shape[1]) and x.shape[1] % LANES == 0
    known = x.dtype in (torch.float32, torch.bfloat16)
    return known and square and all(p.dtype == torch.float32 for p in parameters)


class Setting(NamedTuple):
    """What a block is told besides its tensors."""

    keep: bool
    eps: float
    edges: EdgeSet | None = None  # of an edge update
    overwrite: bool = False  # the latents given may be used for the new ones


def update_edges_compiled(
    latent: Tensor, table: Tensor, to_edge: Tensor, setting: Setting, *parameters: Tensor
) -> tuple[Tensor, Tensor]:
    """New edge latents (N, d) and the sums at the receivers (R, d) from a table (R, 2d) of the first layer's node parts."""
    result: tuple[Tensor, Tensor] = _Compiled.apply(latent, table, to_edge, None, setting, *parameters)
    return result


def tail_compiled(hidden: Tensor, residual: Tensor | None, setting: Setting, *parameters: Tensor) -> Tensor:
    """Second and third layer, layer norm and residual, (N, d), from the first layer's output before its ReLU."""
    result: Tensor = _Compiled.apply(hidden, None, None, residual, setting, *parameters)
    return result


class _Compiled(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        table: Tensor | None,
        first: Tensor | None,
        residual: Tensor | None,
        setting: Setting,
        *parameters: Tensor,
    ) -> Tensor | tuple[Tensor, Tensor]:
        given, x = x, x.contiguous()
        second, bias_2, third, bias_3, scale, shift = (p.contiguous() for p in parameters)
        weights = [None if w is None else panels(w, x.dtype) for w in (first, second, third)]
        other = x if table is not None else None if residual is None else residual.contiguous()
        out = x if setting.overwrite else torch.empty_like(x if other is None else other)
        received = None if table is None else x.new_zeros(table.shape[0], x.shape[1])
        kept = [torch.empty_like(x) for _ in range(3)] + [x.new_empty(len(x), dtype=torch.float32)] if setting.keep else []
        values = Block(count=len(x), wide=int(out.dtype == torch.float32), eps=setting.eps)
        table = None if table is None else table.contiguous()
        point(values, x=x, table=table, residual=other, out=out, received=received, **dict(zip(KEPT, kept, strict=False)))
        point(values, first=weights[0], second=weights[1], third=weights[2])
        point(values, bias_2=bias_2, bias_3=bias_3, scale=scale, shift=shift)
        if setting.edges is not None:
            point(values, receivers=setting.edges.local_receivers, senders=setting.edges.local_senders)
        call("forward", values, x.shape[1], x.dtype == torch.bfloat16)
        if setting.keep:
            ctx.save_for_backward(given, first, *parameters, *kept)
            ctx.edges, ctx.rows = setting.edges, 0 if table is None else len(table)
            ctx.set_materialize_grads(False)  # of the last step's edges there are none
        return out if received is None else (out, received)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor | None, grad_sum: Tensor | None = None) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors  # once: under activation checkpointing a second look would compute them again
        x, first, parameters, kept = tensors[0].contiguous(), tensors[1], tensors[2:8], tensors[8:]
        edges: EdgeSet | None = ctx.edges
        grad = None if grad is None else grad.contiguous()
        grads = [torch.zeros_like(p, memory_format=torch.contiguous_format) for p in parameters]
        grad_first = None if first is None else torch.zeros_like(first, memory_format=torch.contiguous_format)
        grad_x = torch.empty_like(x)
        values = Gradient(count=len(x), wide=int(grad is not None and grad.dtype == torch.float32))
        weights = [None if w is None else panels(w.t(), x.dtype) for w in (first, parameters[0], parameters[2])]
        scale = parameters[4].contiguous()
        point(values, x=x, grad=grad, grad_x=grad_x, **dict(zip(KEPT, kept, strict=True)))
        point(values, first=weights[0], second=weights[1], third=weights[2], scale=scale, grad_first=grad_first)
        point(values, **dict(zip(PARAMETERS, grads, strict=True)))
        grad_table = None
        if edges is not None:
            grad_sum = None if grad_sum is None else grad_sum.contiguous()
            grad_table = x.new_zeros(ctx.rows, 2 * x.shape[1], dtype=torch.float32)
            point(values, grad_sum=grad_sum, grad_table=grad_table)
            point(values, receivers=edges.local_receivers, senders=edges.local_senders)
        call("backward", values, x.shape[1], x.dtype == torch.bfloat16)
        residual = grad if ctx.needs_input_grad[3] else None
        return grad_x, None if grad_table is None else grad_table.to(x.dtype), grad_first, residual, None, *grads


#: Fields of the kept tensors, and of the gradients of the parameters in the order of :meth:`MLP.tail_parameters`.
KEPT = ("one", "two", "hat", "rstd")
PARAMETERS = ("grad_second", "grad_bias_2", "grad_third", "grad_bias_3", "grad_scale", "grad_shift")


def panels(weight: Tensor, dtype: torch.dtype) -> Tensor:
    """``weight`` (out, in) for the kernels' x Wᵀ: panels of columns of Wᵀ, in each the terms of a product one after the other,
    with bfloat16 two of them next to each other."""
    outputs, inputs = weight.shape
    pair = 2 if dtype == torch.bfloat16 else 1
    columns = panel(outputs)
    terms = weight.t().to(dtype).reshape(inputs // pair, pair, outputs // columns, columns)
    return terms.permute(2, 0, 3, 1).contiguous()

"""The multilayer perceptron used everywhere in the network (MeshGraphNets, appendix A.1)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from hood.model.kernels import block, triton_step
from hood.tensors.dense import affine, blocks, gram, linear


class MLP(nn.Module):
    """in → latent → latent → out, ReLU between, LayerNorm on the output unless ``norm`` is False (decoder).

    ``first`` may see the concatenation of several inputs; callers may split its weight by columns, evaluate the parts
    where they are cheapest and continue with :meth:`tail`. ``compiled``: by :mod:`hood.model.kernels.block` where it applies.
    """

    compiled = False

    def __init__(self, in_width: int, latent_dim: int, out_width: int, norm: bool = True) -> None:
        super().__init__()
        self.first = nn.Linear(in_width, latent_dim)
        self.second = nn.Linear(latent_dim, latent_dim)
        self.third = nn.Linear(latent_dim, out_width)
        self.norm = nn.LayerNorm(out_width) if norm else None

    def forward(self, x: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        """(N, in_width) → (N, out_width); layers after the first in ``dtype`` if given."""
        if torch.is_grad_enabled():
            hidden = self.first(x)
            return self.tail(hidden if dtype is None else hidden.to(dtype))
        out = x.new_empty(x.shape[0], self.third.out_features, dtype=dtype)
        for part in blocks(out):  # the first layer's output is as large as the result and needed by blocks only
            out[part] = self.tail(self.first(x[part]).to(out.dtype))
        return out

    def tail(self, hidden: Tensor, residual: Tensor | None = None) -> Tensor:
        """The network from the first layer's output (N, latent_dim), before its ReLU, in the precision of ``hidden``; plus
        ``residual`` (N, out_width) if given."""
        if self.norm is None:
            hidden = torch.relu(linear(torch.relu(hidden), self.second.weight, self.second.bias))
            out = linear(hidden, self.third.weight, self.third.bias)
            return out if residual is None else residual + out
        keep, parameters = torch.is_grad_enabled(), self.tail_parameters()
        if self.compiled and block.applies(hidden, parameters):
            return block.tail_compiled(hidden, residual, block.Setting(keep, self.norm.eps), *parameters)
        if type(self) is MLP and triton_step.applies(hidden.shape[1], hidden.dtype, hidden.device):
            return triton_step.tail_step(hidden, residual, parameters, self.norm.eps, triton_step.input_precision())
        result: Tensor = _Tail.apply(hidden, residual, keep, self.norm.eps, *parameters)
        return result

    def tail_parameters(self) -> tuple[Tensor, ...]:
        """What :class:`Layers` is made of."""
        norm = self.norm
        assert norm is not None, "the decoder has no layer norm"
        return self.second.weight, self.second.bias, self.third.weight, self.third.bias, norm.weight, norm.bias


class Kept(NamedTuple):
    """What the backward pass of a block reads."""

    one: Tensor  # (N, d) after the first ReLU
    two: Tensor  # (N, d) after the second
    raw: Tensor  # (N, d) before the layer norm
    mean: Tensor  # (N, 1)
    rstd: Tensor  # (N, 1)


class Layers:
    """Second and third layer and layer norm, applied to one block of rows at a time, forward and backward.

    Products are in ``dtype``; the layer norm's statistics and the sums of the parameters' gradients over the blocks are in
    the parameters' own precision.
    """

    def __init__(self, dtype: torch.dtype, eps: float, parameters: tuple[Tensor, ...]) -> None:
        self.second, self.bias_2, self.third, self.bias_3 = (p.to(dtype) for p in parameters[:4])
        # Only a CPU's layer norm takes parameters of another precision; the statistics are float32 everywhere.
        on_cpu = parameters[4].device.type == "cpu"
        self.scale, self.shift = (p if on_cpu else p.to(dtype) for p in parameters[4:6])
        self.eps = eps
        self._parameters = parameters
        self.grads: list[Tensor] = []

    def forward(self, one: Tensor) -> tuple[Tensor, Kept]:
        """Output (N, d) from ``one`` (N, d), the first layer's output after its ReLU."""
        two = affine(one, self.second, self.bias_2, relu=True)
        raw = affine(two, self.third, self.bias_3)
        out, mean, rstd = torch.native_layer_norm(raw, (raw.shape[1],), self.scale, self.shift, self.eps)
        return out, Kept(one, two, raw, mean, rstd)

    def start_backward(self) -> None:
        """Set the gradients of the parameters to zero."""
        self.grads = [torch.zeros_like(p) for p in self._parameters]

    def backward(self, grad: Tensor, kept: Kept, out: Tensor) -> Tensor:
        """Gradient before the first ReLU, in ``out``, from ``grad`` behind the layer norm; those of the parameters are added
        up."""
        grad_w2, grad_b2, grad_w3, grad_b3, grad_scale, grad_shift = self.grads
        width = [grad.shape[1]]
        grad, d_scale, d_shift = torch.ops.aten.native_layer_norm_backward(
            grad, kept.raw, width, kept.mean, kept.rstd, self.scale, self.shift, [True, True, True]
        )
        grad_scale += d_scale
        grad_shift += d_shift
        grad_w3 += gram(grad, kept.two)
        grad_b3 += grad.sum(dim=0)
        grad = affine(grad, self.third.t())
        through_relu(grad, kept.two, out=grad)
        grad_w2 += gram(grad, kept.one)
        grad_b2 += grad.sum(dim=0)
        return through_relu(affine(grad, self.second.t()), kept.one, out)


def through_relu(grad: Tensor, output: Tensor, out: Tensor) -> Tensor:
    """Gradient before a ReLU from the one behind it and the ReLU's output; ``out`` may be ``grad``."""
    return torch.ops.aten.threshold_backward.grad_input(grad, output, 0, grad_input=out)


class _Tail(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, hidden: Tensor, residual: Tensor | None, keep: bool, eps: float, *parameters: Tensor) -> Tensor:
        layers = Layers(hidden.dtype, eps, parameters)
        out = torch.empty_like(hidden if residual is None else residual)
        saved: list[Tensor] = []
        ctx.parts = list(blocks(hidden))  # those that something is kept of, whatever mode the way back is taken in
        for part in ctx.parts:
            result, kept = layers.forward(torch.relu(hidden[part]))
            if residual is None:
                out[part] = result
            else:
                torch.add(residual[part], result, out=out[part])
            if keep:
                saved += kept
        ctx.save_for_backward(*parameters, *saved)
        ctx.eps, ctx.dtype = eps, hidden.dtype
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors  # once: under activation checkpointing a second look would compute them again
        parameters, saved = tensors[:6], tensors[6:]
        layers = Layers(ctx.dtype, ctx.eps, parameters)
        layers.start_backward()
        grad_hidden = torch.empty(grad.shape, dtype=ctx.dtype, device=grad.device)
        for i, part in enumerate(ctx.parts):
            kept = Kept(*saved[5 * i : 5 * i + 5])
            layers.backward(grad[part].to(ctx.dtype).contiguous(), kept, out=grad_hidden[part])
        return grad_hidden, grad if ctx.needs_input_grad[1] else None, None, None, *layers.grads

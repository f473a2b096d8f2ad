"""Optimisers for networks whose loss is ill-conditioned: orthogonalised momentum for matrices, Adam for the rest."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from hood.dynamics.simulator import Simulator

#: Coefficients of the quintic Newton-Schulz iteration towards the nearest orthogonal matrix (Jordan et al., "Muon", 2024).
_QUINTIC = (3.4445, -4.7750, 2.0315)
#: Root mean square of Adam's updates in units of its rate, about: both parts then share one rate (Liu et al., 2025).
_ADAM_RMS = 0.2


#: Names for :func:`make_optimizer`.
OPTIMIZERS = ("adam", "muon")


def make_optimizer(name: str, simulator: Simulator, learning_rate: float) -> torch.optim.Optimizer:
    """``adam``, or ``muon`` for the matrices between latents with Adam for encoders' inputs, outputs, biases and norms."""
    if name == "adam":
        return torch.optim.Adam(simulator.parameters(), lr=learning_rate)
    width = int(simulator.config["latent_dim"])
    inner = [p for p in simulator.parameters() if p.dim() == 2 and p.shape[0] == width and p.shape[1] % width == 0]
    chosen = {id(p) for p in inner}
    rest = [p for p in simulator.parameters() if id(p) not in chosen]
    return MuonAdam([{"params": inner, "matrices": True}, {"params": rest, "matrices": False}], learning_rate)


class MuonAdam(torch.optim.Optimizer):
    """Muon for groups marked ``matrices``, Adam for the others, at one learning rate.

    The matrices (d, k d) of a group are taken apart into k square blocks: a first layer sees k latents, one beside the
    other. All blocks are orthogonalised together and in float32; torch's own Muon takes a matrix at a time, whole.
    """

    def __init__(
        self,
        groups: Iterable[dict[str, Any]],
        lr: float,
        betas: tuple[float, float] = (0.9, 0.999),
        momentum: float = 0.95,
        eps: float = 1e-8,
    ) -> None:
        super().__init__(groups, {"lr": lr, "betas": betas, "momentum": momentum, "eps": eps, "matrices": False})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One update of every parameter that has a gradient."""
        for group in self.param_groups:
            present = [p for p in group["params"] if p.grad is not None]
            if group["matrices"]:
                self._orthogonal(group, present)
            else:
                self._adam(group, present)

    def _orthogonal(self, group: dict[str, Any], params: list[Tensor]) -> None:
        momentum = group["momentum"]
        pieces: list[Tensor] = []
        for p in params:
            state = self.state[p]
            if not state:
                state["momentum"] = torch.zeros_like(p)
            assert p.grad is not None
            state["momentum"].lerp_(p.grad, 1.0 - momentum)
            pieces += torch.lerp(p.grad, state["momentum"], momentum).split(p.shape[0], dim=1)
        if not pieces:
            return
        blocks = orthogonal(torch.stack(pieces))
        step = -group["lr"] * _ADAM_RMS * blocks.shape[1] ** 0.5
        place = 0
        for p in params:
            count = p.shape[1] // p.shape[0]
            p.add_(torch.cat(blocks[place : place + count].unbind(), dim=1), alpha=step)
            place += count

    def _adam(self, group: dict[str, Any], params: list[Tensor]) -> None:
        first, second = group["betas"]
        for p in params:
            state = self.state[p]
            if not state:
                state["first"], state["second"], state["step"] = torch.zeros_like(p), torch.zeros_like(p), 0
            state["step"] += 1
            state["first"].lerp_(p.grad, 1.0 - first)
            state["second"].mul_(second).addcmul_(p.grad, p.grad, value=1.0 - second)
            root = (state["second"] / (1.0 - second ** state["step"])).sqrt_().add_(group["eps"])
            p.addcdiv_(state["first"], root, value=-group["lr"] / (1.0 - first ** state["step"]))


def orthogonal(blocks: Tensor, rounds: int = 5) -> Tensor:
    """Near-orthogonal matrices with the singular directions of ``blocks`` (K, d, d)."""
    a, b, c = _QUINTIC
    x = blocks / blocks.norm(dim=(1, 2), keepdim=True).clamp_min(1e-20)
    for _ in range(rounds):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x

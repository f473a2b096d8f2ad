"""Normalisation of features and outputs: running statistics (the paper) or fixed physical scales."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn


class RunningNormalizer(nn.Module):
    """Standardises rows by exponentially weighted statistics (paper, section 4.4).

    Every call in training mode is one update with the moments of its rows: with decay γ, call t of T has the weight
    γ^(T − t), divided by the sum of all weights (bias correction), so the first calls are not pulled towards zero.
    γ = 1 keeps the plain mean over calls, γ = 0 that over all rows of all calls, as the released code does. Sums are kept in
    float64 and travel in the state dict. Nothing accumulates in
    evaluation mode, after :meth:`freeze` or for calls without rows.

    Where several processes share a batch, ``shared_sum`` adds up their moments: all of them then hold the statistics of the
    whole batch, provided that all of them make every call, also those without rows.

    Until ``min_updates`` calls the module is the identity. Channels that have been constant so far are centred only:
    dividing by a vanishing deviation would blow up the first value that differs. With ``divisor_floor`` every channel is
    divided by its deviation or that floor, whichever is larger: the rule of the reference implementation.

    Args:
        width: number of channels.
        decay: γ; 0.999 averages over about the last 1000 calls; 0: plain sums over rows, nothing is forgotten.
        floor: smallest deviation that counts as variation, also relative to the mean at 1e-6.
        min_updates: calls before the statistics are used.
        divisor_floor: least divisor; None centres constant channels only.
    """

    weight: Tensor
    first: Tensor
    second: Tensor
    num_updates: Tensor
    frozen: Tensor

    def __init__(
        self, width: int, decay: float = 0.999, floor: float = 1e-8, min_updates: int = 1, divisor_floor: float | None = None
    ) -> None:
        super().__init__()
        if not 0 <= decay <= 1:
            raise ValueError(f"normaliser: decay is {decay}; it must lie in [0, 1] (0: plain sums over all rows)")
        if divisor_floor is not None and not divisor_floor > 0:
            raise ValueError(f"normaliser: divisor_floor is {divisor_floor}; it must be > 0")
        self.width, self.decay, self.floor, self.min_updates = width, decay, floor, min_updates
        self.divisor_floor = divisor_floor
        self.shared_sum: Callable[[Tensor], Tensor] | None = None
        self.register_buffer("weight", torch.zeros((), dtype=torch.float64))
        self.register_buffer("first", torch.zeros(width, dtype=torch.float64))
        self.register_buffer("second", torch.zeros(width, dtype=torch.float64))
        self.register_buffer("num_updates", torch.zeros((), dtype=torch.int64))
        self.register_buffer("frozen", torch.zeros((), dtype=torch.bool))

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(N, width) → (N, width) standardised; in training, rows of ``mask`` (N,) bool or all are counted first."""
        if self.training and not self.frozen:
            self.update(x if mask is None else x[mask])
        mean, std = self.statistics(x.dtype)
        return (x - mean) / std

    def leading(self, x: Tensor) -> Tensor:
        """:meth:`forward` of the first columns of a wider table (N, ≥ width), written into it; the others stay."""
        part = x[:, : self.width]
        if self.training and not self.frozen:
            self.update(part)
        mean, std = self.statistics(x.dtype)
        part.sub_(mean).div_(std)
        return x

    def inverse(self, y: Tensor) -> Tensor:
        """Undo :meth:`forward` without counting: y·σ + mean."""
        mean, std = self.statistics(y.dtype)
        return y * std + mean

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Count the rows of ``x`` (N, width) as one call."""
        rows = x.detach().double()
        moments = torch.cat([rows.new_tensor([len(rows)]), rows.sum(dim=0), rows.square().sum(dim=0)])
        count = len(rows)
        if self.shared_sum is not None:
            moments = self.shared_sum(moments)
            count = int(moments[0])
        if count == 0:
            return
        self.num_updates += 1
        if self.decay == 0:
            for total, part in zip(
                (self.weight, self.first, self.second), moments.split([1, self.width, self.width]), strict=True
            ):
                total.add_(part.view_as(total))
            return
        fresh = 1.0 - self.decay if self.decay < 1 else 1.0
        self.weight.mul_(self.decay).add_(fresh)
        first, second = (moments[1:] / moments[0]).split(self.width)
        self.first.mul_(self.decay).add_(first, alpha=fresh)
        self.second.mul_(self.decay).add_(second, alpha=fresh)

    def statistics(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation in use, each (width,)."""
        weight = self.weight.clamp_min(torch.finfo(torch.float64).tiny)
        mean = self.first / weight
        std = (self.second / weight - mean.square()).clamp_min(0).sqrt()
        ready = self.num_updates >= self.min_updates
        if self.divisor_floor is not None:
            return torch.where(ready, mean, 0.0).to(dtype), torch.where(ready, std.clamp_min(self.divisor_floor), 1.0).to(dtype)
        varying = ready & (std > self.floor) & (std > 1e-6 * mean.abs())
        return torch.where(ready, mean, 0.0).to(dtype), torch.where(varying, std, 1.0).to(dtype)

    @torch.no_grad()
    def set_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Use given statistics, each (width,), from now on and freeze."""
        mean, std = mean.double(), std.double()
        self.weight.fill_(1.0)
        self.first.copy_(mean)
        self.second.copy_(std.square() + mean.square())
        self.num_updates.fill_(self.min_updates)
        self.freeze()

    def freeze(self) -> None:
        """Stop counting."""
        self.frozen.fill_(True)

    def _apply(self, fn, recurse: bool = True):  # type: ignore[no-untyped-def]
        """Sums stay in float64 when the model moves to another precision; they do follow it to another device."""
        names = ("weight", "first", "second")
        sums = {name: getattr(self, name) for name in names}
        super()._apply(fn, recurse)
        for name in names:
            setattr(self, name, sums[name].to(getattr(self, name).device))
        return self


class FixedScale(nn.Module):
    """Divides by constants instead of statistics; ``asinh`` compresses outliers, linear below one scale.

    Same interface as :class:`RunningNormalizer`; nothing to learn or to collect.
    """

    scale: Tensor

    def __init__(self, scale: float | Sequence[float], asinh: bool = False) -> None:
        super().__init__()
        self.asinh = asinh
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.float64), persistent=False)
        numbers = [scale] if isinstance(scale, (int, float)) else scale  # the tensor may be on a device without values
        if not all(number > 0 for number in numbers):
            raise ValueError(f"fixed scale is {scale}; every entry must be > 0")
        # A number is part of a kernel's call; a tensor would have to be copied to an accelerator in every call.
        self._number = float(scale) if isinstance(scale, (int, float)) else None

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """x / scale, or its asinh; ``mask`` plays no role."""
        y = x / self._divisor(x)
        return torch.asinh(y) if self.asinh else y

    def inverse(self, y: Tensor) -> Tensor:
        """Undo :meth:`forward`."""
        return (torch.sinh(y) if self.asinh else y) * self._divisor(y)

    def _divisor(self, like: Tensor) -> Tensor | float:
        return self.scale.to(like) if self._number is None else self._number

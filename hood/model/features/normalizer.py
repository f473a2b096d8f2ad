"""Normalisation of features and outputs: running statistics (the paper) or fixed physical scales.

Training of layers as if the features they see were uncorrelated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

#: What white columns are divided by at least, in units of the normalised features.
_LEAST_SPREAD = 2e-2


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

    def leading(self, x: Tensor, filled: Tensor | None = None) -> Tensor:
        """:meth:`forward` of the first columns of a wider table (N, ≥ width), written into it; the others stay.

        ``filled`` (N,) bool: rows that count, of a table of fixed shape; nothing is asked of the device then.
        """
        part = x[:, : self.width]
        if self.training and filled is not None:
            self._update_filled(part, filled)
        elif self.training and not self.frozen:
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

    @torch.no_grad()
    def _update_filled(self, x: Tensor, filled: Tensor) -> None:
        rows = torch.where(filled.unsqueeze(1), x.detach(), 0.0).double()
        count = filled.sum().double()
        counts = (count > 0) & ~self.frozen
        self.num_updates.add_(counts.long())
        sums = (count, rows.sum(dim=0), rows.square().sum(dim=0))
        for total, part in zip((self.weight, self.first, self.second), sums, strict=True):
            if self.decay == 0:
                total.add_(torch.where(counts, part, 0.0))
                continue
            fresh = 1.0 - self.decay if self.decay < 1 else 1.0
            total.copy_(torch.where(counts, total * self.decay + fresh * part / count.clamp_min(1.0), total))

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


class Whitening:
    """Updates of first layers in coordinates in which columns of what they see are uncorrelated and of unit size.

    The length of an edge and its rest length are nearly one number: what tells of strain is a few hundredths of either. Of
    white columns a layer learns alike. The network stays what it is: with W and b of a layer side by side (W, b) = A Q, and the
    optimiser moves A. Q is made of the moments that were counted before; of columns that are left out, and of layers that saw
    fewer rows than columns, the updates are the optimiser's own.

    Args:
        layers: by name; none of them leaves all updates as they are.
        seen_by: the layer that sees the rows of a set, by the set's name.
        columns: how many columns of a set are to be white, the first ones.
        fresh: the layers are not trained yet: what was drawn for (W, b) becomes A.
    """

    def __init__(
        self, layers: Mapping[str, nn.Linear], seen_by: Mapping[str, str], columns: Mapping[str, int], fresh: bool = True
    ) -> None:
        self._layers, self._seen_by, self._columns, self.fresh = layers, seen_by, columns, fresh
        self._moments: dict[str, Tensor] = {}  # by layer, (n + 1, n + 1): sums of the products of columns and a one
        self._bases: dict[str, Tensor] = {}  # by layer, (n + 1, n + 1): Q
        self.shared_sum: Callable[[Tensor], Tensor] | None = None  # as of a RunningNormalizer

    @contextmanager
    def around(self, network: nn.Module, collecting: bool) -> Iterator[None]:
        """Around an evaluation of the network that takes tables by set as its third argument; counts them while ``collecting``
        and makes the bases before the first evaluation without."""
        if not (self._layers and collecting):
            if self._layers and not self._bases:
                self._settle()
            yield
            return
        handle = network.register_forward_pre_hook(lambda _, given: self.count(given[2]))
        try:
            yield
        finally:
            handle.remove()

    def count(self, tables: Mapping[str, Tensor]) -> None:
        """Tables (N, ≥ columns) by set."""
        for name, layer in self._seen_by.items():
            seen = tables[name].detach()[:, : self._columns[name]].double()
            seen = torch.cat([seen, seen.new_ones(len(seen), 1)], dim=1)
            moments = seen.mT @ seen
            self._moments[layer] = self._moments[layer] + moments if layer in self._moments else moments

    @torch.no_grad()
    def pull(self) -> None:
        """Turn the gradients of (W, b) into those of A."""
        for name, basis in self._bases.items():
            weight, bias = self._layers[name].weight.grad, self._layers[name].bias.grad
            if weight is not None and bias is not None:
                _put(weight, bias, _side_by_side(weight, bias, basis) @ basis.mT)

    @torch.no_grad()
    def push(self, optimizer: torch.optim.Optimizer) -> None:
        """One step of the optimiser, whose change of (W, b) is taken as that of A."""
        before = {name: _side_by_side(*_both(self._layers[name]), basis) for name, basis in self._bases.items()}
        optimizer.step()
        for name, basis in self._bases.items():
            weight, bias = _both(self._layers[name])
            change = _side_by_side(weight, bias, basis) - before[name]
            _put(weight, bias, before[name] + change @ basis)

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """What was counted, and what was made of it."""
        return {"moments": dict(self._moments), "bases": dict(self._bases)}

    def load_state_dict(self, state: Mapping[str, Mapping[str, Tensor]] | None) -> None:
        """Go on from :meth:`state_dict`; None is of a training without whitening."""
        if state is not None:
            self._moments, self._bases = dict(state["moments"]), dict(state["bases"])

    @torch.no_grad()
    def _settle(self) -> None:
        for name, moments in sorted(self._moments.items()):
            if self.shared_sum is not None:
                moments = self.shared_sum(moments.clone())
            rows = moments[-1, -1]
            if rows < len(moments):
                continue
            mean = moments[-1, :-1] / rows
            values, directions = torch.linalg.eigh(moments[:-1, :-1] / rows - torch.outer(mean, mean))
            whiten = directions @ torch.diag(1.0 / values.clamp_min(_LEAST_SPREAD**2).sqrt()) @ directions.mT
            basis = torch.eye(len(moments), dtype=moments.dtype, device=moments.device)
            basis[:-1, :-1], basis[:-1, -1] = whiten, -whiten @ mean
            self._bases[name] = basis
            if self.fresh:
                weight, bias = _both(self._layers[name])
                _put(weight, bias, _side_by_side(weight, bias, basis) @ basis)


def _both(layer: nn.Linear) -> tuple[Tensor, Tensor]:
    return layer.weight, layer.bias


def _side_by_side(weight: Tensor, bias: Tensor, basis: Tensor) -> Tensor:
    """(d, n + 1): the columns that a basis is of, and the bias."""
    return torch.cat([weight[:, : len(basis) - 1], bias.unsqueeze(1)], dim=1).to(basis)


def _put(weight: Tensor, bias: Tensor, values: Tensor) -> None:
    weight[:, : values.shape[1] - 1] = values[:, :-1].to(weight)
    bias.copy_(values[:, -1])

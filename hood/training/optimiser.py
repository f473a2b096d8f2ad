"""Optimisers and their rates: those of hood, and classes of ``torch.optim`` and of plugins with their schedulers.

For networks whose loss is ill-conditioned: orthogonalised momentum for matrices, Adam for the rest.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor
from torch.optim.lr_scheduler import ReduceLROnPlateau

from hood.assets.files.library import unknown
from hood.model.features.normalizer import Whitening
from hood.steppers.network import NetworkStepper

#: Coefficients of the quintic Newton-Schulz iteration towards the nearest orthogonal matrix (Jordan et al., "Muon", 2024).
_QUINTIC = (3.4445, -4.7750, 2.0315)
#: Root mean square of Adam's updates in units of its rate, about: both parts then share one rate (Liu et al., 2025).
_ADAM_RMS = 0.2

#: Names for :func:`make_optimizer`.
OPTIMIZERS = ("adam", "muon")
#: Classes whose steps can be taken back on the device, see :meth:`WeightSteps.take`: what they make for the first one is zero.
_TAKEN_BACK = (torch.optim.Adam, torch.optim.AdamW)
#: From the iteration and the number of all iterations, the factor on the learning rate.
Schedule = Callable[[int, int], float]


def can_be_taken_back(choice: str | partial[Any]) -> bool:
    """Whether an optimiser's steps can be undone on the device, as updates of fixed shapes ask."""
    return isinstance(choice, str) or choice.func in _TAKEN_BACK


def make_optimizer(
    choice: str | partial[Any], simulator: NetworkStepper, learning_rate: float, on_device: bool = False
) -> torch.optim.Optimizer:
    """``adam``, or ``muon`` for the matrices between latents with Adam for encoders' inputs, outputs, biases and norms; or a
    class with arguments of its own: ``partial(torch.optim.AdamW, weight_decay=1e-2)``.

    Args:
        on_device: the steps of Adam are counted beside the weights, where there is a device beside the CPU.

    Raises:
        ValueError: the class does not take these arguments.
    """
    on_device &= simulator.gravity.device.type != "cpu"
    if choice == "adam":
        choice = partial(torch.optim.Adam)
    if isinstance(choice, partial):
        counted = {"capturable": True} if on_device and choice.func in _TAKEN_BACK else {}
        return made("trainer.optimizer", choice, simulator.parameters(), lr=learning_rate, **counted)
    width = int(simulator.config["latent_dim"])
    inner = [p for p in simulator.parameters() if p.dim() == 2 and p.shape[0] == width and p.shape[1] % width == 0]
    chosen = {id(p) for p in inner}
    rest = [p for p in simulator.parameters() if id(p) not in chosen]
    return MuonAdam([{"params": inner, "matrices": True}, {"params": rest, "matrices": False}], learning_rate)


def made(key: str, part: partial[Any], *given: Any, **more: Any) -> Any:
    """The object of a class and its arguments, which are under ``key``.

    Raises:
        ValueError: it does not take them; names the key, the class and the near miss.
    """
    parameters = inspect.signature(part.func).parameters
    if not any(one.kind is inspect.Parameter.VAR_KEYWORD for one in parameters.values()):
        strange = next((name for name in part.keywords if name not in parameters), None)
        if strange is not None:
            raise ValueError(f"{key}: {unknown(f'argument of {dotted_name(part.func)}', strange, sorted(parameters))}")
    try:
        return part(*given, **more)
    except (TypeError, ValueError, AttributeError) as error:
        if isinstance(error, ValueError) and part.func.__module__.startswith("hood."):
            raise  # its sentences name the key
        raise ValueError(f"{key}: {dotted_name(part.func)}: {' '.join(str(error).split())}") from error


def dotted_name(kind: Any) -> str:
    """A class as ``_target_`` names it."""
    return f"{kind.__module__}.{kind.__qualname__}" if inspect.isclass(kind) else repr(kind)


class Rates:
    """The learning rate of every update: a function of the iteration, or a scheduler of torch, which has a state.

    A scheduler takes a step with every iteration, those that only collect statistics and skipped updates included, as
    functions count them; ``ReduceLROnPlateau`` with the score of every validation.
    """

    def __init__(
        self, schedule: Schedule | partial[Any], optimizer: torch.optim.Optimizer, learning_rate: float, iterations: int
    ) -> None:
        self._optimizer, self._highest, self._iterations = optimizer, learning_rate, iterations
        self._schedule = None if isinstance(schedule, partial) else schedule
        with _without_advice():
            self._scheduler = _scheduler(schedule, optimizer) if isinstance(schedule, partial) else None

    def put(self, iteration: int) -> float:
        """Give the optimiser the rate of an update; returns it."""
        if self._schedule is not None:
            rate = self._highest * self._schedule(iteration, self._iterations)
            for group in self._optimizer.param_groups:
                group["lr"] = rate
        return float(self._optimizer.param_groups[0]["lr"])

    def advance(self) -> None:
        """An iteration is over."""
        if self._scheduler is not None and not isinstance(self._scheduler, ReduceLROnPlateau):
            with _without_advice():
                self._scheduler.step()

    def judge(self, score: float) -> None:
        """A validation is over; less is better."""
        if isinstance(self._scheduler, ReduceLROnPlateau):
            self._scheduler.step(score)

    def state_dict(self) -> dict[str, Any] | None:
        """Of the scheduler; the rate itself is the optimiser's."""
        return None if self._scheduler is None else self._scheduler.state_dict()

    def load_state_dict(self, state: Mapping[str, Any] | None) -> None:
        """Go on from :meth:`state_dict`; None is of a function."""
        if self._scheduler is not None and state is not None:
            self._scheduler.load_state_dict(dict(state))


def _scheduler(part: partial[Any], optimizer: torch.optim.Optimizer) -> Any:
    """The scheduler, after those among its arguments: of ``SequentialLR`` and ``ChainedScheduler``."""
    own = {name: [_scheduler(one, optimizer) if isinstance(one, partial) else one for one in value]
           for name, value in part.keywords.items() if isinstance(value, list)}  # fmt: skip
    return made("trainer.schedule", partial(part.func, **{**part.keywords, **own}), optimizer=optimizer)


def _without_advice() -> warnings.catch_warnings:  # type: ignore[type-arg]
    """Quiet where torch advises on the order of steps: iterations without a step of the optimiser count as well."""
    return warnings.catch_warnings(action="ignore", category=UserWarning)


def load_optimizer(optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> None:
    """The state of a checkpoint; where steps are counted stays as it is."""
    own = [{name: group[name] for name in ("capturable",) if name in group} for group in optimizer.param_groups]
    groups = [{**given, **kept} for given, kept in zip(state["param_groups"], own, strict=True)]
    optimizer.load_state_dict({**state, "param_groups": groups})


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
        if not params:
            return
        momentum, grads = group["momentum"], [cast(Tensor, p.grad) for p in params]
        kept = self._kept("momentum", params)
        torch._foreach_lerp_(kept, grads, 1.0 - momentum)
        ahead = torch._foreach_lerp(grads, kept, momentum)
        blocks = orthogonal(torch.stack([block for one in ahead for block in one.split(one.shape[0], dim=1)]))
        places = [block for p in params for block in p.split(p.shape[0], dim=1)]
        torch._foreach_add_(places, list(blocks.unbind()), alpha=-group["lr"] * _ADAM_RMS * blocks.shape[1] ** 0.5)

    def _adam(self, group: dict[str, Any], params: list[Tensor]) -> None:
        if not params:
            return
        (first, second), grads = group["betas"], [cast(Tensor, p.grad) for p in params]
        means, squares = self._kept("first", params), self._kept("second", params)
        for p in params:
            self.state[p]["step"] = self.state[p].get("step", 0) + 1
        counts = [self.state[p]["step"] for p in params]
        torch._foreach_lerp_(means, grads, 1.0 - first)
        torch._foreach_mul_(squares, second)
        torch._foreach_addcmul_(squares, grads, grads, value=1.0 - second)
        roots = torch._foreach_div(squares, [1.0 - second**count for count in counts])
        torch._foreach_sqrt_(roots)
        torch._foreach_add_(roots, group["eps"])
        torch._foreach_addcdiv_(params, means, roots, [-group["lr"] / (1.0 - first**count) for count in counts])

    def _kept(self, name: str, params: list[Tensor]) -> list[Tensor]:
        """What is kept of every parameter under a name, zero at first."""
        for p in params:
            if name not in self.state[p]:
                self.state[p][name] = torch.zeros_like(p)
        return [self.state[p][name] for p in params]


def orthogonal(blocks: Tensor, rounds: int = 5) -> Tensor:
    """Near-orthogonal matrices with the singular directions of ``blocks`` (K, d, d)."""
    a, b, c = _QUINTIC
    x = blocks / blocks.norm(dim=(1, 2), keepdim=True).clamp_min(1e-20)
    for _ in range(rounds):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x


class WeightSteps:
    """Steps of an optimiser and what changes with them: averages of the weights, and layers whose updates are whitened.

    Args:
        ema_decay: share that averages keep of themselves in a step, at most; 0: there are none.

    Attributes:
        average: exponentially averaged weights, by name.
    """

    def __init__(
        self, model: torch.nn.Module, optimizer: torch.optim.Optimizer, whitening: Whitening, ema_decay: float
    ) -> None:
        self._optimizer, self._whitening, self._decay = optimizer, whitening, ema_decay
        self._weights: list[Tensor] = list(model.parameters())
        self.average = {name: value.detach().clone() for name, value in model.named_parameters()}

    @torch.no_grad()
    def take(self, iteration: int, wanted: Tensor | None = None) -> None:
        """One step; where ``wanted`` () bool is false on the device, it is taken back to the last bit. Gradients must then be
        finite in any case."""
        before = [] if wanted is None else self._tensors()
        kept = list(torch._foreach_mul(before, 1.0)) if before else []  # copies, by one kernel
        self._whitening.push(self._optimizer)
        if self._decay > 0:
            # Early averages forget faster, so that the first checkpoints are not the untrained weights.
            decay = min(self._decay, (1 + iteration) / (10 + iteration))
            torch._foreach_lerp_(list(self.average.values()), self._weights, 1 - decay)
        if wanted is None:
            return
        known = {id(value) for value in before}
        # What the optimiser makes for its first step is zero before it.
        new = [value for value in self._tensors() if id(value) not in known]
        factor = wanted.to(before[0])
        torch._foreach_mul_([*before, *new], factor)
        torch._foreach_mul_(kept, 1.0 - factor)
        torch._foreach_add_(before, kept)

    def forget(self, count: int) -> None:
        """``count`` steps were taken back: they are not counted where the optimiser counts on the host."""
        for state in self._optimizer.state.values():
            if isinstance(state.get("step"), int):
                state["step"] -= count

    def _tensors(self) -> list[Tensor]:
        """All that a step changes."""
        states = [value for p in self._weights for value in self._optimizer.state[p].values() if isinstance(value, Tensor)]
        return [*self._weights, *states, *(self.average.values() if self._decay > 0 else ())]

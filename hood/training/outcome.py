"""What comes of updates: figures on the device, which the host reads at once or many updates later.

Between two reads the device alone decides whether gradients are used and which rollouts go on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import centres_of
from hood.energies.potential import scale
from hood.energies.problem import StepProblem
from hood.model.features.normalizer import Whitening
from hood.scene.scene import RELAXING_DT
from hood.training.log import output_spread, relative_loss
from hood.training.slots import Taken, is_lost

#: What is measured of an update beside the energies: the mean loss of its scenes, the median of their rg, and the spread of the
#: output; of scenes that are updated one after the other the means of these.
MEASURED = ("loss", "relative_gradient", "output_spread")


#: Longest step [s] that has its own e0 with ``scaled_by_frame``; the relaxing step has ten times as long.
_FRAME_DT = RELAXING_DT / 10.0


class Signal:
    """What an update is led by, see :class:`hood.training.settings.TrainerSettings`."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._longest = _FRAME_DT if name == "scaled_by_frame" else None

    def loss(self, problem: StepProblem, energies: Mapping[str, Tensor], acc: Tensor, residual: Tensor) -> Tensor:
        """What is minimised, of every scene (B,), in units of e0: :func:`hood.training.log.relative_loss`."""
        return relative_loss(problem, energies, acc, self._longest) * self._damping(residual)

    def weight(self, problem: StepProblem, residual: Tensor) -> Tensor:
        """Factors (B,) on the gradients of the scenes' potentials; ``residual`` (B,) is their rg."""
        unit = 1.0 if self._name == "potential" else scale(problem, self._longest)
        return self._damping(residual) / (unit * problem.num_scenes)

    def _damping(self, residual: Tensor) -> Tensor:
        """How much of a scene (B,) counts: with a scaled signal one that is far from rest less, as far as it is."""
        return torch.ones_like(residual) if self._name == "potential" else 1.0 / (1.0 + residual / 3.0)


#: Columns of :attr:`Update.told` where the device decides.
TOLD = 9


class Figures(NamedTuple):
    """What the host is told of an update."""

    measured: dict[str, float]  # means of the energies, then what :data:`MEASURED` says; NaN where no scene counts
    lost: list[bool]  # by scene: rollouts that end here
    centres: Tensor  # (B, 3) m: means of the vertices of a scene where it leads
    norm: float  # of the gradients; NaN: none were given
    counted: list[bool]  # by scene: neither waits for the next rollout nor found more than it has places for
    num_found: list[tuple[int, int, int]]  # by scene, see :class:`hood.steppers.static_shapes.simulator.StepResult`

    def is_finite(self, energies: Sequence[str]) -> bool:
        """Whether the gradients may be used."""
        return math.isfinite(self.norm) and math.isfinite(sum(self.measured[name] for name in energies))


@dataclass(frozen=True)
class Acceptance:
    """What the device decides of an update.

    Args:
        goes_on: (B,) bool: rollouts that are neither lost nor waiting for the next one.
        usable: () bool: whether the weights may be changed: some scene counts, and none of those that count is not finite.
    """

    goes_on: Tensor
    usable: Tensor


@dataclass(frozen=True)
class Update:
    """Where an update leads its scenes, and what was measured; the gradients are with the parameters."""

    next_pos: Tensor  # (V, 3) m
    next_vel: Tensor  # (V, 3) m/s
    measured: Tensor  # (M,) means of the energies in the order of ``energies``, then what :data:`MEASURED` says
    energies: tuple[str, ...]
    told: Tensor  # (B, 4) :func:`outcome_of`, or (B, TOLD): as well whether it counts, is finite, what was found
    backward: Callable[[], None] | None = None  # computes the gradients, where that is not done
    acceptance: Acceptance | None = None  # None: the host decides
    plans: Sequence[Any] = ()  # by scene: what the places belong to


@dataclass
class StartedUpdate:
    """An update, with what is needed to say of it what came of it."""

    update: Update
    norm: Tensor | None  # () of the gradients; None: none were asked for
    settings: dict[str, float]  # of the update, for its report
    figures: Figures | None = None
    made: bool = False  # whether the weights were changed; known with the figures
    taken: Sequence[Taken] = ()

    def report(self) -> dict[str, float]:
        """What was measured, once that is read."""
        assert self.figures is not None
        measured, counted = self.figures.measured, self.figures.counted
        report = {name: measured[name] for name in self.update.energies}
        report |= {"total": sum(report.values()), **measured, **self.settings}
        if self.norm is not None:
            report["parameter_gradient_norm"] = self.figures.norm if any(counted) else math.nan
        if self.update.acceptance is not None:
            report["waiting"] = 1.0 - sum(counted) / len(counted)
        return report


def read_figures(begun: Sequence[StartedUpdate]) -> None:
    """Put the figures in; waits for the device, once for all of them."""
    if not begun:
        return
    like = begun[0].update.measured
    none = like.new_full((1,), torch.nan)
    given = []
    for one in begun:
        given += [one.update.told.flatten(), one.update.measured, none if one.norm is None else one.norm.reshape(1)]
    values = torch.cat([value.to(like) for value in given]).cpu().split([value.numel() for value in given])
    for number, one in enumerate(begun):
        told, measured, norm = values[3 * number : 3 * number + 3]
        told = told.reshape(one.update.told.shape)
        found = [cast(tuple[int, int, int], tuple(map(int, row))) for row in told[:, 6:].tolist()]
        counted = [True] * len(told) if one.update.acceptance is None else (told[:, 4] > 0).tolist()
        if one.update.acceptance is not None and bool((told[:, 4] > told[:, 5]).any()):
            norm = norm * torch.nan  # of gradients of which the device has left some out
        names = (*one.update.energies, *MEASURED)
        means = dict(zip(names, measured.tolist() if any(counted) else [math.nan] * len(names), strict=True))
        lost = [ends or not counts for ends, counts in zip((told[:, 0] > 0).tolist(), counted, strict=True)]
        one.figures = Figures(means, lost, told[:, 1:4], float(norm), counted, found)
        one.made = one.norm is not None and any(counted) and one.figures.is_finite(one.update.energies)


def figures_of(
    problem: StepProblem, energies: Mapping[str, Tensor], acc: Tensor, output: Tensor, residual: Tensor, signal: Signal
) -> Tensor:
    """:attr:`Update.measured` (M,).

    Args:
        energies: (B,) [J] by name.
        acc: (V, 3) m/s² of the step; ``output`` those that the network gives.
        residual: (B,), the relative gradient.
    """
    means = [value.mean() for value in energies.values()]
    loss = signal.loss(problem, energies, acc, residual).mean()
    return torch.stack([*means, loss, residual.median(), output_spread(output, problem.cloth.free).to(loss)])


def outcome_of(cloth: Cloth, next_pos: Tensor, torn_strain: float) -> Tensor:
    """(B, 4): whether a rollout ends here (:func:`hood.training.slots.is_lost`), and the centre of its cloth [m]."""
    lost = is_lost(cloth, next_pos, torn_strain)
    return torch.cat([lost.to(next_pos).unsqueeze(1), centres_of(next_pos, cloth.vertex_scene, len(lost))], dim=1)


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

"""What comes of updates: figures on the device, which the host reads at once or many updates later.

Between two reads the device alone decides whether gradients are used and which rollouts go on.

The training loss as one number that can be watched: the potential above what free fall would cost.

Updates that were skipped, since a loss or a gradient was no number: how many, how many in a row, and why.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from hood.assets.files.said import say
from hood.cloth.cloth import Cloth
from hood.cloth.state import centres_of
from hood.energies.potential import relative_gradient, scale
from hood.energies.problem import StepProblem
from hood.scene.scene import RELAXING_DT
from hood.steppers.network import Prediction
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
        """What is minimised, of every scene (B,), in units of e0: :func:`relative_loss`."""
        return relative_loss(problem, energies, acc, self._longest) * self._damping(residual)

    def weight(self, problem: StepProblem, residual: Tensor) -> Tensor:
        """Factors (B,) on the gradients of the scenes' potentials; ``residual`` (B,) is their rg."""
        unit = 1.0 if self._name == "potential" else scale(problem, self._longest)
        return self._damping(residual) / (unit * problem.num_scenes)

    def _damping(self, residual: Tensor) -> Tensor:
        """How much of a scene (B,) counts: with a scaled signal one that is far from rest less, as far as it is."""
        return torch.ones_like(residual) if self._name == "potential" else 1.0 / (1.0 + residual / 3.0)


def surrogate_of(problem: StepProblem, prediction: Prediction, gradient: Tensor, residual: Tensor, signal: Signal) -> Tensor:
    """A number () whose gradient is that of the training signal: the energies' own is put in at the output, so that no graph
    through them is kept.

    Args:
        gradient: (V, 3) N, of the energies at the prediction; zero at vertices that are not free.
        residual: (B,), the relative gradient.
    """
    scene = problem.cloth.vertex_scene
    weight = signal.weight(problem, residual)
    surrogate = (prediction.next_pos * (gradient * weight[scene].unsqueeze(1))).sum()
    for pos, force in prediction.early:  # every pass answers for where it leads itself
        weight = signal.weight(problem, relative_gradient(problem, force))
        surrogate = surrogate - (pos * (force * weight[scene].unsqueeze(1))).sum()
    return surrogate


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


def relative_loss(problem: StepProblem, energies: Mapping[str, Tensor], acc: Tensor, longest: float | None = None) -> Tensor:
    """(Φ − Φ_fall) / e0 of every scene (B,): how far the step is above free fall, in units of e0.

    Φ alone cannot be watched: gravity's zero is arbitrary, so Φ is as often negative as positive. With Φ_fall, inertia plus
    gravity of the acceleration g, the two become ½ Σ m dt² ‖a − g‖² and no term can be negative; garments of any mass and steps
    of any length are comparable. Cloth at rest has 1, its weight held up, plus what it is stretched and bent. ``longest``: of
    :func:`hood.energies.potential.scale`.
    """
    dt = problem.vertex_dt.squeeze(1)
    apart = (acc - problem.gravity.to(acc)).square().sum(dim=1)
    fall = problem.sum_vertices(0.5 * problem.cloth.mass * dt * dt * apart)
    rest = [value for name, value in energies.items() if name not in ("inertia", "gravity")]
    return sum(rest, start=fall) / scale(problem, longest)


#: An output whose spread is less is one constant.
CONSTANT = 1e-3


def output_spread(acc: Tensor, free: Tensor) -> Tensor:
    """How much of the accelerations (V, 3) differs between the vertices that are ``free`` (V,): the root of the mean square of
    what deviates from their mean, over that of all, (). 1 where all are zero."""
    rows = free.unsqueeze(1).to(acc)
    mean = (acc * rows).sum(dim=0) / rows.sum().clamp_min(1.0)
    all_of_it = (acc * rows).norm()
    return torch.where(all_of_it > 0, ((acc - mean) * rows).norm() / torch.where(all_of_it > 0, all_of_it, 1.0), 1.0)


class ConstantOutput:
    """Says once that a network's output has become a constant: a gradient that reaches one cannot bring the network back."""

    def __init__(self, learning_rate: float) -> None:
        self._rate, self._told = learning_rate, False

    def look(self, iteration: int, spread: float) -> None:
        """With the mean of :func:`output_spread` since the last look."""
        if spread >= CONSTANT or self._told:
            return
        self._told = True
        say(
            f"hood: iteration {iteration}: the network gives every vertex the same acceleration, whatever it is shown. The "
            "units of its decoder are dead, and nothing is learned any more; begin again with a lower trainer.learning_rate "
            f"than {self._rate:g}",
            error=True,
        )


class Skipped:
    """Counts the updates of a training; what it says is about the whole run, what was rolled back included.

    Attributes:
        count: updates that were skipped.
        in_row: of these, those since the last one that was made.
        made: updates that were made, and not rolled back.
        reason: why the last one was skipped; empty where another process saw it.
    """

    def __init__(self) -> None:
        self.count, self.in_row, self.made = 0, 0, 0
        self.reason = ""

    def skip(self, iteration: int, energies: Mapping[str, float], norm: float) -> None:
        """An update that is not made, with the means of its energies and the length of its gradient."""
        self.count, self.in_row = self.count + 1, self.in_row + 1
        lost = [name for name, value in energies.items() if not math.isfinite(value)]
        if lost:
            self.reason = f"iteration {iteration}: energy {lost[0]} is {energies[lost[0]]}"
        else:
            self.reason = "" if math.isfinite(norm) else f"iteration {iteration}: the length of the gradient is {norm}"

    def make(self) -> None:
        """An update that is made."""
        self.made, self.in_row = self.made + 1, 0

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run goes on with."""
        return {"skipped": self.count, "skipped_in_row": self.in_row, "made": self.made, "skip_reason": self.reason}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Back to what :meth:`state_dict` gave; older checkpoints do not say how many were made."""
        self.count, self.in_row = int(state["skipped"]), int(state["skipped_in_row"])
        self.made = made_behind(state)
        self.reason = str(state.get("skip_reason", ""))


def made_behind(state: Mapping[str, Any]) -> int:
    """Updates that were made behind a checkpoint."""
    return int(state.get("made", state["iteration"]))


def told(reasons: list[str]) -> str:
    """The reason of the first process that has one, in brackets."""
    reason = next((reason for reason in reasons if reason), "")
    return f" ({reason})" if reason else ""

"""Steps of a model without some of its energies, watched: where those would matter, the full model takes the step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from hood.dynamics.captured import network_of
from hood.dynamics.frames import Relaxing
from hood.dynamics.simulator import Prediction
from hood.dynamics.stepper import Stepper
from hood.dynamics.stopwatch import Stopwatch, timed
from hood.losses.elements import energies_and_gradient
from hood.losses.layers import LayerBarrier, for_networks
from hood.losses.potential import Potential, scale
from hood.losses.problem import StepProblem
from hood.scene.scene import Scene

#: Metrics of a watched rollout: the price of what is left out, as γ; and 1 where the full model took the step.
PLAN_METRICS = ("plan_price", "plan_full")

#: Steps after which the lean model is tried again at the latest.
LONGEST = 240


def force_bound(potential: Potential, names: Sequence[str], problem: StepProblem, pos: Tensor) -> float:
    """The most that γ can fall if some energies of ``potential`` were followed from ``pos`` (V, 3) [m].

    With the other forces in balance and a Hessian of at least M / dt², which inertia alone gives, a force f lowers the
    potential by at most ½ dt² Σ |f|² / m; this is that, in units of e0. 0 where no term applies.

    Args:
        names: of the energies.
        problem: prepared by ``potential``.
    """
    terms = {name: term for name, term in potential.active(problem).items() if name in names}
    if not terms:
        return 0.0
    others = {name: term for name, term in terms.items() if type(term) is not LayerBarrier}
    gradient, _ = energies_and_gradient(potential.only(others), problem, pos)
    if len(others) < len(terms):  # written out, where autograd takes as long as the step
        gradient = gradient.double().clone()
        for scene in problem.layers:
            here = scene.of(pos)
            if scene.layers.energy(here) == 0.0:
                scene.layers.remember_apart(here)
                continue
            pushed, _, _, _ = scene.layers.model(here)
            gradient[scene.first : scene.first + len(pushed)] += torch.from_numpy(pushed).to(gradient)
    movable = problem.cloth.free & (problem.cloth.mass > 0)
    square = (gradient**2).sum(dim=1)[movable] / problem.cloth.mass[movable]
    lowered = 0.5 * float(problem.step.dt.max()) ** 2 * float(square.sum())
    return lowered / float(scale(problem).sum())


def lacking(lean: Potential, full: Potential) -> list[str]:
    """Names of the energies that only the full potential has."""
    return [name for name in full.terms if name not in lean.terms]


class WatchedStepper:
    """Steps of ``lean``; each is priced, and taken by ``full`` where the price is above the limit, as are those after it.

    The price of a step is :func:`force_bound` of the energies that ``lean`` lacks, divided by ``ratio``. Energies are not
    forgotten for good: after ``hold`` steps of the full model ``lean`` is tried again. Where that fails at once, it is tried
    again after twice as many, :data:`LONGEST` at most.

    Args:
        lean, full: take the steps.
        potentials: what the two move by.
        scene: of the rollout; both prepare for its garment.
        limit: the largest price that is accepted, in units of γ.
        ratio: how much the bound overstates γ, as measured; at least 1.
        hold: steps.
    """

    def __init__(
        self,
        lean: Stepper,
        full: Stepper,
        potentials: tuple[Potential, Potential],
        scene: Scene,
        limit: float,
        ratio: float,
        hold: int,
    ) -> None:
        self._lean, self._full, self._scene = lean, full, scene
        self._limit, self._ratio, self._hold = limit, ratio, hold
        self._potential = potentials[1]
        self._lacking = lacking(*potentials)
        self._remaining = self._failed = 0  # steps that the full model still takes; times in a row that the lean one failed
        self.gravity = lean.gravity
        self.times = lean.times
        self.metrics = (*lean.metrics, *(name for name in full.metrics if name not in lean.metrics), *PLAN_METRICS)
        self.config: dict[str, Any] = {**lean.config, "plan_limit": limit, "plan_ratio": ratio, "plan_hold": hold}
        for stepper, potential in zip((lean, full), potentials, strict=True):
            network = network_of(stepper)
            if network is not None:
                network.use_potential(for_networks(potential))

    @property
    def relaxing(self) -> Relaxing:
        """That of the lean model."""
        return self._lean.relaxing

    def prepare(self, cloth: Any, rest_pos: Any) -> tuple[Any, Any]:
        """What both need of the scene's garment."""
        from hood.dynamics.rollout import prepare_stepper

        self._remaining = self._failed = 0
        return prepare_stepper(self._lean, self._scene), prepare_stepper(self._full, self._scene)

    def search(self, problem: StepProblem) -> StepProblem:
        """The problem with the contact that the lean model needs."""
        return problem if self._remaining else self._lean.search(problem)

    def predict(self, problem: StepProblem, prepared: tuple[Any, Any], watch: Stopwatch | None = None) -> Prediction:
        """The lean model's step, or the full one's where that is too far off."""
        price = 0.0
        if not self._remaining:
            prediction = self._lean.predict(problem, prepared[0], watch)
            with timed(watch, "rest"):
                price = self.price(problem, prediction.next_pos)
            if price <= self._limit:
                self._failed = 0
                return self._told(prediction, price, full=False)
            self._remaining = min(self._hold * 2**self._failed, LONGEST)
            self._failed += 1
        self._remaining -= 1
        fresh = StepProblem(problem.cloth, problem.state, problem.step, gravity=problem.gravity)
        with timed(watch, "search"):
            fresh = self._full.search(fresh)
        return self._told(self._full.predict(fresh, prepared[1], watch), price, full=True)

    def next_velocity(self, problem: StepProblem, prediction: Prediction) -> Tensor:
        """(V, 3) m/s at t + 1."""
        stepper = self._full if prediction.metrics["plan_full"] else self._lean
        return stepper.next_velocity(problem, prediction)

    @torch.no_grad()
    def price(self, problem: StepProblem, pos: Tensor) -> float:
        """What the left-out energies are worth at ``pos`` (V, 3) [m], as γ; infinite where that is not finite."""
        value = force_bound(self._potential, self._lacking, self._potential.prepare(problem), pos.detach()) / self._ratio
        return value if value < float("inf") else float("inf")

    @staticmethod
    def _told(prediction: Prediction, price: float, full: bool) -> Prediction:
        return replace(prediction, metrics={**prediction.metrics, "plan_price": price, "plan_full": float(full)})

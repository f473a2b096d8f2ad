"""Steps of a model without some of its energies, watched: where those would matter, the full model takes the step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from hood.energies.compiled_elements import energies_and_gradient
from hood.energies.potential import Potential, scale
from hood.energies.problem import StepProblem
from hood.energies.self_contact import for_networks
from hood.energies.term import Form, form_of
from hood.scene.scene import Scene
from hood.steppers.network import Prediction
from hood.steppers.newton import Stepper
from hood.steppers.protocol import Relaxing, Stopwatch, timed
from hood.steppers.refined import prepare_stepper
from hood.steppers.static_shapes.simulator import network_of

#: Metrics of a watched rollout: the price of what is left out, as γ; and 1 where the full model took the step.
PLAN_METRICS = ("plan_price", "plan_full")

#: Steps after which the reduced model is tried again at the latest.
LONGEST = 240
#: A bound overstates γ by no more than this, however much was measured.
MOST_OVERSTATED = 100.0
#: What was measured on the way is taken by this less, holds for so many steps, and for forces that have grown by this at most.
MARGIN, REMEMBERED, GROWTH = 1.25, 60, 2.0


def force_bound(potential: Potential, names: Sequence[str], problem: StepProblem, pos: Tensor) -> float:
    """The most that γ can fall if some energies were followed: the sum of :func:`vertex_bounds`."""
    return float(vertex_bounds(potential, names, problem, pos).sum())


def vertex_bounds(potential: Potential, names: Sequence[str], problem: StepProblem, pos: Tensor) -> Tensor:
    """By vertex, (V,) float64, the most that γ can fall if some energies of ``potential`` were followed from ``pos`` (V, 3) m.

    With the other forces in balance and a Hessian of at least M / dt², which inertia alone gives, a force f lowers the
    potential by at most ½ dt² Σ |f|² / m; this is that, in units of e0. 0 where no term applies.

    Args:
        names: of the energies.
        problem: prepared by ``potential``.
    """
    terms = {name: term for name, term in potential.active(problem).items() if name in names}
    if not terms:
        return torch.zeros(len(pos), dtype=torch.float64)
    others = {name: term for name, term in terms.items() if form_of(term) is not Form.LAYERS}
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
    mass, dt = problem.cloth.mass.double(), float(problem.step.dt.max())
    movable = problem.cloth.free & (mass > 0)
    lowered = 0.5 * dt**2 * (gradient.double() ** 2).sum(dim=1) / torch.where(movable, mass, 1.0)
    return torch.where(movable, lowered, 0.0).cpu() / float(scale(problem).sum())


def lacking(reduced: Potential, full: Potential) -> list[str]:
    """Names of the energies that only the full potential has."""
    return [name for name in full.terms if name not in reduced.terms]


@dataclass(frozen=True)
class _Known:
    """What the bounds of an energy overstate by, of forces up to these (V,), for so many steps more."""

    ratio: float
    forces: Tensor
    left: int


class WatchedStepper:
    """Steps of ``reduced``; each is priced, and taken by ``full`` where the price is above the limit.

    The price of a step is made of :func:`vertex_bounds` of every energy that ``reduced`` lacks, each sum divided by how much it
    overstates γ: (Σ √(bound / ratio))², since forces that pull together count more than one by one. Where it is too high,
    the full model takes that very step, and tells what the reduced one's was worth: how much higher the full potential is
    there. If that is below the limit by :data:`MARGIN`, the bounds were too wide: what they overstate by is known for the next
    :data:`REMEMBERED` steps, of the energy that the price came from and of the forces that were there, up to :data:`GROWTH`
    times as large at a vertex (of what is new, its square root); the next step is the reduced model's. Else the full model
    takes the steps after it too.
    After ``hold`` of them ``reduced`` is tried again; where that fails at once, after twice as many, :data:`LONGEST` at most.

    What keeps layers of cloth apart is always priced in full: through each other, they are worth nothing any more.

    Args:
        reduced, full: take the steps.
        potentials: what the two move by.
        scene: of the rollout; both prepare for its garment.
        limit: the largest price that is accepted, in units of γ.
        hold: steps.
    """

    def __init__(
        self,
        reduced: Stepper,
        full: Stepper,
        potentials: tuple[Potential, Potential],
        scene: Scene,
        limit: float,
        hold: int,
    ) -> None:
        self._reduced, self._full, self._scene = reduced, full, scene
        self._limit, self._hold = limit, hold
        self._potential = potentials[1]
        self._lacking = lacking(*potentials)
        self._start_over()
        self.gravity = reduced.gravity
        self.times = reduced.times
        self.metrics = (*reduced.metrics, *(name for name in full.metrics if name not in reduced.metrics), *PLAN_METRICS)
        self.config: dict[str, Any] = {**reduced.config, "plan_limit": limit, "plan_hold": hold}
        for stepper, potential in zip((reduced, full), potentials, strict=True):
            network = network_of(stepper)
            if network is not None:
                network.use_potential(for_networks(potential))

    @property
    def relaxing(self) -> Relaxing:
        """That of the reduced model."""
        return self._reduced.relaxing

    def prepare(self, cloth: Any, rest_pos: Any) -> tuple[Any, Any]:
        """What both need of the scene's garment."""
        self._start_over()
        return prepare_stepper(self._reduced, self._scene), prepare_stepper(self._full, self._scene)

    def _start_over(self) -> None:
        self._remaining = self._failed = 0  # steps that the full model still takes; times in a row that the reduced one failed
        self._mistaken = 0  # times in a row that the price was too high
        self._bounds: dict[str, Tensor] = {}  # (V,) of the last step that was priced
        self._known: dict[str, _Known] = {}  # by energy

    def search(self, problem: StepProblem) -> StepProblem:
        """The problem with the contact that the reduced model needs."""
        return problem if self._remaining else self._reduced.search(problem)

    def predict(self, problem: StepProblem, prepared: tuple[Any, Any], watch: Stopwatch | None = None) -> Prediction:
        """The reduced model's step, or the full one's where that is too far off."""
        price, tried = 0.0, None
        if not self._remaining:
            prediction = self._reduced.predict(problem, prepared[0], watch)
            with timed(watch, "rest"):
                price = self.price(problem, prediction.next_pos)
            if price <= self._limit:
                self._failed = self._mistaken = 0
                return self._told(prediction, price, full=False)
            tried = prediction.next_pos
        fresh = StepProblem(problem.cloth, problem.state, problem.step, gravity=problem.gravity)
        with timed(watch, "search"):
            fresh = self._full.search(fresh)
        taken = self._full.predict(fresh, prepared[1], watch)
        if tried is None:
            self._remaining -= 1
        else:
            with timed(watch, "rest"):
                self._judge(self._worth(fresh, tried, taken.next_pos))
        return self._told(taken, price, full=True)

    def _judge(self, worth: float) -> None:
        """What follows from a step that was called back, and was worth so much."""
        if not MARGIN * worth <= self._limit:
            self._remaining = min(self._hold * 2**self._failed, LONGEST) - 1
            self._failed += 1
            return
        # Twice in a row: what is just below the limit is not tried at every step.
        self._remaining, self._failed = min(self._mistaken, self._hold), 0
        self._mistaken += 1
        sums = {name: float(bounds.sum()) for name, bounds in self._bounds.items()}
        for name, bound in sums.items():
            if 2.0 * bound >= max(sums.values()) and form_of(self._potential.terms[name]) is not Form.LAYERS:
                overstated = bound / max(MARGIN * worth, bound / MOST_OVERSTATED)
                self._known[name] = _Known(max(overstated, 1.0), GROWTH * self._bounds[name], REMEMBERED)

    @torch.no_grad()
    def _worth(self, problem: StepProblem, reduced: Tensor, full: Tensor) -> float:
        """How much higher the full potential is at ``reduced`` (V, 3) [m] than at ``full`` (V, 3) [m], as γ."""
        problem = self._potential.prepare(problem)
        there, here = (self._potential.total(problem, pos.detach()).double().sum() for pos in (reduced, full))
        return float((there - here) / scale(problem).sum())

    def next_velocity(self, problem: StepProblem, prediction: Prediction) -> Tensor:
        """(V, 3) m/s at t + 1."""
        stepper = self._full if prediction.metrics["plan_full"] else self._reduced
        return stepper.next_velocity(problem, prediction)

    @torch.no_grad()
    def price(self, problem: StepProblem, pos: Tensor) -> float:
        """What the left-out energies are worth at ``pos`` (V, 3) [m], as γ; infinite where that is not finite."""
        prepared, root = self._potential.prepare(problem), 0.0
        self._bounds = {name: vertex_bounds(self._potential, [name], prepared, pos.detach()) for name in self._lacking}
        for name, bounds in self._bounds.items():
            root += self._priced(name, bounds) ** 0.5
        return root**2 if root < float("inf") else float("inf")

    def _priced(self, name: str, bounds: Tensor) -> float:
        """The bounds of an energy (V,) less what they overstate, as far as that is known; a step less is left of it."""
        whole = float(bounds.sum())
        if form_of(self._potential.terms[name]) is Form.LAYERS:
            return whole
        known = self._known.pop(name, None)
        if known is None:
            return whole
        if known.left > 1:
            self._known[name] = replace(known, left=known.left - 1)
        seen = float(torch.minimum(bounds, known.forces).sum())
        return seen / known.ratio + (whole - seen) / known.ratio**0.5

    @staticmethod
    def _told(prediction: Prediction, price: float, full: bool) -> Prediction:
        return replace(prediction, metrics={**prediction.metrics, "plan_price": price, "plan_full": float(full)})

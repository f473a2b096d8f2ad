"""Speed for accuracy: steps that a network has predicted are taken further down the potential, as far as a goal asks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from copy import copy, deepcopy
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.model.graph.known_hierarchies import given_hierarchy
from hood.scene.scene import RELAXING_DT, Scene
from hood.solver.derivatives.self_contact import approached, layers_of
from hood.solver.newton import NewtonSettings, Report, first_guess, minimize, plan_ahead
from hood.solver.step_figures import reason_number
from hood.solver.system.iterate import Progress, in_single, rounded
from hood.solver.system.plan import plan_for
from hood.solver.vertex.gauss_seidel import colours_of, sweep
from hood.steppers.network import Prediction
from hood.steppers.newton import Stepper, remembers
from hood.steppers.protocol import Relaxing, Stopwatch, timed
from hood.steppers.stopping import RefinementState, StoppingCriterion
from hood.tensors.batch import to_device

METHODS = ("newton", "sweeps")


class GuessStepper:
    """The contact-projected inertial guess as a step: where the solver starts, and a refinement without a network.

    Vertices fly on, with their weight or without it, whichever has the lower potential, and are moved out of the body. Of the
    ``settings`` it has the form of the solver. ``crossing``: as for :func:`hood.solver.newton.first_guess`; a
    :class:`RefinedStepper` takes a copy of the stepper with it, and sees to crossings itself.
    """

    times: tuple[str, ...] = ("search", "guess", "rest", "total")
    metrics: tuple[str, ...] = ()
    relaxing = Relaxing.SETTLE
    any_precision = True
    memoryless = True

    def __init__(self, potential: Potential, settings: NewtonSettings | None = None, crossing: bool = False) -> None:
        self.potential, self.settings, self.crossing = potential, settings or NewtonSettings(), crossing
        self.gravity = torch.tensor([0.0, -9.81, 0.0])
        self.config: dict[str, Any] = {"stepper": "guess"}

    def prepare(self, cloth: Cloth, rest_pos: Any) -> None:
        """Nothing is needed."""

    def search(self, problem: StepProblem) -> StepProblem:
        """The problem with what the potential's terms ask of it."""
        return self.potential.prepare(problem)

    @torch.no_grad()
    def predict(self, problem: StepProblem, prepared: None, watch: Stopwatch | None = None) -> Prediction:
        """The guess."""
        with timed(watch, "search"):
            problem = self.search(problem)
        with timed(watch, "guess"):
            return Prediction(*first_guess(self.potential, problem, self.settings, self.crossing))

    def next_velocity(self, problem: StepProblem, prediction: Prediction) -> Tensor:
        """(V, 3) m/s at t + 1: (x_{t+1} − x_t) / dt."""
        return problem.state.vel + problem.vertex_dt * prediction.acc


class RefinedStepper:
    """Takes the steps of another stepper further: iterations down ``potential`` from where that one led.

    The potential of a step never rises: what an iteration leads to is kept where it is lower, and a step for which there is no
    such place stays, to the bit, what the inner stepper made of it. Where the potential keeps layers of cloth apart, a step
    ends on this side of cloth: it is as near to what the inner stepper made of it as cloth does not cross cloth on the way, and
    iterations begin there. Iterations of Newton's method in a given number begin beyond cloth, without layers, where the step
    begins with no cloth near cloth, and again with layers if they end there. Pinned vertices stay on their
    targets. Of every frame the metrics hold ``refine_iterations`` (those that were kept), ``refine_rg`` (the relative gradient
    reached), ``refine_phi_before`` and ``refine_phi_after`` [J], ``refine_reason`` (the number of what ended it,
    :mod:`hood.solver.step_figures`) and what the goal reports; its time is ``ms_refine``. Where a goal wants no refinement of a
    frame, nothing is computed and the last four are NaN.

    In a scene of float64 a network sees the problem in its own precision; its positions are refined and kept in float64.

    Args:
        inner: a network's :class:`hood.steppers.network.NetworkStepper`, or :class:`GuessStepper`.
        potential: what is lowered, usually the one that the network was trained with.
        goal: how far. What it learns belongs to a rollout, which begins with a fresh copy.
        method: ``newton``, a few global iterations, or ``sweeps`` of single vertices, which smooth at short range.
        settings: of Newton's linear systems; its accuracy and iterations are the goal's affair.
        minimizer: takes Newton's iterations in place of :func:`hood.solver.newton.minimize`, and searches for contact itself,
            such as :class:`hood.steppers.static_shapes.newton.FixedMinimizer`.
    """

    def __init__(
        self,
        inner: Stepper,
        potential: Potential,
        goal: StoppingCriterion,
        method: str = "newton",
        settings: NewtonSettings | None = None,
        minimizer: Callable[..., tuple[Tensor, Report]] | None = None,
    ) -> None:
        if method not in METHODS:
            raise ValueError(f"method is {method!r}; choose {' or '.join(METHODS)}")
        if isinstance(inner, GuessStepper):
            inner = copy(inner)
            inner.crossing = True
        self.inner, self.potential, self.goal, self.method = inner, potential, goal, method
        self._fresh_goal, self._minimizer = deepcopy(goal), minimizer
        self.settings = replace(settings or NewtonSettings(), target_rg=goal.accuracy, max_iterations=goal.most, budget_ms=None)
        self.gravity = inner.gravity
        # The guess can be made in any precision, a network computes in that of its weights.
        self._inner_type = None if getattr(inner, "any_precision", False) else inner.gravity.dtype
        self._cloths: tuple[Cloth, Cloth] | None = None
        self.config: dict[str, Any] = {**inner.config, "refined": f"{method}, {type(goal).__name__}"}
        own = ("refine_iterations", "refine_rg", "refine_phi_before", "refine_phi_after", "refine_reason")
        self.metrics: tuple[str, ...] = (*inner.metrics, *own, *goal.metrics)
        parts = [part for part in inner.times if part not in ("rest", "total")]
        self.times: tuple[str, ...] = (*dict.fromkeys([*parts, "search"]), "refine", "rest", "total")

    @property
    def relaxing(self) -> Relaxing:
        return self.inner.relaxing

    def prepare(self, cloth: Cloth, rest_pos: Any) -> Any:
        """What the inner stepper computes once per cloth."""
        return self.inner.prepare(self.inner_cloth(cloth), rest_pos)

    def inner_cloth(self, cloth: Cloth) -> Cloth:
        """The cloth in the inner stepper's precision, the same object every time: itself where it has that, or any will do."""
        if self._inner_type in (None, cloth.rest_pos.dtype):
            return cloth
        if self._cloths is None or self._cloths[0] is not cloth:
            self._cloths = cloth, to_device(cloth, dtype=self._inner_type)
        return self._cloths[1]

    def begin_rollout(self) -> None:
        """Forget what the goal has learned in the last one."""
        self.goal = deepcopy(self._fresh_goal)

    @property
    def memoryless(self) -> bool:
        """Whether it remembers what its goal has learned alone."""
        plain = self._minimizer is None and type(self.goal).__module__ == StoppingCriterion.__module__
        return plain and not remembers(self.inner)

    @property
    def learned(self) -> dict[str, Any]:
        """What the goal has learned in this rollout, as numbers and lists of numbers."""
        known = {name: list(value) if isinstance(value, deque) else value for name, value in vars(self.goal).items()}
        return {name: value for name, value in known.items() if isinstance(value, (bool, int, float, list))}

    def recall(self, learned: Mapping[str, Any]) -> None:
        """Go on with what :attr:`learned` was."""
        for name, value in learned.items():
            own = getattr(self.goal, name)
            setattr(self.goal, name, deque(value, maxlen=own.maxlen) if isinstance(own, deque) else value)

    def search(self, problem: StepProblem) -> StepProblem:
        """The problem with what the inner stepper and the potential's terms ask of it."""
        problem = self.inner.search(problem)
        return problem if self._minimizer is not None else self.potential.prepare(problem)

    def next_velocity(self, problem: StepProblem, prediction: Prediction) -> Tensor:
        """(V, 3) m/s at t + 1, by the inner stepper's rule."""
        return self.inner.next_velocity(problem, prediction)

    @torch.no_grad()
    def predict(self, problem: StepProblem, prepared: Any, watch: Stopwatch | None = None) -> Prediction:
        """Positions at t + 1."""
        with timed(watch, "search"):
            problem = self.search(problem)
        prediction = self._inner_step(problem, prepared, watch)
        if self.relaxing is Relaxing.CARRY and bool(((problem.step.dt - RELAXING_DT).abs() < 1e-6).all()):
            # Such models turn the way that they went into a velocity: a refined one would be a blow.
            return self._apart(problem, prediction)
        with timed(watch, "refine"):
            # Made once per cloth, so here: no part of what an iteration costs.
            if self.method == "sweeps":
                colours_of(plan_for(problem), problem.cloth, problem.step.attachments)
            elif self._minimizer is None:
                plan_ahead(self.potential, problem, self.settings)
            # A relaxing step is no frame and keeps no time: the refinement alone counts for its goal.
            return self._refine(problem, prediction, (Stopwatch() if watch is None else watch).elapsed)

    def _inner_step(self, problem: StepProblem, prepared: Any, watch: Stopwatch | None) -> Prediction:
        cloth = self.inner_cloth(problem.cloth)
        if cloth is problem.cloth:
            return self.inner.predict(problem, prepared, watch)
        prediction = self.inner.predict(in_single(problem, cloth), prepared, watch)
        pos = rounded(problem, prediction.next_pos)
        return Prediction(pos, problem.acceleration(pos), prediction.metrics)

    @property
    def _looks_at_end(self) -> bool:
        """Whether iterations begin at the prediction, be it beyond cloth: ``minimize`` looks at the way to where they end."""
        return self.method == "newton" and self._minimizer is None and not self.goal.decides

    def _apart(self, problem: StepProblem, prediction: Prediction) -> Prediction:
        """The prediction, as far as cloth does not cross cloth on the way there."""
        layers = layers_of(self.potential, problem)
        if not layers:
            return prediction
        there = approached(layers, prediction.next_pos.double())
        if bool((there == prediction.next_pos.double()).all()):
            return prediction
        pos = rounded(problem, there)
        return Prediction(pos, problem.acceleration(pos), prediction.metrics)

    def _refine(self, problem: StepProblem, prediction: Prediction, elapsed: Callable[[], float]) -> Prediction:
        goal, nan = self.goal, float("nan")
        prediction = prediction if self._looks_at_end else self._apart(problem, prediction)
        reached = RefinementState(problem, prediction.next_pos, 0, nan, elapsed())
        before = after = reason = nan
        if not goal.begin(reached):
            if self._looks_at_end:
                prediction = self._apart(problem, prediction)
                reached = RefinementState(problem, prediction.next_pos, 0, nan, elapsed())
        else:
            prediction, history, reason = self._descend(problem, prediction, elapsed)
            before, after = _sum(history[0].phi), _sum(history[-1].phi)
            kept = sum(_sum(b.phi) < _sum(a.phi) for a, b in zip(history, history[1:], strict=False))
            residual = float(history[-1].relative_gradient.max())
            reached = RefinementState(problem, prediction.next_pos, kept, residual, elapsed())
        own = {
            "refine_iterations": float(reached.iterations),
            "refine_rg": reached.residual,
            "refine_phi_before": before,
            "refine_phi_after": after,
            "refine_reason": reason,
        }
        metrics = {**prediction.metrics, **own, **goal.end(reached)}
        return replace(prediction, metrics=metrics, residual=reached.residual)

    def _descend(
        self, problem: StepProblem, prediction: Prediction, elapsed: Callable[[], float]
    ) -> tuple[Prediction, list[Progress], float]:
        """The prediction after the iterations that the goal asks for, where each of them began, and what ended them."""
        done = -1

        def proceed(progress: Progress, pos: Tensor) -> bool:
            nonlocal done
            done += 1
            residual = float(progress.relative_gradient.max())
            return self.goal.proceed(RefinementState(problem, pos, done, residual, elapsed()))

        start = prediction.next_pos
        if self.method == "newton":
            asked = proceed if self.goal.decides else None
            solve = self._minimizer or minimize
            pos, report = solve(self.potential, problem, start, self.settings, proceed=asked)
            acc, history, reason = report.acc, report.history, reason_number(report.reason)
        else:
            wants = self.goal.wants_residual
            pos, swept = sweep(
                self.potential, problem, start, self.goal.most, self.settings.double, proceed=proceed, residuals=wants
            )
            acc, history, reason = swept.acc, swept.history, reason_number(swept.reason)
        lower = history[-1].phi < history[0].phi
        if self._looks_at_end and not bool(lower.all()):
            prediction = self._apart(problem, prediction)
        if not bool(lower.any()):
            # Newton may move within the rounding of the potential; its first entry says what holds where it began.
            return replace(prediction, early=()), history[:1] if self.method == "newton" else history[-1:], reason
        # Scenes of a batch are refined each for itself.
        moved = lower[problem.cloth.vertex_scene].unsqueeze(1)
        refined = torch.where(moved, pos, prediction.next_pos), torch.where(moved, acc, prediction.acc)
        return Prediction(*refined, metrics=prediction.metrics), history, reason


def unrefined(stepper: Stepper) -> Stepper:
    """The stepper that a :class:`RefinedStepper` takes further; any other one itself."""
    return stepper.inner if isinstance(stepper, RefinedStepper) else stepper


def prepare_stepper(stepper: Stepper, scene: Scene) -> Any:
    """What the stepper computes once per cloth. Coarse levels that came with the garment are used where there are enough."""
    levels = scene.garment.coarse_edges
    inner: Any = unrefined(stepper)
    cloth = scene.cloth
    needed: int | None = getattr(inner, "num_coarse", None)
    if isinstance(stepper, RefinedStepper):
        stepper.begin_rollout()
        cloth = stepper.inner_cloth(cloth)
    if needed is not None and levels is not None and len(levels) >= needed:
        hierarchy = given_hierarchy(cloth.num_vertices, levels, needed)
        return inner.prepare(cloth, scene.garment.rest_pos, hierarchy)
    return stepper.prepare(scene.cloth, scene.garment.rest_pos)


def _sum(values: Tensor) -> float:
    return float(values.sum())

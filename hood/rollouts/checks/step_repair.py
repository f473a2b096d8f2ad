"""A step taken anew: on from where a stepper left it, or by the solver from the state before."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.step_figures import StepFigures, strain_metrics, vertex_residual
from hood.steppers.network import Prediction
from hood.steppers.newton import minimize_held_off

#: A repaired step is kept if its strain p99 is higher by no more than this, or this share of it.
_MORE_STRAIN, _SHARE_MORE = 0.02, 0.1
#: Relative gradient of a step that is good enough: forces are in balance but for the cloth's own weight.
ENOUGH = 1.0
#: What became of a step: nobody tried, refined on from where it was, solved from the state before, or left as it was.
NOT_TRIED, REFINED, SOLVED, LEFT = "", "refined", "solved", "left"


@dataclass(frozen=True)
class Limits:
    """What is good enough."""

    residual: float  # relative gradient
    strain: float  # 99th percentile of the edge strain


@dataclass(frozen=True)
class StepQuality:
    """How good a step is."""

    finite: bool
    residual: float  # relative gradient; NaN where not known
    strain: float  # 99th percentile of the edge strain
    typical: float = math.nan  # median over vertices of the force left over in units of a vertex's own weight; where asked for

    def within(self, limits: Limits) -> bool:
        """Whether it is good enough."""
        return self.finite and self.residual <= limits.residual and self.strain <= limits.strain


@dataclass(frozen=True)
class RepairedStep:
    """What became of a step."""

    prediction: Prediction
    kind: str  # REFINED, SOLVED or LEFT
    iterations: int
    before: StepQuality
    after: StepQuality


def step_quality(
    potential: Potential,
    problem: StepProblem,
    prediction: Prediction,
    figures: StepFigures | None = None,
    typical: bool = False,
) -> StepQuality:
    """How good the step is; ``figures`` are those of it where they have been made, ``typical`` asks for the typical vertex's.

    A relative gradient that the stepper knows is believed, so that nothing is computed.
    """
    pos = prediction.next_pos
    if not math.isfinite(float(pos.sum())):
        return StepQuality(False, math.nan, math.nan)
    if figures is None and (typical or math.isnan(prediction.residual)):
        figures = StepFigures(potential, problem, pos, prediction.acc)
    residual = prediction.residual if figures is None else figures.relative_gradient
    median = float(vertex_residual(problem, figures.gradient).median()) if typical and figures is not None else math.nan
    return StepQuality(True, residual, strain_metrics(problem.cloth, pos)["strain_p99"], median)


@torch.no_grad()
def repair_step(
    potential: Potential,
    problem: StepProblem,
    prediction: Prediction,
    before: StepQuality,
    limits: Limits,
    settings: NewtonSettings,
    most: int,
) -> RepairedStep:
    """The step, taken further down ``potential`` by at most ``most`` iterations; where that leaves it beyond ``limits``, taken
    anew from the solver's own start. A step that the solver took (``most`` is 0) goes on from where it is, with as many
    iterations again.

    It never gets worse: what is kept has a lower relative gradient and no more strain, but for a little; else the step stays.
    A step that is not finite is replaced by any that is.

    Args:
        before: how good the step is.
        settings: of the solver; the accuracy that both tries go for.
    """
    unhurried = replace(settings, budget_ms=None)
    ways: list[tuple[str, Tensor | None, NewtonSettings]] = []
    if before.finite:
        ways.append((REFINED, prediction.next_pos, replace(unhurried, max_iterations=most) if most else unhurried))
    if most or not before.finite:
        ways.append((SOLVED, None, unhurried))
    tries, spent = [], 0
    for kind, start, how in ways:
        pos, report = minimize(potential, problem, start, how)
        if kind == REFINED and not report.iterations:
            continue  # the same step
        taken = Prediction(pos, report.acc, prediction.metrics, entered=prediction.entered, held_off=prediction.held_off)
        spent += report.iterations
        tries.append((kind, taken, step_quality(potential, problem, taken)))
        if tries[-1][2].within(limits):
            break
    better = [one for one in tries if _is_better(one[2], before)]
    if not better:
        return RepairedStep(prediction, LEFT, spent, before, before)
    kind, taken, after = min(better, key=lambda one: (not one[2].within(limits), one[2].residual))
    return RepairedStep(taken, kind, spent, before, after)


@torch.no_grad()
def out_of_skin(
    potential: Potential, problem: StepProblem, prediction: Prediction, strain: float, settings: NewtonSettings
) -> RepairedStep | None:
    """The step with its cloth held farther off where it leaves too many triangles in the skin (:mod:`hood.contact.further`);
    left as it was where that does not help or strains it beyond ``strain`` (99th percentile); None where it leaves few."""
    pos = prediction.next_pos
    if prediction.entered is not None:
        problem = replace(problem, second_contact=prediction.entered)
    held = minimize_held_off(potential, problem, pos, settings)
    if not held.rounds:
        return None
    before = step_quality(potential, held.problem, replace(prediction, residual=math.nan))
    if held.report is not None:
        taken = replace(prediction, next_pos=held.pos, acc=held.report.acc, residual=math.nan, held_off=held.problem.contact)
        after = step_quality(potential, held.problem, taken)
        # Cloth held farther off is strained the more: within the ordinary that is no loss.
        if _is_better(after, replace(before, strain=max(before.strain, strain))):
            return RepairedStep(taken, REFINED, held.iterations, before, after)
    return RepairedStep(prediction, LEFT, held.iterations, before, before)


def _is_better(now: StepQuality, before: StepQuality) -> bool:
    if not before.finite:
        return now.finite
    more = max(_MORE_STRAIN, _SHARE_MORE * before.strain)
    return now.finite and now.residual < before.residual and now.strain <= before.strain + more

"""The guard of a rollout: sees in every frame whether the step can be trusted, says so, and mends the step or stops.

Of every step the gravest of these causes is told, and of the surface what is measured of it:

- *not finite*: a position is not.
- *target*: a solver's step missed its target.
- *strain*: the 99th percentile of the edge strain is beyond 25%. Where the solver's own step is as strained (soft, heavy or
  tight cloth), the limit of a rollout that is repaired becomes 1.5 times that.
- *force*: too much is left unbalanced. Of a network alone this is the median over vertices of the force in units of the
  vertex's own weight, beyond 12 (30 in the first ten steps): the relative gradient rg is no measure there, as few vertices
  in contact take it from 4 to 1,000 between sound frames; only beyond 1e5 it counts. Else it is rg beyond 50. Either limit is
  at least five times the rollout's own level, the median of its last 30 calm steps; three tenths of it hold in steps in which
  the body turns or moves too far.
- *check*: what only a solver can tell of a network alone. On from every twentieth step, and from every step a tenth more
  strained than all that were looked at, it goes ten iterations towards the minimum, beside the rollout; where the 99th
  percentile of the edge strain there is more than 3 points off the step's, up or down, the network stretches the cloth too
  far, or hardly lets it stretch. Ten iterations suffice: on 14 steps of ``ours`` and 14 of quickstart (dress and shorts on
  dance_mixed) they come within 0.4 points of 200, where the steps themselves are up to 12 points off (quickstart: 0.4).
- *inside*: a vertex is more than 10 mm inside the body. It is mended with contact where it has got to
  (:mod:`hood.contact.further`); a solver has tried that already.
- *turn*, *speed*: the body turns by more than 15 degrees as one, or its fastest vertex moves by more than 0.3 m. A jump over
  which the cloth was carried is none.
- *cut*: the skin cuts more than 2% of the cloth's triangles, where that is measured. Of a network or a refinement ``repair``
  looks at every step, and holds cloth farther off (:mod:`hood.contact.further`) where more than 0.5% are in the skin.

The limits come from the validation list: seven garments of 1,000 vertices on walk_proud, dance_mixed, plie and
twist_and_bend, 60 frames each (``python benchmarks/guard.py``; quickstart 1,475 steps, quickstart+5 1,357, newton 1,652, ours
1,534, not all of the last motion). Median, 99.5th percentile and maximum of a step:

==================  ===================  ===================  ===================  ===================
                    quickstart           ours                 quickstart+5         newton
==================  ===================  ===================  ===================  ===================
force               1.3 / 8.9 / 10.4     10 / 26 / 29         0.09 / 47 / 142      none missed 0.01
strain p99 [%]      7.5 / 17.8 / 19.0    10.7 / 32 / 34       7.9 / 17.4 / 18.2    7.9 / – / 18.4
cut, worst [%]      1.4                  0.9                  0.3                  0.4
==================  ===================  ===================  ===================  ===================

The body turns by 4.2 degrees and moves by 0.14 m at most. What is beyond 50 is of the long sleeves in dance_mixed. A body that
spins twice a second takes the force of quickstart from 1 to 17 and more, and rg of
quickstart+5 beyond 50 six frames before its strain leaves 24% for 180%.

Its alarms: what can be beyond a limit, in which frame, and what was done about it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import torch

from hood.cloth.state import Obstacle
from hood.contact.further import CUT_SHARE
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.limits import CUT_ALARM, INSIDE_ALARM, STRAIN_ALARM, STRAIN_RATIO
from hood.rollouts.checks.step_repair import (
    ENOUGH,
    LEFT,
    NOT_TRIED,
    REFINED,
    Limits,
    RepairedStep,
    StepQuality,
    out_of_skin,
    repair_step,
    step_quality,
)
from hood.scene.jumps import moved_in_step
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.step_figures import StepFigures
from hood.steppers.network import Prediction
from hood.steppers.newton import Stepper
from hood.steppers.refined import RefinedStepper

#: Causes, as they stand in a rollout file; of a step the gravest is told, in this order.
FINITE, TARGET, STRAIN, FORCE, CHECK = "not finite", "target", "strain", "force", "check"
INSIDE, TURN, SPEED, CUT = "inside", "turn", "speed", "cut"
CAUSES = (FINITE, TARGET, STRAIN, FORCE, INSIDE, CHECK, TURN, SPEED, CUT)
#: Those that a repair of the step can help wherever they are told; cut triangles it looks for by itself.
_MENDED = (FINITE, TARGET, STRAIN, FORCE, INSIDE, CHECK)


@dataclass(frozen=True)
class Alarm:
    """A limit that a frame is beyond, and what was done about it."""

    frame: int
    cause: str  # of CAUSES
    value: float
    limit: float
    repair: str = NOT_TRIED  # of hood.rollouts.checks.step_repair
    iterations: int = 0  # of all tries
    rg_before: float = math.nan
    rg_after: float = math.nan
    # of a step all that was measured, whichever of it is the gravest; NaN where it was not
    strain: float = math.nan  # 99th percentile of the edge strain
    force: float = math.nan  # as of the cause FORCE
    depth: float = math.nan  # in the body [m]

    @property
    def mendable(self) -> bool:
        """Whether a repair can help, or has been tried."""
        return self.cause in _MENDED or self.repair != NOT_TRIED

    def repaired(self, done: RepairedStep) -> Alarm:
        """With what was done about it."""
        before, after = done.before.residual, done.after.residual
        return replace(self, repair=done.kind, iterations=done.iterations, rg_before=before, rg_after=after)


#: What a guard does about an alarm: writes it down, mends the step, or ends the rollout; ``off`` is no guard.
MODES = ("report", "repair", "strict", "off")

STRAIN_LIMIT, CUT_LIMIT = STRAIN_ALARM.value, CUT_ALARM.value
#: Depth of a vertex in the body [m].
DEPTH_LIMIT = INSIDE_ALARM.value
#: A body that turns by more degrees, or moves by more metres, in a step.
TURN_LIMIT, SPEED_LIMIT = 15.0, 0.3
#: Unbalanced force: of a network's typical vertex, or of the whole cloth where a solver or a refinement took the step.
TYPICAL_LIMIT, FORCE_LIMIT = 12.0, 50.0
#: Relative gradient that a network alone is never allowed: single vertices torn off.
WILD = 1e5
#: Of a network whose own level is not known yet.
_FIRST_TYPICAL = 30.0
#: Share of the force limit that holds where the body turns or moves too far.
_WARY = 0.3
#: The force limit is at least so many times the median of the last calm steps, once there are some.
FORCE_FACTOR, _WINDOW, _LEAST = 5.0, 30, 10
#: The strain limit is at least so many times the strain of the last step that was solved for its strain.
_STRAIN_RATIO = STRAIN_RATIO.value
#: Of a network alone every so many steps are held against a solver that goes on from there so many iterations; their strains
#: may differ by so much.
CHECK_EVERY, _CHECK_ITERATIONS, CHECK_LIMIT = 20, 10, 0.03
#: And every step that is so many times as strained as the most strained that was.
CHECK_GROWTH = 1.1
#: Relative gradient that a step is repaired to where the stepper has no target of its own.
_GOAL = 1e-2


class Guard:
    """Watches one rollout.

    Args:
        mode: ``report``, ``repair`` or ``strict``.
        stepper: takes the steps.
        potential: what they are judged by, and minimised by a repair.
        settings: of the solver that mends; default the stepper's own.
        most: iterations at most by which a step is refined; those of a solver are taken anew instead.
    """

    def __init__(
        self, mode: str, stepper: Stepper, potential: Potential, settings: NewtonSettings | None = None, most: int = 50
    ) -> None:
        if mode not in MODES[:-1]:
            raise ValueError(f"guard is {mode!r}; choose {', '.join(MODES[:-1])}")
        self.mode, self.alarms = mode, list[Alarm]()
        self._potential = potential
        own = _own_settings(stepper)
        self._most = most if own is None else 0
        self._target = None if own is None else own.target_rg
        self._alone = own is None and not isinstance(stepper, RefinedStepper)
        self._settings = replace(settings or own or NewtonSettings(), target_rg=self._target or _GOAL)
        self._calm: deque[float] = deque(maxlen=_WINDOW)
        self._strain_limit = STRAIN_LIMIT
        self._checked_strain = 0.0

    @property
    def memory(self) -> dict[str, Any]:
        """What its limits depend on beside its arguments; alarms do not."""
        return {"calm": list(self._calm), "strain_limit": self._strain_limit, "checked_strain": self._checked_strain}

    def recall(self, memory: Mapping[str, Any], alarms: Iterable[Mapping[str, Any]]) -> None:
        """Go on with what :attr:`memory` was, after ``alarms``, each with the names of :class:`Alarm`."""
        self._calm.extend(memory["calm"])
        self._strain_limit, self._checked_strain = memory["strain_limit"], memory["checked_strain"]
        self.alarms += [Alarm(**alarm) for alarm in alarms]

    @property
    def stopped(self) -> Alarm | None:
        """The alarm that ends the rollout; None while it goes on."""
        return self.alarms[0] if self.mode == "strict" and self.alarms else None

    @torch.no_grad()
    def see(self, frame: int, problem: StepProblem, prediction: Prediction, figures: StepFigures | None = None) -> Prediction:
        """The step to go on with: ``prediction`` itself where there is no alarm, and where nothing better is found.

        Args:
            frame: that the step leads to.
            problem: prepared for the potential.
            figures: of the step, where somebody has made them.
        """
        prediction = self._see(frame, problem, prediction, figures)
        mends = self.mode == "repair" and self._target is None  # a solver holds its steps off by itself
        return self._out_of_skin(frame, problem, prediction) if mends else prediction

    def _see(self, frame: int, problem: StepProblem, prediction: Prediction, figures: StepFigures | None) -> Prediction:
        now = step_quality(self._potential, problem, prediction, figures, typical=self._alone)
        moved = _motion_alarm(frame, problem.step.obstacle)
        depth = problem.next_depth(prediction.next_pos) if now.finite else math.nan
        alarm = self._step_alarm(frame, prediction, now, depth, wary=moved is not None)
        if alarm is not None:
            wild = self._alone and now.residual > WILD
            alarm = replace(alarm, strain=now.strain, force=now.residual if wild else self._force(now), depth=depth)
        if alarm is None and self._alone and self._is_due(frame, now.strain):
            checked, prediction = self._check(frame, problem, prediction, now)
            if checked is not None:
                self.alarms.append(checked)
                return prediction
        if alarm is None:
            self._calm.append(self._force(now))
            self.alarms += [] if moved is None else [moved]
            return prediction
        if self.mode != "repair" or (self._target is not None and alarm.cause not in (FINITE, TARGET)):
            # A step that met the solver's target is as good as the solver can make it.
            self.alarms.append(alarm)
            return prediction
        repaired = self._mended(problem, prediction, now, depth)
        if alarm.cause == STRAIN:
            self._allow(repaired)
        self.alarms.append(alarm.repaired(repaired))
        return prediction if repaired.kind == LEFT else self._told(repaired)

    def _mended(self, problem: StepProblem, given: Prediction, now: StepQuality, depth: float) -> RepairedStep:
        """The step repaired, with contact where it has got into skin that it did not know of; once more where the repair got
        deeper into such skin; left as it was where that does not help either."""
        limits = Limits(ENOUGH if self._target is None else self._target, self._strain_limit)
        allowed, reached, spent = max(depth, DEPTH_LIMIT), depth, 0
        prediction, inside = given, given.next_pos
        for tried in (False, True):
            if reached > DEPTH_LIMIT:
                known, problem = problem, problem.with_entered(inside)
                if tried and problem is known:
                    break
                prediction = replace(given, residual=math.nan, entered=problem.second_contact)
                now = step_quality(self._potential, problem, prediction, typical=self._alone)
                # Cloth taken out of the body is strained the more: within the limit that is no loss.
                now = replace(now, strain=max(now.strain, self._strain_limit))
            repaired = repair_step(self._potential, problem, prediction, now, limits, self._settings, self._most)
            inside, spent = repaired.prediction.next_pos, spent + repaired.iterations
            reached = problem.next_depth(inside)
            if repaired.kind == LEFT or not reached > allowed:
                return replace(repaired, iterations=spent)
        return RepairedStep(given, LEFT, spent, now, now)

    def _out_of_skin(self, frame: int, problem: StepProblem, prediction: Prediction) -> Prediction:
        """The step without too many triangles in the skin; itself where it has few, or where nothing better is found."""
        settings = replace(self._settings, max_iterations=self._most, budget_ms=None)
        done = out_of_skin(self._potential, problem, prediction, STRAIN_LIMIT, settings)
        if done is None:
            return prediction
        depth = problem.next_depth(done.prediction.next_pos)
        if depth > max(DEPTH_LIMIT, problem.next_depth(prediction.next_pos)):
            done = RepairedStep(prediction, LEFT, done.iterations, done.before, done.before)
        share = int(problem.num_in_skin(prediction.next_pos)) / len(problem.cloth.faces)
        self.alarms.append(Alarm(frame, CUT, share, CUT_SHARE).repaired(done))
        return self._told(done)

    def see_surface(self, frame: int, row: Mapping[str, float]) -> None:
        """Look at what was measured of the cloth's surface in a frame."""
        share = row.get("cut_face_share", math.nan)
        if share > CUT_LIMIT:
            self.alarms.append(Alarm(frame, CUT, share, CUT_LIMIT))

    def _step_alarm(self, frame: int, prediction: Prediction, now: StepQuality, depth: float, wary: bool) -> Alarm | None:
        """The gravest of a step."""
        if not now.finite:
            return Alarm(frame, FINITE, math.nan, math.nan)
        if self._target is not None and prediction.metrics.get("solver_converged") == 0.0:
            return Alarm(frame, TARGET, now.residual, self._target)
        if now.strain > self._strain_limit:
            return Alarm(frame, STRAIN, now.strain, self._strain_limit)
        if self._alone and now.residual > WILD:
            return Alarm(frame, FORCE, now.residual, WILD)
        force, limit = self._force(now), (_WARY if wary else 1.0) * self._force_limit()
        if not force <= limit:
            return Alarm(frame, FORCE, force, limit)
        return Alarm(frame, INSIDE, depth, DEPTH_LIMIT) if depth > DEPTH_LIMIT else None

    def _is_due(self, frame: int, strain: float) -> bool:
        """Whether a step is to be checked: every so many, and those more strained than all that were checked."""
        if frame % CHECK_EVERY and strain <= CHECK_GROWTH * self._checked_strain:
            return False
        self._checked_strain = max(self._checked_strain, strain)
        return True

    def _check(
        self, frame: int, problem: StepProblem, prediction: Prediction, now: StepQuality
    ) -> tuple[Alarm | None, Prediction]:
        """Whether the strain is what a solver makes of it; the step to go on with, which is the solver's where it mends."""
        settings = replace(self._settings, target_rg=_GOAL, max_iterations=_CHECK_ITERATIONS, budget_ms=None)
        pos, report = minimize(self._potential, problem, prediction.next_pos, settings)
        after = step_quality(self._potential, problem, Prediction(pos, report.acc))
        off = abs(after.strain - now.strain)
        if not after.finite or off <= CHECK_LIMIT:
            return None, prediction
        alarm = Alarm(frame, CHECK, off, CHECK_LIMIT)
        if self.mode != "repair":
            return alarm, prediction
        kind = REFINED if after.residual < now.residual else LEFT
        taken = prediction if kind == LEFT else Prediction(pos, report.acc, prediction.metrics)
        repaired = RepairedStep(taken, kind, report.iterations, now, after if kind == REFINED else now)
        return alarm.repaired(repaired), self._told(repaired)

    def _force(self, now: StepQuality) -> float:
        return now.typical if self._alone else now.residual

    def _force_limit(self) -> float:
        """Against the rollout's own level, and never less than what is usual."""
        if len(self._calm) < _LEAST:
            return _FIRST_TYPICAL if self._alone else FORCE_LIMIT
        return max(TYPICAL_LIMIT if self._alone else FORCE_LIMIT, FORCE_FACTOR * median(self._calm))

    def _allow(self, repaired: RepairedStep) -> None:
        """Cloth that is as strained where the solver takes the step is not held to less: it is soft, heavy or tight."""
        if repaired.after.residual <= ENOUGH and repaired.after.strain > STRAIN_LIMIT:
            self._strain_limit = _STRAIN_RATIO * repaired.after.strain

    def _told(self, repaired: RepairedStep) -> Prediction:
        """The repaired step with what the stepper reports of it."""
        if repaired.kind == LEFT:
            return repaired.prediction
        metrics, residual = dict(repaired.prediction.metrics), repaired.after.residual
        for name in ("solver_iterations", "refine_iterations"):
            if name in metrics:
                metrics[name] += repaired.iterations
        if "refine_rg" in metrics:
            metrics["refine_rg"] = residual
        if "solver_converged" in metrics and self._target is not None and residual <= self._target:
            metrics |= {"solver_converged": 1.0, "solver_reason": 0.0}
        return replace(repaired.prediction, metrics=metrics, residual=residual)


def _own_settings(stepper: Stepper) -> NewtonSettings | None:
    """Of a solver, which has a target in every step; None of all others."""
    settings: NewtonSettings | None = getattr(stepper, "solves_to", None)
    return settings


def _motion_alarm(frame: int, obstacle: Obstacle | None) -> Alarm | None:
    """Where the body turns or moves too far in a step; a jump over which the cloth was carried is none."""
    turn, way = moved_in_step(obstacle)
    if turn > TURN_LIMIT:
        return Alarm(frame, TURN, turn, TURN_LIMIT)
    return Alarm(frame, SPEED, way, SPEED_LIMIT) if way > SPEED_LIMIT else None

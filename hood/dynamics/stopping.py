"""When a refinement stops: after so many iterations, or where a goal is met. One class each; a rollout keeps its own."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from hood.dynamics.measure import strain_metrics
from hood.dynamics.refine_table import Costs
from hood.losses.problem import StepProblem
from hood.scene.scene import RELAXING_DT

#: Iterations at most where a goal is not reached.
MOST = 50
#: Where the relative gradient is this small nothing that shows is left to gain.
CONVERGED = 1e-4


@dataclass(frozen=True)
class RefinementState:
    """Where the refinement of a frame stands."""

    problem: StepProblem
    pos: Tensor  # (V, 3) m
    iterations: int
    residual: float  # relative gradient, of the worst scene; NaN where not known
    elapsed: float  # ms of this frame so far

    @property
    def strain(self) -> float:
        """99th percentile of the edge strain."""
        return strain_metrics(self.problem.cloth, self.pos)["strain_p99"]


class StoppingCriterion(Protocol):
    """Decides, iteration by iteration, how far a frame is refined; learns from frame to frame."""

    most: int  # iterations of a frame at most
    accuracy: float  # relative gradient at which every frame is done
    decides: bool  # whether it stops a frame for other reasons than ``most`` and ``accuracy``
    wants_residual: bool  # whether it reads ``RefinementState.residual`` before every iteration
    metrics: tuple[str, ...]  # names of what ``end`` returns

    def begin(self, state: RefinementState) -> bool:
        """Whether this frame is refined at all; asked before anything is computed for it."""
        ...

    def proceed(self, state: RefinementState) -> bool:
        """Whether to take one more iteration."""
        ...

    def end(self, state: RefinementState) -> dict[str, float]:
        """Told where the frame ended, also one that was not refined; what there is to report."""
        ...


class Count:
    """``count`` iterations in every frame, fewer only where nothing is left to gain."""

    accuracy = CONVERGED
    decides = False
    wants_residual = False
    metrics: tuple[str, ...] = ()

    def __init__(self, count: int) -> None:
        if count < 0:
            raise ValueError(f"refine is {count}; give 0 or more iterations")
        self.most = count

    def begin(self, state: RefinementState) -> bool:
        return self.most > 0

    def proceed(self, state: RefinementState) -> bool:
        return state.iterations < self.most

    def end(self, state: RefinementState) -> dict[str, float]:
        return {}


class TargetResidual:
    """Until the relative gradient is ``target`` or less; ``refine_met`` says whether it is."""

    decides = True
    wants_residual = True
    metrics: tuple[str, ...] = ("refine_met",)

    def __init__(self, target: float, most: int = MOST) -> None:
        if not target > 0:
            raise ValueError(f"target_rg is {target:g}; give a relative gradient > 0 (0.1: a tenth of the weight)")
        self.target, self.most, self.accuracy = target, most, min(target, CONVERGED)

    def begin(self, state: RefinementState) -> bool:
        return True

    def proceed(self, state: RefinementState) -> bool:
        return not state.residual <= self.target and state.iterations < self.most

    def end(self, state: RefinementState) -> dict[str, float]:
        return {"refine_met": float(state.residual <= self.target)}


class MaxStrain:
    """Until the 99th percentile of the edge strain is ``limit`` or less, and never less than a floor that follows the motion.

    A frame that came in under the limit may still hand a strained velocity to the next. So the floor rises by one with every
    frame that needed more iterations than it, and falls by one with every frame that ends below :data:`_COMFORT` of the limit.

    Args:
        floor: iterations to begin with, see :func:`hood.dynamics.refine_table.floor_from_table`.
    """

    accuracy = CONVERGED
    decides = True
    wants_residual = False
    metrics: tuple[str, ...] = ("refine_met",)
    _COMFORT = 0.7

    def __init__(self, limit: float, most: int = MOST, floor: int = 2) -> None:
        if not limit > 0:
            raise ValueError(f"max_strain is {limit:g}; give a relative change of length > 0 (0.05: 5%)")
        self.limit, self.most, self.floor = limit, most, min(floor, most)

    def begin(self, state: RefinementState) -> bool:
        return self.floor > 0 or not state.strain <= self.limit

    def proceed(self, state: RefinementState) -> bool:
        if state.iterations >= self.most:
            return False
        return state.iterations < self.floor or not state.strain <= self.limit

    def end(self, state: RefinementState) -> dict[str, float]:
        strain = state.strain
        if state.iterations > self.floor:
            self.floor += 1
        elif strain <= self._COMFORT * self.limit:
            self.floor = max(self.floor - 1, 0)
        return {"refine_met": float(strain <= self.limit)}


class Budget:
    """As many iterations as fit into ``budget_ms`` a frame, all of the frame included.

    What an iteration costs, and what comes before the first and after the last, is measured in this very rollout. An
    iteration is begun where even a dear one fits into what is left: one whose cost only a share ``risk`` of the last
    :data:`_MEMORY` exceeds. On a machine with other work a few iterations take several times as long as most, and frames are
    late by those few. The risk finds itself the value at which :data:`_LATE` of all frames are late, whatever the noise: it
    falls with a late frame and rises a little with every other one, in the proportion in which these may occur; below zero
    more than the dearest iteration must fit. Frames that are late before their refinement use the same allowance up, so
    that on a machine where nothing is left of it nothing is refined.

    Args:
        measured: what a table says, see :func:`hood.dynamics.refine_table.costs_from_table`: the first frames are planned with
            it, scaled by what a frame takes here before it is refined. Without it one iteration is tried.
    """

    accuracy = CONVERGED
    decides = True
    wants_residual = False
    metrics: tuple[str, ...] = ()
    _LATE = 0.03
    _PACE = 0.01  # by which a late frame lowers the risk
    _MOST_RISK = 0.25
    _SHY = 30.0  # what must fit grows by this share of the dearest iteration for every unit of risk below zero
    _MEMORY = 60  # measurements that are remembered
    _FEW = 5  # measurements of which the least is believed: the first ones pay for memory and caches
    #: Per frame that was not refined, while a late one is allowed: what was dear once is tried again.
    _HOPE, _FEW_HOPE = 0.995, 0.9
    _CALM = 20  # frames on time that are taken for granted when those late before their refinement are counted

    def __init__(self, budget_ms: float, most: int = 200, measured: Costs | None = None) -> None:
        if not budget_ms > 0:
            raise ValueError(f"budget_ms is {budget_ms:g}; give the milliseconds of a frame, > 0")
        self.budget_ms, self.most, self.measured = budget_ms, most, measured
        self._risk = self._LATE
        self._costs: deque[float] = deque(maxlen=self._MEMORY)
        self._setups: deque[float] = deque(maxlen=self._MEMORY)
        self._endings: deque[float] = deque(maxlen=self._MEMORY)
        self._frames = self._late_before = 0
        self._scale = self._trust = 1.0  # of what was measured elsewhere: this machine against that one, and hope
        self._last = 0.0  # ms of the frame at the last measurement
        self._refined = False

    @property
    def risk(self) -> float:
        """Share of the iterations that may cost more than is planned for."""
        left = self._LATE - self._late_before / (self._frames + self._CALM)
        return self._risk if left > 0 else min(self._risk, left)

    @property
    def cost(self) -> float:
        """What is planned for an iteration [ms]; 0 before the first, where no table says it."""
        return self._dear(self._costs, 0.0 if self.measured is None else self.measured.iteration)

    def begin(self, state: RefinementState) -> bool:
        self._last = state.elapsed
        self._frames += 1
        self._late_before += state.elapsed > self.budget_ms
        if self.measured is not None and self.measured.frame and not _relaxes(state.problem):
            self._scale = state.elapsed / self.measured.frame
        self._refined = self._fits(state.elapsed + self._dear(self._setups, self.measured.setup if self.measured else 0.0))
        if not self._refined and self.risk > 0:
            self._trust *= self._FEW_HOPE
            for past in (self._costs, self._setups):
                hope = self._HOPE if len(past) >= self._FEW else self._FEW_HOPE
                for index, value in enumerate(past):
                    past[index] = hope * value
        return self._refined

    def proceed(self, state: RefinementState) -> bool:
        (self._costs if state.iterations else self._setups).append(state.elapsed - self._last)
        self._last = state.elapsed
        # Before the first measurement an iteration may cost anything: one is tried.
        known = bool(self._costs) or self.measured is not None
        fits = self._fits(state.elapsed) if known else state.iterations == 0
        return fits and state.iterations < self.most

    def end(self, state: RefinementState) -> dict[str, float]:
        if self._refined:
            self._endings.append(state.elapsed - self._last)
        late = state.elapsed > self.budget_ms
        self._risk = min(self._risk + self._PACE * (self._LATE - late), self._MOST_RISK)
        return {}

    def _dear(self, past: deque[float], elsewhere: float = 0.0) -> float:
        """The cost that only a share ``risk`` of those measured exceeds; of few the least, or what was measured elsewhere."""
        if len(past) < self._FEW:
            known = [*past, *([self._trust * self._scale * elsewhere] if elsewhere > 0 else [])]
            return min(known, default=0.0)
        ordered, risk = sorted(past), self.risk
        if risk <= 0:
            return ordered[-1] * (1.0 - self._SHY * risk)
        return ordered[min(int((1.0 - risk) * len(ordered)), len(ordered) - 1)]

    def _fits(self, elapsed: float) -> bool:
        return elapsed + self.cost + self._dear(self._endings) <= self.budget_ms


def _relaxes(problem: StepProblem) -> bool:
    """Whether this is a relaxing step: no frame, its time says nothing."""
    return bool(((problem.step.dt - RELAXING_DT).abs() < 1e-6).all())

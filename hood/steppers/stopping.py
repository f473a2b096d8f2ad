"""When a refinement stops: after so many iterations, or where a goal is met. One class each; a rollout keeps its own.

Measured refinements: what so many iterations cost and reach, read from a table to begin where others have been.
"""

from __future__ import annotations

import json
import math
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Protocol

from torch import Tensor

from hood.energies.problem import StepProblem
from hood.scene.scene import RELAXING_DT
from hood.solver.step_figures import strain_metrics


@dataclass(frozen=True)
class Costs:
    """What a refined frame costs on the machine of the table [ms]."""

    iteration: float
    setup: float  # before the first iteration, beyond what a frame costs without refinement
    frame: float | None  # without refinement; None where the table does not say


def floor_from_table(path: Path, limit: float, num_vertices: int, method: str) -> int:
    """Iterations with which a table of measurements stays at ``limit`` or below, for :class:`hood.steppers.stopping.MaxStrain`.

    The file is JSON: ``{"rows": [{"method": "newton", "vertices": 1014, "refine": 5, "strain_p99": 0.04}, …]}``; further
    entries of a row are not read. Of the method's rows those count whose number of vertices is nearest by ratio; where none
    of them is low enough, the lowest.

    Raises:
        ValueError: not such a file, an entry that is missing or no number, or no row of the method.
    """
    rows = _nearest_rows(path, method, "strain_p99", num_vertices)
    enough = [k for k, strain in rows if strain <= limit]
    return min(enough) if enough else min(rows, key=lambda row: row[1])[0]


def costs_from_table(path: Path, num_vertices: int, method: str) -> Costs:
    """What an iteration costs, for :class:`hood.steppers.stopping.Budget`, from the same rows' ``ms`` of a whole frame.

    An iteration costs the median of what it costs between neighbouring rows with ``refine`` of 1 or more; with a single one
    of them, its share of what that row takes longer than the row without refinement.

    Raises:
        ValueError: as above, or too few rows to tell.
    """
    measured: dict[int, list[float]] = {}
    for k, ms in _nearest_rows(path, method, "ms", num_vertices):
        measured.setdefault(k, []).append(ms)
    times = {k: median(measured[k]) for k in sorted(measured)}
    frame, refined = times.pop(0, None), list(times.items())
    if not refined or (len(refined) == 1 and frame is None):
        raise ValueError(
            f"{path}: ms of {len(measured)} values of refine for method {method!r} do not say what an iteration costs; add rows"
        )
    if len(refined) == 1:
        assert frame is not None
        k, ms = refined[0]
        return Costs(max((ms - frame) / k, 0.0), 0.0, frame)
    slope = max(median((b[1] - a[1]) / (b[0] - a[0]) for a, b in zip(refined, refined[1:], strict=False)), 0.0)
    start = refined[0][1] - slope * refined[0][0]
    return Costs(slope, max(start - frame, 0.0) if frame is not None else 0.0, frame)


def _nearest_rows(path: Path, method: str, field: str, num_vertices: int) -> list[tuple[int, float]]:
    """``refine`` and ``field`` of the method's rows whose number of vertices is nearest by ratio."""
    rows = [
        (_number(path, i, row, "vertices", 1), int(_number(path, i, row, "refine", 0)), _number(path, i, row, field, 0))
        for i, row in enumerate(_rows(path))
        if _method(path, i, row) == method
    ]
    if not rows:
        raise ValueError(f"{path}: has no row of method {method!r}; leave the table out to adapt online alone")
    nearest = min(max(vertices / num_vertices, num_vertices / vertices) for vertices, *_ in rows)
    return [(k, value) for vertices, k, value in rows if max(vertices / num_vertices, num_vertices / vertices) == nearest]


def _rows(path: Path) -> list[dict[str, Any]]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not a table of refinements, no JSON ({error}); hood tradeoff writes one") from error
    rows = content.get("rows") if isinstance(content, dict) else None
    if not isinstance(rows, list):
        raise ValueError(f"{path}: not a table of refinements, it has no list named rows; hood tradeoff writes one")
    return rows


def _method(path: Path, index: int, row: Any) -> str:
    if not isinstance(row, dict) or not isinstance(row.get("method"), str):
        raise ValueError(f"{path}: row {index}: method is missing; give newton or sweeps")
    return str(row["method"])


def _number(path: Path, index: int, row: dict[str, Any], field: str, least: int) -> float:
    """Entry ``field`` of a row: finite, ``least`` or more."""
    value, counts = row.get(field), field in ("vertices", "refine")
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value >= least:
        if not counts or value == int(value):
            return float(value)
    given = "is missing" if field not in row else f"is {value!r}"
    kind = "a whole number" if counts else "a finite number"
    raise ValueError(f"{path}: row {index}: {field} {given}; give {kind}, {least} or more")


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
        floor: iterations to begin with, see :func:`hood.steppers.stopping.floor_from_table`.
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
        measured: what a table says, see :func:`hood.steppers.stopping.costs_from_table`: the first frames are planned with
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

"""When a refinement stops: after so many iterations, or where a goal is met. One class each; a rollout keeps its own."""

from __future__ import annotations

import json
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Protocol

from torch import Tensor

from hood.dynamics.measure import strain_metrics
from hood.losses.problem import StepProblem

#: Iterations at most where a goal is not reached.
MOST = 50


@dataclass(frozen=True)
class Standing:
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


class Goal(Protocol):
    """Decides, iteration by iteration, how far a frame is refined; learns from frame to frame."""

    most: int  # iterations of a frame at most
    wants_residual: bool  # whether it reads ``Standing.residual`` before every iteration
    metrics: tuple[str, ...]  # names of what ``end`` returns

    def begin(self, standing: Standing) -> bool:
        """Whether this frame is refined at all; asked before anything is computed for it."""
        ...

    def proceed(self, standing: Standing) -> bool:
        """Whether to take one more iteration."""
        ...

    def end(self, standing: Standing) -> dict[str, float]:
        """Told where the frame ended, also one that was not refined; what there is to report."""
        ...


class Count:
    """``count`` iterations in every frame, fewer only where nothing is left to gain."""

    wants_residual = False
    metrics: tuple[str, ...] = ()

    def __init__(self, count: int) -> None:
        if count < 0:
            raise ValueError(f"refine is {count}; give 0 or more iterations")
        self.most = count

    def begin(self, standing: Standing) -> bool:
        return self.most > 0

    def proceed(self, standing: Standing) -> bool:
        return standing.iterations < self.most

    def end(self, standing: Standing) -> dict[str, float]:
        return {}


class TargetResidual:
    """Until the relative gradient is ``target`` or less; ``refine_met`` says whether it is."""

    wants_residual = True
    metrics: tuple[str, ...] = ("refine_met",)

    def __init__(self, target: float, most: int = MOST) -> None:
        if not target > 0:
            raise ValueError(f"target_rg is {target:g}; give a relative gradient > 0 (0.1: a tenth of the weight)")
        self.target, self.most = target, most

    def begin(self, standing: Standing) -> bool:
        return True

    def proceed(self, standing: Standing) -> bool:
        return not standing.residual <= self.target and standing.iterations < self.most

    def end(self, standing: Standing) -> dict[str, float]:
        return {"refine_met": float(standing.residual <= self.target)}


class MaxStrain:
    """Until the 99th percentile of the edge strain is ``limit`` or less, and never less than a floor that follows the motion.

    A frame that came in under the limit may still hand a strained velocity to the next. So the floor rises by one with every
    frame that needed more iterations than it, and falls by one with every frame that ends below :data:`_COMFORT` of the limit.

    Args:
        floor: iterations to begin with, see :func:`floor_from_table`.
    """

    wants_residual = False
    metrics: tuple[str, ...] = ("refine_met",)
    _COMFORT = 0.7

    def __init__(self, limit: float, most: int = MOST, floor: int = 2) -> None:
        if not limit > 0:
            raise ValueError(f"max_strain is {limit:g}; give a relative change of length > 0 (0.05: 5%)")
        self.limit, self.most, self.floor = limit, most, min(floor, most)

    def begin(self, standing: Standing) -> bool:
        return self.floor > 0 or not standing.strain <= self.limit

    def proceed(self, standing: Standing) -> bool:
        if standing.iterations >= self.most:
            return False
        return standing.iterations < self.floor or not standing.strain <= self.limit

    def end(self, standing: Standing) -> dict[str, float]:
        strain = standing.strain
        if standing.iterations > self.floor:
            self.floor += 1
        elif strain <= self._COMFORT * self.limit:
            self.floor = max(self.floor - 1, 0)
        return {"refine_met": float(strain <= self.limit)}


class Budget:
    """As many iterations as fit into ``budget_ms`` a frame, all of the frame included.

    What an iteration costs, and what comes before the first and after the last, is measured in this very rollout. An
    iteration is begun where its cost and a margin fit into what is left. The margin, ``caution`` times the cost, finds itself
    the value at which :data:`_LATE` of all frames are late, whatever the noise: it grows with a late frame and shrinks a
    little with every other one, in the proportion in which these may occur.
    """

    wants_residual = False
    metrics: tuple[str, ...] = ()
    _LATE = 0.02
    _GAIN = 0.5  # by which a late frame raises the caution
    _MOST_CAUTIOUS = 20.0
    _MEMORY = 40  # measurements that are remembered
    _FEW = 5  # measurements of which the least is believed: the first ones pay for memory and caches
    _HOPE, _FEW_HOPE = 0.995, 0.9  # per frame that was not refined: what was expensive once is tried again some day

    def __init__(self, budget_ms: float, most: int = 200) -> None:
        if not budget_ms > 0:
            raise ValueError(f"budget_ms is {budget_ms:g}; give the milliseconds of a frame, > 0")
        self.budget_ms, self.most = budget_ms, most
        self.caution = self._GAIN
        self._costs: deque[float] = deque(maxlen=self._MEMORY)
        self._setups: deque[float] = deque(maxlen=self._MEMORY)
        self._endings: deque[float] = deque(maxlen=self._MEMORY)
        self._last = 0.0  # ms of the frame at the last measurement
        self._refined = False

    @property
    def cost(self) -> float:
        """Expected cost of an iteration [ms]; 0 before the first."""
        return self._expected(self._costs)

    def begin(self, standing: Standing) -> bool:
        self._last = standing.elapsed
        self._refined = self._fits(standing.elapsed + self._expected(self._setups))
        if not self._refined:
            for past in (self._costs, self._setups):
                hope = self._HOPE if len(past) >= self._FEW else self._FEW_HOPE
                for index, value in enumerate(past):
                    past[index] = hope * value
        return self._refined

    def proceed(self, standing: Standing) -> bool:
        (self._costs if standing.iterations else self._setups).append(standing.elapsed - self._last)
        self._last = standing.elapsed
        # Before the first measurement an iteration may cost anything: one is tried.
        fits = self._fits(standing.elapsed) if self._costs else standing.iterations == 0
        return fits and standing.iterations < self.most

    def end(self, standing: Standing) -> dict[str, float]:
        if self._refined:
            self._endings.append(standing.elapsed - self._last)
        late = standing.elapsed > self.budget_ms
        caution = self.caution + self._GAIN * ((1.0 - self._LATE) if late else -self._LATE)
        self.caution = min(max(caution, 0.0), self._MOST_CAUTIOUS)
        return {}

    def _expected(self, past: deque[float]) -> float:
        return 0.0 if not past else min(past) if len(past) < self._FEW else median(past)

    def _fits(self, elapsed: float) -> bool:
        return elapsed + (1.0 + self.caution) * self.cost + self._expected(self._endings) <= self.budget_ms


def floor_from_table(path: Path, limit: float, num_vertices: int, method: str) -> int:
    """Iterations with which a table of measurements stays at ``limit`` or below, see :class:`MaxStrain`.

    The file is JSON: ``{"rows": [{"method": "newton", "vertices": 1014, "refine": 5, "strain_p99": 0.04}, …]}``; further
    entries of a row are not read. Of the method's rows those count whose number of vertices is nearest by ratio; where none
    of them is low enough, the lowest.

    Raises:
        ValueError: not such a file, or no row of the method.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))["rows"]
        rows = [
            (int(row["vertices"]), int(row["refine"]), float(row["strain_p99"])) for row in content if row["method"] == method
        ]
    except FileNotFoundError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path}: not a table of refinements ({type(error).__name__}: {error}); it needs rows with method, vertices, "
            "refine and strain_p99"
        ) from error
    if not rows or min(vertices for vertices, *_ in rows) < 1:
        raise ValueError(f"{path}: has no row of method {method!r} with vertices; leave refine_table out to adapt online alone")
    nearest = min((max(v / num_vertices, num_vertices / v) for v, *_ in rows))
    fitting = [(k, strain) for v, k, strain in rows if max(v / num_vertices, num_vertices / v) == nearest]
    enough = [k for k, strain in fitting if strain <= limit]
    return min(enough) if enough else min(fitting, key=lambda row: row[1])[0]

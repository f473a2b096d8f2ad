"""Alarms of a guard (:mod:`hood.dynamics.guard`): what can be beyond a limit, in which frame, and what was done about it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from hood.dynamics.step_repair import NOT_TRIED, RepairedStep

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
    repair: str = NOT_TRIED  # of hood.dynamics.step_repair
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

"""Why a minimisation ended, as words in a report and as numbers in a rollout's metrics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

CONVERGED, MOST_ITERATIONS, STOPPED, LATE = "", "max iterations", "stopped", "time budget"
STUCK, NO_PROGRESS, NOT_FINITE = "line search failed", "no progress", "not finite"
#: The number of a reason is its place here; of several scenes the last one counts.
REASONS = (CONVERGED, MOST_ITERATIONS, STOPPED, LATE, NO_PROGRESS, STUCK, NOT_FINITE)


#: What a count of reasons calls the first one.
MET = "converged"


def reason_number(reasons: Sequence[str]) -> float:
    """The reason of the scene that went worst, as a number."""
    return float(max(map(REASONS.index, reasons), default=0))


def count_reasons(numbers: np.ndarray) -> dict[str, int]:
    """How often each reason occurs among ``numbers`` (T,), those of steps that met their target as ``converged``.

    NaN, where no minimisation took place, is left out.
    """
    counts = {reason or MET: int((numbers == number).sum()) for number, reason in enumerate(REASONS)}
    return {reason: count for reason, count in counts.items() if count}


def name_counts(counts: Mapping[str, int]) -> str:
    """``24 max iterations, 3 line search failed``."""
    return ", ".join(f"{count} {reason}" for reason, count in counts.items())

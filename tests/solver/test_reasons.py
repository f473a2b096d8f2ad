"""Reasons as numbers and back."""

from __future__ import annotations

import numpy as np

from hood.solver.step_figures import CONVERGED, MOST_ITERATIONS, NOT_FINITE, STUCK, count_reasons, name_counts, reason_number


def test_the_worst_scene_counts() -> None:
    assert reason_number((CONVERGED, CONVERGED)) == 0.0
    assert reason_number((MOST_ITERATIONS, NOT_FINITE, STUCK)) == reason_number((NOT_FINITE,))


def test_counts_come_back_as_words() -> None:
    numbers = np.array([np.nan, *(reason_number((reason,)) for reason in (STUCK, CONVERGED, STUCK, MOST_ITERATIONS))])
    assert count_reasons(numbers) == {"converged": 1, "max iterations": 1, "line search failed": 2}
    assert name_counts(count_reasons(numbers)) == "1 converged, 1 max iterations, 2 line search failed"

"""How far a figure would move with other rollouts: bootstrap intervals over whole rollouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

#: Chance that an interval covers what infinitely many rollouts would give.
LEVEL = 0.95


def bootstrap_interval(
    groups: Sequence[np.ndarray],
    statistic: Callable[[np.ndarray], float],
    resamples: int = 1000,
    seed: int = 0,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Percentile interval (low, high) of ``statistic`` of the pooled values of ``groups``.

    Whole groups are drawn with replacement, as many as there are, and their values pooled: frames of one rollout resemble
    each other, so that drawing single frames would promise more than they can hold. Empty groups count for nothing. One group
    says nothing about the spread between groups: with fewer than two the interval is (NaN, NaN). With a handful of groups
    percentile intervals are too narrow. The same seed gives the same interval.

    Args:
        groups: values (n,) each, of one rollout.
        statistic: of pooled values (n,), n > 0.
        level: share of the resamples inside.

    Raises:
        ValueError: ``resamples`` < 1, or ``level`` is not between 0 and 1.
    """
    if resamples < 1 or not 0.0 < level < 1.0:
        raise ValueError(f"bootstrap: resamples is {resamples}, level {level}; give resamples >= 1 and 0 < level < 1")
    filled = [np.asarray(group, dtype=np.float64) for group in groups if len(group)]
    if len(filled) < 2:
        return float("nan"), float("nan")
    drawn = np.random.default_rng(seed).integers(len(filled), size=(resamples, len(filled)))
    values = [statistic(np.concatenate([filled[index] for index in row])) for row in drawn]
    low, high = np.quantile(values, (0.5 - 0.5 * level, 0.5 + 0.5 * level))
    return float(low), float(high)

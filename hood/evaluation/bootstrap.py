"""Confidence intervals by bootstrap: how far a figure would move with other rollouts.

Frames and states of one rollout resemble each other, so rollouts are what is drawn again: drawing single frames would promise
more than they can hold. Samples of few rollouts spread too little, so intervals reach further into their tails the fewer there
are (the expanded percentile interval of Hesterberg, "What Teachers Should Know about the Bootstrap", 2015); with a handful
they are still too narrow, because the samples end at the extreme rollouts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, stdtrit

#: Chance that an interval covers what infinitely many rollouts would give.
LEVEL = 0.95
#: Draws behind an interval.
DRAWS = 2000


class Estimate(NamedTuple):
    """A measured value and the ends of its confidence interval; NaN where nothing was measured."""

    value: float
    low: float
    high: float


def interval(samples: np.ndarray, level: float = LEVEL, rollouts: int | None = None) -> tuple[float, float]:
    """Ends between which the share ``level`` of the samples lies, as much outside on either side; they may be infinite. With
    the number of ``rollouts`` behind the samples the share is as much larger as so few of them need.

    Raises:
        ValueError: no samples, or ``level`` is not between 0 and 1.
    """
    if not len(samples) or not 0.0 < level < 1.0:
        raise ValueError(f"interval: {len(samples)} draws, level {level}; give draws >= 1 and 0 < level < 1")
    if np.isnan(samples).any():
        return float("nan"), float("nan")
    outside = (1.0 - level) / 2
    if rollouts is not None and rollouts > 1:
        outside = float(ndtr(-np.sqrt(rollouts / (rollouts - 1)) * stdtrit(rollouts - 1, 1.0 - outside)))
    # No interpolation: between a number and infinity there is nothing.
    low = float(np.quantile(samples, outside, method="lower"))
    return low, float(np.quantile(samples, 1.0 - outside, method="higher"))


def pooled_interval(
    groups: Sequence[Sequence[float]],
    statistic: Callable[[np.ndarray], float],
    draws: int = DRAWS,
    seed: int = 0,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Interval (low, high) of ``statistic`` of all values, (n,) with n > 0, of ``groups``.

    ``groups`` holds the values of one rollout each. Every sample draws as many rollouts as there are, with replacement and
    whole, and pools their values; rollouts without values count for nothing. One rollout says nothing about the spread between
    rollouts: with fewer than two the interval is (NaN, NaN). The same seed gives the same interval.
    """
    filled = _filled(groups)
    if len(filled) < 2:
        return float("nan"), float("nan")
    drawn = np.random.default_rng(seed).integers(len(filled), size=(draws, len(filled)))
    samples = np.array([statistic(np.concatenate([filled[index] for index in row])) for row in drawn])
    return interval(samples, level, len(filled))


def resample_rows(groups: Sequence[Sequence[float]], quantile: float, draws: int = DRAWS, seed: int = 0) -> np.ndarray:
    """``quantile`` (0 to 1) of the values in each of ``draws`` bootstrap samples, (draws,).

    ``groups`` holds the values of one rollout each. Every sample draws as many rollouts as there are, with replacement, and
    from each of them as many states as it has: a single rollout has an interval too, of its states alone. Samples depend on the
    seed and on the numbers of values alone: settings measured on the same rollouts are drawn alike, and what these rollouts
    have in common cancels where such settings are compared; a rollout without values keeps its place. NaN without values.
    """
    sizes = np.array([len(group) for group in groups], dtype=int)
    if not sizes.sum():
        return np.full(draws, np.nan)
    table = np.full((len(groups), sizes.max()), np.nan)
    for row, group in zip(table, groups, strict=True):
        row[: len(group)] = group
    random = np.random.default_rng(seed)
    rollouts = random.integers(len(groups), size=(draws, len(groups)))
    places = random.random((draws, len(groups), table.shape[1]))
    drawn_sizes = sizes[rollouts][:, :, None]
    values = table[rollouts[:, :, None], (places * drawn_sizes).astype(int)]
    values[np.broadcast_to(np.arange(table.shape[1]) >= drawn_sizes, values.shape)] = np.nan
    found = _quantiles(values.reshape(draws, -1), quantile)
    # A draw of nothing but rollouts without values says nothing: all values stand in.
    known = table[~np.isnan(table)]
    return np.where(np.isnan(found), np.quantile(known, quantile) if len(known) else np.nan, found)


def estimate_interval(groups: Sequence[Sequence[float]], quantile: float, samples: np.ndarray | None = None) -> Estimate:
    """``quantile`` of all values with its interval; ``samples`` are those of :func:`resample_rows` if they are there."""
    filled = _filled(groups)
    if not filled:
        return Estimate(np.nan, np.nan, np.nan)
    samples = resample_rows(groups, quantile) if samples is None else samples
    return Estimate(float(np.quantile(np.concatenate(filled), quantile)), *interval(samples, rollouts=len(filled)))


def _filled(groups: Sequence[Sequence[float]]) -> list[np.ndarray]:
    return [np.asarray(group, dtype=np.float64) for group in groups if len(group)]


def _quantiles(values: np.ndarray, quantile: float) -> np.ndarray:
    """Quantile of every row, NaN passed over; NaN for rows without a number."""
    values = np.sort(values, axis=1)
    place = quantile * ((~np.isnan(values)).sum(axis=1) - 1).clip(0)
    below, above = np.floor(place).astype(int), np.ceil(place).astype(int)
    rows = np.arange(len(values))
    low, high = values[rows, below], values[rows, above]
    return np.where(below == above, low, low + (place - below) * (high - low))

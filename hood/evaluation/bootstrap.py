"""Confidence intervals of quantiles over rollouts: rollouts are drawn again, then states within each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hood.evaluation.interval import LEVEL

#: Draws behind an interval.
DRAWS = 2000


class Estimate(NamedTuple):
    """A measured value and the ends of its confidence interval; NaN where nothing was measured."""

    value: float
    low: float
    high: float


def resample(groups: Sequence[Sequence[float]], level: float, draws: int = DRAWS, seed: int = 0) -> np.ndarray:
    """Quantile ``level`` of ``draws`` bootstrap samples, (draws,).

    ``groups`` holds the values of one rollout each. States of one rollout resemble each other, so every sample draws as many
    rollouts as there are, with replacement, and from each of them as many states as it has. Samples depend on the seed and on
    the numbers of values alone: settings measured on the same rollouts are drawn alike, and what these rollouts have in common
    cancels where such settings are compared. NaN throughout without values.
    """
    filled = [np.asarray(group, dtype=float) for group in groups if len(group)]
    if not filled:
        return np.full(draws, np.nan)
    sizes = np.array([len(group) for group in filled])
    table = np.full((len(filled), sizes.max()), np.nan)
    for row, group in zip(table, filled, strict=True):
        row[: len(group)] = group
    random = np.random.default_rng(seed)
    rollouts = random.integers(len(filled), size=(draws, len(filled)))
    places = random.random((draws, len(filled), table.shape[1]))
    drawn_sizes = sizes[rollouts][:, :, None]
    values = table[rollouts[:, :, None], (places * drawn_sizes).astype(int)]
    values[np.broadcast_to(np.arange(table.shape[1]) >= drawn_sizes, values.shape)] = np.nan
    return _quantiles(values.reshape(draws, -1), level)


def estimate(groups: Sequence[Sequence[float]], level: float, samples: np.ndarray | None = None) -> Estimate:
    """Quantile ``level`` of all values with its interval; ``samples`` are those of :func:`resample` if they are there."""
    values = np.concatenate([np.asarray(group, dtype=float) for group in groups]) if len(groups) else np.empty(0)
    if not len(values):
        return Estimate(np.nan, np.nan, np.nan)
    samples = resample(groups, level) if samples is None else samples
    return Estimate(float(np.quantile(values, level)), *interval(samples))


def interval(samples: np.ndarray, level: float = LEVEL) -> tuple[float, float]:
    """Ends between which the share ``level`` of the samples lies, as much outside on either side; they may be infinite."""
    if np.isnan(samples).any():
        return float("nan"), float("nan")
    outside = (1.0 - level) / 2
    # No interpolation: between a number and infinity there is nothing.
    low = float(np.quantile(samples, outside, method="lower"))
    return low, float(np.quantile(samples, 1.0 - outside, method="higher"))


def _quantiles(values: np.ndarray, level: float) -> np.ndarray:
    """Quantile of every row, NaN passed over; rows hold at least one number."""
    values = np.sort(values, axis=1)
    place = level * (np.isfinite(values) | np.isinf(values)).sum(axis=1).clip(1) - level
    below = np.floor(place).astype(int)
    above = np.ceil(place).astype(int)
    rows = np.arange(len(values))
    low, high = values[rows, below], values[rows, above]
    return np.where(below == above, low, low + (place - below) * (high - low))

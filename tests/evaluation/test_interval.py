"""Intervals over groups: known distributions, groups that must not be torn apart, and too little to say anything."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hood.evaluation.interval import bootstrap_interval


def test_the_mean_of_a_normal_distribution() -> None:
    """Width 2 · 1.96 σ/√n for independent values, each a group of its own."""
    values = np.random.default_rng(0).normal(3.0, 2.0, 100)
    low, high = bootstrap_interval([np.array([value]) for value in values], np.mean, resamples=2000)
    assert high - low == pytest.approx(2 * 1.96 * 2.0 / math.sqrt(100), rel=0.15)
    assert low < values.mean() < high


def test_it_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(100):
        groups = [rng.normal(rng.normal(), 0.1, 5) for _ in range(20)]
        low, high = bootstrap_interval(groups, np.mean, resamples=100, level=0.8)
        covered += low <= 0.0 <= high
    assert 0.65 <= covered / 100 <= 0.9


def test_groups_are_drawn_whole() -> None:
    """Copies of a value inside its group add no knowledge."""
    values = np.random.default_rng(2).normal(size=20)
    single = bootstrap_interval([np.array([value]) for value in values], np.mean)
    copied = bootstrap_interval([np.full(50, value) for value in values], np.mean)
    assert copied == pytest.approx(single)


def test_pooled_values_weigh_by_their_number() -> None:
    """Two groups: the extremes are each of them alone, drawn twice."""
    groups = [np.array([0.0, 0.0, 0.0]), np.array([4.0])]
    assert bootstrap_interval(groups, np.mean) == (0.0, 4.0)
    assert bootstrap_interval(groups, np.mean, level=0.2) == (1.0, 1.0)


def test_one_group_says_nothing() -> None:
    for groups in ([], [np.arange(9.0)], [np.arange(9.0), np.array([])]):
        assert all(math.isnan(end) for end in bootstrap_interval(groups, np.mean))


def test_seed_and_settings() -> None:
    groups = [np.random.default_rng(i).normal(size=3) for i in range(8)]
    assert bootstrap_interval(groups, np.median) == bootstrap_interval(groups, np.median)
    assert bootstrap_interval(groups, np.mean) != bootstrap_interval(groups, np.mean, seed=1)
    with pytest.raises(ValueError, match="level 1.5"):
        bootstrap_interval(groups, np.mean, level=1.5)
    with pytest.raises(ValueError, match="resamples is 0"):
        bootstrap_interval(groups, np.mean, resamples=0)

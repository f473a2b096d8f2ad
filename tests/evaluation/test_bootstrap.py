"""Bootstrap intervals: they cover what they claim, know that states of a rollout are alike, and repeat."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hood.evaluation.bootstrap import Estimate, estimate_interval, interval, pooled_interval, resample_rows


def test_the_interval_covers_the_true_median_as_often_as_it_says() -> None:
    random = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        found = estimate_interval(random.normal(5.0, 2.0, size=(40, 1)).tolist(), 0.5, None)
        hits += found.low <= 5.0 <= found.high
    # 95% of 200; five standard deviations of a binomial either way, and percentile intervals of 40 values are a little narrow.
    assert 172 <= hits <= 199


def test_its_width_is_that_of_the_normal_distribution() -> None:
    """The median's standard error is 1.2533 σ / √n."""
    found = estimate_interval(np.random.default_rng(0).normal(size=(400, 1)).tolist(), 0.5)
    assert found.high - found.low == pytest.approx(2 * 1.96 * 1.2533 / 20, rel=0.25)


def test_states_of_one_rollout_do_not_count_as_if_they_were_independent() -> None:
    random = np.random.default_rng(1)
    places = random.normal(size=12)
    alike = [[place] * 20 for place in places]
    few, many = estimate_interval([[place] for place in places], 0.5), estimate_interval(alike, 0.5)
    assert (many.low, many.high) == (few.low, few.high)
    mixed = random.permutation(np.repeat(places, 20)).reshape(12, 20)
    independent = estimate_interval(mixed.tolist(), 0.5)
    assert independent.value == many.value
    assert many.high - many.low > 1.3 * (independent.high - independent.low)


def test_the_value_is_the_quantile_of_everything_unclamped() -> None:
    groups = [[-3.0, 1.0], [2.0], [-5.0, 7.0, 0.5]]
    assert estimate_interval(groups, 0.5).value == np.quantile([-3, 1, 2, -5, 7, 0.5], 0.5)
    assert estimate_interval(groups, 0.95).value == np.quantile([-3, 1, 2, -5, 7, 0.5], 0.95)
    assert estimate_interval(groups, 0.5).low < 0


def test_rollouts_of_different_lengths_are_drawn_with_their_own_states() -> None:
    groups = [[1.0], [2.0, 2.0, 2.0], [], [3.0]]
    draws = resample_rows(groups, 0.5, draws=400)
    assert set(draws) <= {1.0, 1.5, 2.0, 2.5, 3.0}
    # One state of the first rollout in a draw of three from it alone, not three padded ones.
    assert np.isfinite(draws).all()
    assert (draws == 1.0).any()
    assert (draws == 3.0).any()


def test_a_rollout_without_values_keeps_its_place() -> None:
    whole, gap = [[1.0], [2.0], [3.0], [4.0]], [[1.0], [], [3.0], [4.0]]
    random = np.random.default_rng(0)
    drawn = random.integers(4, size=(2000, 4))
    np.testing.assert_array_equal(resample_rows(whole, 1.0), (drawn + 1.0).max(axis=1))
    expected = np.where(drawn == 1, 0.0, drawn + 1.0).max(axis=1)
    np.testing.assert_array_equal(resample_rows(gap, 1.0), np.where(expected == 0.0, 4.0, expected))


def test_few_rollouts_widen_the_interval() -> None:
    samples = np.random.default_rng(0).normal(size=20000)
    widths = [np.diff(interval(samples, 0.9, rollouts))[0] for rollouts in (None, 1000, 12, 6)]
    assert widths[0] == pytest.approx(widths[1], rel=0.01)
    # √(n / (n − 1)) times the ratio of Student's quantile to the normal one.
    assert widths[2] / widths[0] == pytest.approx(np.sqrt(12 / 11) * 1.796 / 1.645, rel=0.03)
    assert widths[3] / widths[0] == pytest.approx(np.sqrt(6 / 5) * 2.015 / 1.645, rel=0.03)


@pytest.mark.parametrize("level", [0.0, 0.37, 0.5, 0.95, 1.0])
def test_quantiles_are_those_of_numpy(level: float) -> None:
    values = np.random.default_rng(0).normal(size=9)
    # One rollout is drawn every time, so draws differ in their states alone: all are quantiles of values that occur.
    draws = resample_rows([values.tolist()], level, draws=50, seed=4)
    random = np.random.default_rng(4)
    random.integers(1, size=(50, 1))
    places = (random.random((50, 1, 9)) * 9).astype(int)[:, 0]
    np.testing.assert_allclose(draws, np.quantile(values[places], level, axis=1), rtol=1e-12)


def test_settings_on_the_same_rollouts_are_drawn_alike() -> None:
    """What rollouts have in common cancels: the difference of two settings is known far better than each of them."""
    scenes = np.random.default_rng(0).normal(size=(10, 5))
    one, other = resample_rows(scenes.tolist(), 0.5), resample_rows((scenes + 0.01).tolist(), 0.5)
    assert np.ptp(one) > 0.5
    np.testing.assert_allclose(other - one, 0.01, atol=1e-12)


def test_nothing_measured_is_nan_and_infinity_survives() -> None:
    assert all(np.isnan(estimate_interval([], 0.5)))
    assert all(np.isnan(estimate_interval([[], []], 0.5)))
    assert isinstance(estimate_interval([[1.0]], 0.5), Estimate)
    assert interval(np.array([1.0] * 50 + [np.inf] * 50)) == (1.0, np.inf)


def test_the_pooled_mean_of_a_normal_distribution() -> None:
    """Width 2 · 1.96 σ/√n for independent values, each a group of its own."""
    values = np.random.default_rng(0).normal(3.0, 2.0, 100)
    low, high = pooled_interval([[value] for value in values], np.mean, draws=2000)
    assert high - low == pytest.approx(2 * 1.96 * 2.0 / math.sqrt(100), rel=0.15)
    assert low < values.mean() < high


def test_the_pooled_interval_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(100):
        groups = [rng.normal(rng.normal(), 0.1, 5).tolist() for _ in range(20)]
        low, high = pooled_interval(groups, np.mean, draws=100, level=0.8)
        covered += low <= 0.0 <= high
    assert 0.65 <= covered / 100 <= 0.9


def test_groups_are_drawn_whole() -> None:
    """Copies of a value inside its group add no knowledge."""
    values = np.random.default_rng(2).normal(size=20)
    single = pooled_interval([[value] for value in values], np.mean)
    copied = pooled_interval([[value] * 50 for value in values], np.mean)
    assert copied == pytest.approx(single)


def test_pooled_values_weigh_by_their_number() -> None:
    """Two groups: the extremes are each of them alone, drawn twice."""
    groups = [[0.0, 0.0, 0.0], [4.0]]
    assert pooled_interval(groups, np.mean) == (0.0, 4.0)
    assert pooled_interval(groups, np.mean, level=0.2) == (1.0, 1.0)


def test_one_group_has_no_pooled_interval() -> None:
    for groups in ([], [[1.0, 2.0, 3.0]], [[1.0, 2.0, 3.0], []]):
        assert all(math.isnan(end) for end in pooled_interval(groups, np.mean))


def test_the_seed_decides_and_wrong_settings_are_refused() -> None:
    groups = [np.random.default_rng(i).normal(size=3).tolist() for i in range(8)]
    assert pooled_interval(groups, np.median) == pooled_interval(groups, np.median)
    assert pooled_interval(groups, np.mean) != pooled_interval(groups, np.mean, seed=1)
    with pytest.raises(ValueError, match="level 1.5"):
        pooled_interval(groups, np.mean, level=1.5)
    with pytest.raises(ValueError, match="0 draws"):
        pooled_interval(groups, np.mean, draws=0)

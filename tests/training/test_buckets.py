"""Garments by size: even batches, fair turns, nothing that depends on the number of processes."""

from __future__ import annotations

from collections import Counter

import pytest

from hood.training.slots import Bucket, make_buckets, next_bucket

SIZES = [1014, 4476, 981, 11935, 4393, 1026, 1003]


def test_without_a_budget_all_garments_share_one_batch() -> None:
    assert make_buckets(SIZES, 3) == [Bucket(tuple(range(7)), 0, 3)]


def test_a_batch_holds_similar_sizes_and_as_many_as_fit() -> None:
    buckets = make_buckets(SIZES, 1, 16_000)
    assert [b.templates for b in buckets] == [(0, 2, 5, 6), (1, 4), (3,)]
    assert [b.count for b in buckets] == [15, 3, 1]
    assert [b.first for b in buckets] == [0, 15, 18]
    for bucket in buckets:
        sizes = [SIZES[i] for i in bucket.templates]
        assert max(sizes) <= 1.5 * min(sizes)
        assert 0.5 * 16_000 < bucket.count * max(sizes) <= 16_000


@pytest.mark.parametrize("batch_size", [2, 3, 4])
def test_counts_are_multiples_of_the_batch_size(batch_size: int) -> None:
    buckets = make_buckets(SIZES[:3], batch_size, 19_000)
    assert all(bucket.count % batch_size == 0 and bucket.count > 0 for bucket in buckets)


def test_a_budget_that_is_too_small_is_refused() -> None:
    with pytest.raises(ValueError, match=r"trainer.max_vertices=20000: 2 scenes.*11935 vertices, are 23870"):
        make_buckets(SIZES, 2, 20_000)


def test_every_template_has_the_same_weight_in_the_expected_gradient() -> None:
    """An update's loss is a mean over its scenes, so a template's weight is the sum of its shares of all updates."""
    buckets = make_buckets(SIZES, 1, 16_000)
    turns, weight = [0] * len(buckets), Counter[int]()
    for _ in range(7 * 60):
        number = next_bucket(buckets, turns)
        bucket = buckets[number]
        for place in range(bucket.count):
            weight[bucket.template(place, turns[number])] += 1 / bucket.count
        turns[number] += 1
    assert turns == [4 * 60, 2 * 60, 60]
    assert min(weight.values()) == pytest.approx(60, rel=0.05)
    assert max(weight.values()) == pytest.approx(60, rel=0.05)


def test_no_bucket_waits_long() -> None:
    buckets, turns, last = make_buckets(SIZES, 1, 16_000), [0, 0, 0], [0, 0, 0]
    for update in range(1, 70):
        number = next_bucket(buckets, turns)
        assert update - last[number] <= 8
        turns[number] += 1
        last[number] = update

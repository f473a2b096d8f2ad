"""In how many parts loops are done."""

from __future__ import annotations

import pytest

from hood.native import arguments
from hood.native.arguments import MOST_PARTS, num_parts


@pytest.mark.parametrize(
    ("count", "threads_of_torch", "expected"), [(999, 4, 1), (1000, 4, 2), (10_000, 4, 4), (10_000, 1, 1), (0, 4, 1)]
)
def test_every_thread_has_enough_to_do(monkeypatch, count, threads_of_torch, expected):
    monkeypatch.setattr(arguments.torch, "get_num_threads", lambda: threads_of_torch)
    assert num_parts(count, 500) == expected


def test_there_is_a_most_as_in_the_source(monkeypatch):
    source = (arguments.SOURCE).read_text()
    assert f"constexpr int64_t MOST_PARTS = {MOST_PARTS};" in source
    monkeypatch.setattr(arguments.torch, "get_num_threads", lambda: 1000)
    assert num_parts(10**6, 1) == MOST_PARTS

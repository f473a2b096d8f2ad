"""What counts as part of a frame, and what is set aside."""

from __future__ import annotations

import pytest

from hood.steppers.protocol import Stopwatch, timed


class Clock:
    """Seconds that pass by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_parts_rest_and_total_leave_out_what_was_set_aside() -> None:
    clock = Clock()
    watch = Stopwatch(clock)
    for _ in range(2):
        with watch.part("search"):
            clock.now += 0.003
    clock.now += 0.001
    with watch.aside("metrics"):
        clock.now += 0.5
    with watch.aside("caller"):
        clock.now += 5.0
    with timed(watch, "network"):
        clock.now += 0.04
    assert watch.spent_aside("metrics") == pytest.approx(500.0)
    assert watch.spent_aside("nothing") == 0.0
    lap = watch.lap()
    assert lap == pytest.approx({"search": 6.0, "network": 40.0, "rest": 1.0, "total": 47.0})
    assert watch.spent_aside("metrics") == 0.0


def test_a_lap_begins_where_the_last_one_ended() -> None:
    clock = Clock()
    watch = Stopwatch(clock)
    watch.lap()
    clock.now += 0.002
    assert watch.lap() == pytest.approx({"rest": 2.0, "total": 2.0})
    with timed(None, "search"):
        clock.now += 1.0
    assert watch.lap()["total"] == pytest.approx(1000.0)


def test_elapsed_is_the_frame_so_far() -> None:
    clock = Clock()
    watch = Stopwatch(clock)
    with watch.part("search"):
        clock.now += 0.004
        assert watch.elapsed() == pytest.approx(4.0)
    with watch.aside("caller"):
        clock.now += 1.0
    clock.now += 0.001
    assert watch.elapsed() == pytest.approx(5.0)
    assert watch.lap()["total"] == pytest.approx(5.0)
    assert watch.elapsed() == pytest.approx(0.0)

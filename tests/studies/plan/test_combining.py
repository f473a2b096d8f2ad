"""Combinations: what is expected orders them, what is measured decides."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hood.studies.plan.decide import MOST_TRIED, Combination, Option, cheapest, combinations, most_accurate

OPTIONS = [Option("coarse", "mesh", 4.0, 0.25), Option("rough", "steps", 1.0, 0.8), Option("limp", "", 2.0, 0.9),
           Option("coarser", "mesh", 9.0, 0.1)]  # fmt: skip
KNOWN = combinations(OPTIONS, 100.0)


def as_expected(times: float = 1.0) -> Callable[[tuple[str, ...]], Combination]:
    table = {one.names: one for one in KNOWN}
    return lambda names: Combination(names, table[names].mm, times * table[names].ms)


def test_options_of_one_axis_exclude_each_other() -> None:
    assert len(KNOWN) == 3 * 2 * 2
    assert KNOWN[0] == Combination((), 0.0, 100.0)
    assert not any({"coarse", "coarser"} <= set(one.names) for one in KNOWN)
    (one,) = [one for one in KNOWN if one.names == ("coarse", "limp", "rough")]
    assert (one.mm, one.ms) == (7.0, pytest.approx(18.0))


def test_the_cheapest_that_is_near_enough_is_chosen() -> None:
    assert cheapest(KNOWN, 5.0, as_expected()).chosen.names == ("coarse", "rough")
    assert cheapest(KNOWN, 0.5, as_expected()).chosen == KNOWN[0]
    assert cheapest(KNOWN, 100.0, as_expected()).chosen.names == ("coarser", "limp", "rough")


def test_what_is_measured_decides_not_what_was_expected() -> None:
    def farther(names: tuple[str, ...]) -> Combination:
        found = as_expected()(names)
        return Combination(names, found.mm + (3.0 if "coarse" in names else 0.0), found.ms)

    found = cheapest(KNOWN, 5.0, farther)
    assert found.chosen.names == ("limp", "rough")
    assert [one.names for one in found.tried] == [("coarse", "rough"), ("coarse",), ("limp", "rough")]


def test_what_hardly_saves_time_as_a_whole_is_not_taken() -> None:
    found = cheapest(KNOWN, 5.0, lambda names: Combination(names, 0.1, 98.0))
    assert (found.chosen, found.fits) == (KNOWN[0], True)
    assert len(found.tried) == MOST_TRIED


def test_of_those_in_time_the_most_accurate_is_chosen() -> None:
    assert most_accurate(KNOWN, 95.0, as_expected()).chosen.names == ("rough",)
    assert most_accurate(KNOWN, 30.0, as_expected()).chosen.names == ("coarse",)
    found = most_accurate(KNOWN, 200.0, as_expected())
    assert (found.chosen, found.fits, found.tried) == (KNOWN[0], True, ())


def test_slower_than_expected_is_expected_of_the_rest_too() -> None:
    found = most_accurate(KNOWN, 30.0, as_expected(1.3))
    assert found.fits
    assert [one.names for one in found.tried] == [("coarse",), ("coarse", "rough")]
    assert found.chosen.ms == pytest.approx(26.0)


def test_where_nothing_fits_the_fastest_is_named() -> None:
    found = most_accurate(KNOWN, 1.0, as_expected())
    assert not found.fits
    assert found.chosen.names == ("coarser", "limp", "rough")
    assert len(found.tried) == 1
    slow = most_accurate(KNOWN, 85.0, as_expected(50.0))
    assert not slow.fits
    assert slow.chosen == KNOWN[0]
    assert len(slow.tried) <= MOST_TRIED

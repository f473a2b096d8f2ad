"""Which combination of simplifications a rollout is done with: the cheapest for an accuracy, the most accurate for a time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from hood.evaluation.decision import LEAST_SAVING

#: Combinations that are run against the full model at most; each costs two windows.
MOST_TRIED = 4


@dataclass(frozen=True)
class Option:
    """A simplification, as measured alone.

    Args:
        axis: of options with the same one at most one is taken; "" where it goes with all.
        mm: from the full model.
        cost: its time as a share of the full model's.
    """

    name: str
    axis: str
    mm: float
    cost: float


@dataclass(frozen=True)
class Combination:
    """Options taken together: what is expected of them, or was measured; no options are the full model.

    Args:
        half_mm, mm: median and 95th percentile of the points, from the full model; expected: the sum.
        ms: of a frame; expected: the product of the shares.
    """

    names: tuple[str, ...]
    mm: float
    ms: float
    half_mm: float = 0.0


@dataclass(frozen=True)
class Search:
    """What a search found.

    Args:
        chosen: as measured.
        fits: whether it meets what was asked for; where not, nothing does, and it is the nearest.
        tried: every combination that was measured.
    """

    chosen: Combination
    fits: bool
    tried: tuple[Combination, ...]


def combinations(options: Sequence[Option], full_ms: float) -> list[Combination]:
    """All of them, the full model first, with what is expected of each."""
    axes = [[None, *(one for one in options if one.axis == axis)] for axis in sorted({one.axis for one in options} - {""})]
    axes += [[None, one] for one in options if not one.axis]
    found = []
    for picked in itertools.product(*axes):
        taken = [one for one in picked if one is not None]
        mm, share = math.fsum(one.mm for one in taken), math.prod(one.cost for one in taken)
        found.append(Combination(tuple(sorted(one.name for one in taken)), mm, share * full_ms))
    return sorted(found, key=lambda one: len(one.names))


def cheapest(known: Sequence[Combination], limit_mm: float, measure: Callable[[tuple[str, ...]], Combination]) -> Search:
    """The cheapest combination that is at most ``limit_mm`` from the full model, by what is expected of them, and measured.

    The full model, which is always among them, meets every limit. What is run as a whole has to save as much as a part has to.
    """
    full = known[0]
    order = sorted((one for one in known if one.mm <= limit_mm and one.ms <= full.ms), key=lambda one: (one.ms, one.mm))
    tried: list[Combination] = []
    for expected in order:
        if not expected.names or len(tried) == MOST_TRIED:
            break
        tried.append(measure(expected.names))
        if tried[-1].mm <= limit_mm and tried[-1].ms <= (1.0 - LEAST_SAVING) * full.ms:
            return Search(tried[-1], True, tuple(tried))
    return Search(full, True, tuple(tried))


def most_accurate(known: Sequence[Combination], budget_ms: float, measure: Callable[[tuple[str, ...]], Combination]) -> Search:
    """The combination nearest to the full model whose measured time is at most ``budget_ms``; the fastest where none is.

    Where one turns out slower than expected, all that are not measured yet are expected to be slower by as much.
    """
    full = known[0]
    if full.ms <= budget_ms:
        return Search(full, True, ())
    tried: list[Combination] = []
    left, slower = list(known[1:]), 1.0
    while left and len(tried) < MOST_TRIED:
        fitting = [one for one in left if slower * one.ms <= budget_ms]
        if fitting and len(tried) + 1 < MOST_TRIED:
            expected = min(fitting, key=lambda one: (one.mm, one.ms))
        else:
            expected = min(left, key=lambda one: (one.ms, one.mm))
        left.remove(expected)
        tried.append(measure(expected.names))
        if tried[-1].ms <= budget_ms:
            return Search(tried[-1], True, tuple(tried))
        if not fitting and tried[-1].ms < full.ms:
            break
        slower = max(slower, tried[-1].ms / expected.ms)
    return Search(min([full, *tried], key=lambda one: one.ms), False, tuple(tried))

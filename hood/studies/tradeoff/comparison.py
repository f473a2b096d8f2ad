"""Settings compared: the Pareto front, network and solver at equal accuracy and at equal time, and where one gives way.

A verdict is given only where confidence intervals leave no doubt; everything else is called open.

The results behind a chart of time against accuracy.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hood.evaluation.bootstrap import LEVEL, Estimate, interval
from hood.evaluation.table import NEWTON
from hood.studies.tradeoff.grid import Point
from hood.studies.tradeoff.results import Reached

NETWORK, SOLVER, REFINED, OPEN = "network", "solver", "refined", "open"
#: Fewer rollouts than these do not tell how far rollouts differ: no verdict.
LEAST_ROLLOUTS = 6
#: Strain within this multiple of the converged solver's is its strain: rollouts that differ a little fold otherwise.
_LIKE_THE_SOLVER = 1.05
#: γ below this is compared as if it were this: minima are not known more exactly, nor is anything gained.
RESOLUTION = 1e-4
#: A setting whose γ is not surely below this is no choice, however fast: √0.3 is half of free fall.
USEFUL = 0.3


def pareto_front(reached: Sequence[Reached], rejected: Collection[Point] = ()) -> list[Reached]:
    """Those that no other one beats in time and in gap, cheapest first; ``rejected`` ones stand outside."""
    front: list[Reached] = []
    for item in sorted((r for r in reached if r.charted and r.point not in rejected), key=lambda r: (r.ms.value, r.gap.value)):
        if not front or item.gap.value < front[-1].gap.value:
            front.append(item)
    return front


@dataclass(frozen=True)
class AtEqualGap:
    """The solver alone made as accurate as a network's setting: ``ratio`` is its time over that of the setting.

    ``low`` is the bound that a verdict for the network needs and ``high`` the one for the solver: where the solver was not
    measured as inaccurate or as accurate as the setting, its time there is bounded on one side only. The draws (n, 2) are those
    bounds in every sample of the bootstrap.
    """

    reached: Reached
    low: float
    high: float
    ratio: float | None  # None: bounded on one side only
    verdict: str
    draws: np.ndarray = field(default_factory=lambda: np.empty((0, 2)), repr=False, compare=False)


class _Bounds(NamedTuple):
    low: float
    high: float


def at_equal_gap(item: Reached, alone: Sequence[Reached], level: float = LEVEL) -> AtEqualGap | None:
    """``item`` against the measured settings of the solver ``alone`` of the same size; None where nothing can be compared.

    Between two settings of the solver its time follows a straight line in the log–log chart; all that is below
    :data:`RESOLUTION` is equally accurate.
    """
    alone = [other for other in alone if other.charted]
    if not item.charted or not alone:
        return None
    times = np.stack([other.ms_draws for other in alone])
    gaps = np.stack([other.gap_draws for other in alone])
    bounds = np.array(
        [_ratio(*draw) for draw in zip(item.ms_draws, item.gap_draws, times.T, gaps.T, strict=True)],
    )
    here = _ratio(item.ms.value, item.gap.value, np.array([o.ms.value for o in alone]), np.array([o.gap.value for o in alone]))
    rollouts = min(one.rollouts for one in (item, *alone))
    low, high = interval(bounds[:, 0], level, rollouts)[0], interval(bounds[:, 1], level, rollouts)[1]
    verdict = NETWORK if low > 1.0 else SOLVER if high < 1.0 else OPEN
    verdict = verdict if rollouts >= LEAST_ROLLOUTS else OPEN
    return AtEqualGap(item, low, high, here.low if here.low == here.high else None, verdict, bounds)


def _ratio(ms: float, gap: float, times: np.ndarray, gaps: np.ndarray) -> _Bounds:
    """Bounds of the time the solver needs for ``gap``, over ``ms``."""
    last: tuple[float, float] | None = None  # the most accurate setting so far that is not accurate enough
    gap = max(gap, RESOLUTION)
    for time, reached in sorted(zip(times.tolist(), np.maximum(gaps, RESOLUTION).tolist(), strict=True)):
        if reached <= gap:
            if last is None:
                return _Bounds(0.0, time / ms)
            share = math.log(last[1] / gap) / math.log(last[1] / reached)
            time = last[0] * (time / last[0]) ** share
            return _Bounds(time / ms, time / ms)
        if last is None or reached < last[1]:
            last = time, reached
    assert last is not None
    return _Bounds(last[0] / ms, math.inf)


@dataclass(frozen=True)
class AtEqualTime:
    """A refined network beside the most accurate network alone that takes no longer; ``gain`` = γ alone − γ refined."""

    reached: Reached
    best: Reached
    gain: Estimate
    verdict: str


def at_equal_time(item: Reached, networks: Sequence[Reached]) -> AtEqualTime | None:
    """``item`` against networks that are not refined, of the same size; None where none takes as little time and its own
    was not measured."""
    networks = [other for other in networks if other.charted]
    # Its own network takes no longer, whatever the noise says.
    cheaper = [o for o in networks if o.ms.value <= item.ms.value or _same_network(o.point, item.point)]
    if not item.charted or not cheaper:
        return None
    best = min(cheaper, key=lambda other: other.gap.value)
    times = np.stack([other.ms_draws for other in networks])
    gaps = np.stack([other.gap_draws for other in networks])
    own = np.array([_same_network(other.point, item.point) for other in networks])
    fits = (times <= item.ms_draws) | own[:, None] | np.array([other is best for other in networks])[:, None]
    draws = np.where(fits, gaps, np.inf).min(axis=0) - item.gap_draws
    rollouts = min(one.rollouts for one in (item, *networks))
    gain = Estimate(best.gap.value - item.gap.value, *interval(draws, rollouts=rollouts))
    verdict = REFINED if gain.low > 0.0 else NETWORK if gain.high < 0.0 else OPEN
    verdict = verdict if rollouts >= LEAST_ROLLOUTS else OPEN
    return AtEqualTime(item, best, gain, verdict)


@dataclass(frozen=True)
class _Refined:
    """A refined network beside the same one alone, rollout by rollout.

    Args:
        stretched: rollouts in which refinement raised the p99 strain.
        deeper: rollouts in which it raised the share of vertices deeper than 2 mm.
    """

    reached: Reached
    plain: Reached
    stretched: int
    deeper: int

    solver: float  # p99 strain of the converged solver at that size; NaN where it was not measured

    @property
    def worse(self) -> bool:
        """Whether the median p99 strain is higher than without refinement and not that of the solver either, which refinement
        leads to, or the penetration of the median rollout is higher; breakdowns are infinite."""
        here, there = (
            np.inf if one.failures else np.nan_to_num(one.strain_p99, nan=np.inf) for one in (self.reached, self.plain)
        )
        stretched = here > there and not here <= _LIKE_THE_SOLVER * self.solver
        return bool(stretched or np.median(self.reached.penetrations) > np.median(self.plain.penetrations))


def refined_networks(reached: Sequence[Reached]) -> list[_Refined]:
    """Every refined network whose network alone was measured at that size as well."""
    solver = {item.point.size: item.strain_p99 for item in reached if item.point.model == NEWTON}
    plain = {(i.point.model, i.point.precision, i.point.size): i for i in reached if not i.point.alone and not i.point.refine}
    found = []
    for item in (item for item in reached if not item.point.alone and item.point.refine):
        own = plain.get((item.point.model, item.point.precision, item.point.size))
        if own is not None:
            both = (item.strains, own.strains), (item.penetrations, own.penetrations)
            stretched, deeper = (sum(here > there for here, there in zip(*pair, strict=False)) for pair in both)
            found.append(_Refined(item, own, stretched, deeper, solver.get(item.point.size, float("nan"))))
    return found


def _same_network(one: Point, other: Point) -> bool:
    return (one.model, one.precision, one.size) == (other.model, other.precision, other.size)


@dataclass(frozen=True)
class SizeVerdict:
    """Who is the better choice at one size."""

    size: str
    vertices: int
    winner: str
    best: AtEqualGap | None  # the network's setting that does best beside the solver; None: none is a choice at all


def verdicts_by_size(reached: Sequence[Reached], rejected: Collection[Point] = ()) -> list[SizeVerdict]:
    """Per size, smallest first, whether a network earns its place beside the solver.

    The network does where one of its settings is faster than the solver at equal γ; the more settings are tried, the more
    likely one of them looks good by chance, so these intervals are as much wider as there are settings (Bonferroni). The solver
    does where it is faster than the best of them, whichever that is in a sample. Settings that overstretch the cloth
    (``rejected``) or are not surely below :data:`USEFUL` are no choice: where a network has none and the solver has one, the
    solver is the better choice. Sizes without networks are left out.
    """
    found = []
    for size in dict.fromkeys(item.point.size for item in reached):
        here = [item for item in reached if item.point.size == size and item.charted]
        if all(item.point.alone for item in here):
            continue
        sound = [item for item in here if item.point not in rejected]
        alone = [item for item in sound if item.point.alone]
        learned = [item for item in sound if not item.point.alone and item.gap.high <= USEFUL]
        level = 1.0 - (1.0 - LEVEL) / max(len(learned), 1)
        compared = [c for c in (at_equal_gap(item, alone, level) for item in learned) if c is not None]
        vertices = round(float(np.mean([item.vertices for item in here])))
        if not compared:
            enough = min(item.rollouts for item in here) >= LEAST_ROLLOUTS
            useful = enough and not learned and any(item.gap.high <= USEFUL for item in alone)
            found.append(SizeVerdict(size, vertices, SOLVER if useful else OPEN, None))
            continue
        best = max(compared, key=lambda c: (c.verdict == NETWORK, c.ratio if c.ratio is not None else c.low))
        won, lost = best.verdict == NETWORK, _all_lost(compared, alone)
        found.append(SizeVerdict(size, vertices, NETWORK if won else SOLVER if lost else OPEN, best))
    return sorted(found, key=lambda verdict: verdict.vertices)


def _all_lost(compared: Sequence[AtEqualGap], alone: Sequence[Reached]) -> bool:
    """Whether the solver is surely faster than the network's best setting."""
    rollouts = min(one.rollouts for one in (*(c.reached for c in compared), *alone))
    best = np.max([c.draws[:, 1] for c in compared], axis=0)
    return rollouts >= LEAST_ROLLOUTS and interval(best, rollouts=rollouts)[1] < 1.0


def crossover(found: Sequence[SizeVerdict], device: str) -> str:
    """In a sentence: from which size on a network is worth its time on this device, as far as the intervals say."""
    if not found:
        return "No network was measured, so nothing can be said about network or solver."
    won, lost, undecided = ([s for s in found if s.winner == who] for who in (NETWORK, SOLVER, OPEN))
    doubt = ""
    if undecided:
        doubt = (
            f" At {_sizes(undecided)} no claim is made: the intervals overlap, rollouts are fewer than {LEAST_ROLLOUTS}, or "
            "the solver was not measured at equal γ."
        ) + "".join(map(_undecided, undecided))
    winners = "; ".join(
        f"{s.best.reached.label} at {s.vertices:,} vertices (γ = {s.best.reached.gap.value:.2g})" for s in won if s.best
    )
    if lost and won and max(s.vertices for s in lost) < min(s.vertices for s in won):
        return (
            f"Up to {lost[-1].vertices:,} vertices on this {device} the solver alone is the better choice, from "
            f"{won[0].vertices:,} on a network that reaches the same γ in less time: {winners}.{doubt}"
        )
    if lost and won:
        return (
            f"On this {device} the solver alone is the better choice at {_sizes(lost)} and a network elsewhere ({winners}): "
            f"there is no single size at which one gives way to the other." + doubt
        )
    if lost:
        return (
            f"At {_sizes(lost)} on this {device} the solver alone is the better choice; no crossover to a network was seen."
            + doubt
        )
    if won:
        return (
            f"On this {device} a network is the better choice: {winners}. No size was seen below which the solver alone is."
            + doubt
        )
    return f"On this {device} no crossover was seen." + doubt


def _undecided(verdict: SizeVerdict) -> str:
    """What was measured where nothing is claimed."""
    best = verdict.best
    if best is None or best.ratio is None:
        return ""
    high = f"{1 / best.low:.2g}" if best.low > 0 else "∞"
    return (
        f" The network's best setting at {verdict.vertices:,} vertices, {best.reached.label}, took {1 / best.ratio:.2g} times "
        f"the solver's time ({1 / best.high:.2g} to {high})."
    )


def _sizes(found: Sequence[SizeVerdict]) -> str:
    numbers = [f"{verdict.vertices:,}" for verdict in found]
    return (numbers[0] if len(numbers) == 1 else f"{', '.join(numbers[:-1])} and {numbers[-1]}") + " vertices"


@dataclass
class Study:
    """What was measured, and what is missing.

    Args:
        rejected: settings that overstretch the cloth.
        left_out: points that gave nothing, why, and the file of their log.
        absent: models that would have been measured, had they been there.
    """

    reached: list[Reached]
    rejected: set[Point]
    left_out: list[tuple[Point, str, str]] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)

    @property
    def sizes(self) -> list[str]:
        return list(dict.fromkeys(item.point.size for item in self.reached if item.charted))

    def at(self, size: str) -> list[Reached]:
        return [item for item in self.reached if item.point.size == size]

    @property
    def device(self) -> str:
        """Where it was measured; every device, if there were several."""
        return " and ".join(dict.fromkeys(str(item.record.get("device", "unnamed device")) for item in self.reached))

    @property
    def warning(self) -> str:
        """Whether times can be trusted; empty where they can."""
        ways = {(item.record.get("device"), item.record.get("jobs")) for item in self.reached}
        text = ""
        if len(ways) > 1:
            text = (
                "The settings were not all measured on one machine with equally many side by side: comparisons of time between "
                "them do not hold. "
            )
        disturbed = [item for item in self.reached if item.disturbed]
        if not disturbed:
            return text.rstrip()
        least = min(item.record["cpu_share"] for item in disturbed)
        return text + (
            f"The machine was busy with other work: {len(disturbed)} of {len(self.reached)} settings had their processor for "
            f"only a part of the time (down to {least:.0%}), so times are too long and comparisons of time do not hold. "
            "Measure again on a machine that is free, or with fewer jobs."
        )

    @property
    def sentence(self) -> str:
        """Where a network gives way to the solver alone."""
        return crossover(verdicts_by_size(self.reached, self.rejected), self.device)

"""The front, comparisons at equal γ and at equal time, and the sentence about sizes: verdicts only where intervals allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from measured_points import reached, solver

from hood.studies.tradeoff.comparison import (
    LEAST_ROLLOUTS,
    NETWORK,
    OPEN,
    REFINED,
    RESOLUTION,
    SOLVER,
    at_equal_gap,
    at_equal_time,
    crossover,
    pareto_front,
    refined_networks,
    verdicts_by_size,
)
from hood.studies.tradeoff.results import Reached

#: γ = 100 / ms²: straight in a log–log chart.
CURVE = {k: (10.0 * k, 1.0 / k**2) for k in (1, 2, 5, 10)}


def exact(model: str, refine: int, ms: float, gap: float, **options: object) -> Reached:
    return reached(model, refine, ms, gap, noise=0.0, **options)  # type: ignore[arg-type]


def test_the_front_is_what_nothing_else_beats() -> None:
    random = np.random.default_rng(5)
    items = [exact("net", k, *random.uniform(1, 10, size=2)) for k in range(40)]
    beaten = [any(o.ms.value <= i.ms.value and o.gap.value <= i.gap.value and o is not i for o in items) for i in items]
    front = pareto_front(items)
    assert {id(item) for item in front} == {id(item) for item, worse in zip(items, beaten, strict=True) if not worse}
    assert [item.ms.value for item in front] == sorted(item.ms.value for item in front)


def test_rejected_settings_and_those_without_a_gap_are_no_part_of_the_front() -> None:
    fast, slow = exact("net", 0, 1.0, 0.5), exact("net", 1, 2.0, 0.4)
    unmeasured = exact("net", 2, 0.1, np.nan)
    assert pareto_front([fast, slow, unmeasured], {fast.point}) == [slow]


def test_negative_gaps_belong_to_the_front() -> None:
    low, negative = exact("net", 0, 1.0, 1e-6), exact("net", 1, 2.0, -1e-6)
    assert pareto_front([low, negative]) == [low, negative]


@pytest.mark.parametrize("ms, gap, ratio", [(10.0, 0.04, 5.0), (100.0, 0.04, 0.5), (30.0, 1 / 9, 1.0)])
def test_the_solver_between_its_settings_follows_a_straight_line(ms: float, gap: float, ratio: float) -> None:
    found = at_equal_gap(exact("net", 0, ms, gap), solver(CURVE, noise=0.0))
    assert found is not None
    assert found.ratio == pytest.approx(ratio)
    assert found.low == pytest.approx(ratio)
    assert found.high == pytest.approx(ratio)


def test_beyond_the_measured_settings_only_a_bound_is_known() -> None:
    alone = solver(CURVE, noise=0.0)
    crude = at_equal_gap(exact("net", 0, 5.0, 4.0), alone)
    assert crude is not None
    assert (crude.ratio, crude.low, crude.high, crude.verdict) == (None, 0.0, 2.0, OPEN)
    crude_and_slow = at_equal_gap(exact("net", 0, 20.0, 4.0), alone)
    assert crude_and_slow is not None
    assert (crude_and_slow.ratio, crude_and_slow.high, crude_and_slow.verdict) == (None, 0.5, SOLVER)
    accurate = at_equal_gap(exact("net", 9, 100.0, 0.005), alone[:-1])
    assert accurate is not None
    assert (accurate.ratio, accurate.low, accurate.high, accurate.verdict) == (None, 1.0, np.inf, OPEN)


@pytest.mark.parametrize("gap", [RESOLUTION, 1e-7, 0.0, -1.0])
def test_what_is_below_the_resolution_is_equally_accurate(gap: float) -> None:
    alone = [exact("guess", 1, 10.0, 1.0), exact("guess", 2, 20.0, -1e-9)]
    found = at_equal_gap(exact("net", 0, 10.0, gap), alone)
    assert found is not None
    assert found.ratio == pytest.approx(2.0)
    half_way = at_equal_gap(exact("net", 0, 10.0, RESOLUTION**0.5), alone)
    assert half_way is not None
    assert half_way.ratio == pytest.approx(2.0**0.5)


def test_the_solver_wins_a_size_only_if_it_beats_the_best_setting() -> None:
    slow, level = exact("net", 0, 200.0, 0.04), reached("net", 2, 50.0, 0.04, noise=0.3)
    assert verdicts_by_size([*solver(CURVE), slow])[0].winner == SOLVER
    assert verdicts_by_size([*solver(CURVE), slow, level])[0].winner == OPEN


@pytest.mark.parametrize("ms, verdict", [(20.0, NETWORK), (48.0, OPEN), (52.0, OPEN), (120.0, SOLVER)])
def test_a_verdict_needs_the_whole_interval(ms: float, verdict: str) -> None:
    found = at_equal_gap(reached("net", 0, ms, 0.04, noise=0.3), solver(CURVE, noise=0.3))
    assert found is not None
    assert found.verdict == verdict
    assert found.low <= found.high
    assert found.ratio is not None
    assert found.low < found.ratio < found.high


def test_at_equal_time_the_best_network_that_takes_no_longer_counts() -> None:
    networks = [exact("net", 0, 10.0, 0.5), exact("big", 0, 30.0, 0.1), exact("huge", 0, 90.0, 0.01)]
    found = at_equal_time(exact("net", 5, 40.0, 0.05), networks)
    assert found is not None
    assert found.best.point.model == "big"
    assert found.gain.value == pytest.approx(0.05)
    assert found.verdict == REFINED
    found = at_equal_time(exact("net", 20, 120.0, 0.05), networks)
    assert found is not None
    assert (found.best.point.model, found.verdict) == ("huge", "network")


def test_its_own_network_takes_no_longer_whatever_the_noise_says() -> None:
    found = at_equal_time(exact("net", 1, 9.9, 0.05), [exact("net", 0, 10.0, 0.5)])
    assert found is not None
    assert (found.best.point.model, found.verdict) == ("net", REFINED)
    assert at_equal_time(exact("net", 1, 9.9, 0.05), [exact("other", 0, 10.0, 0.5)]) is None


def test_overlapping_intervals_leave_equal_time_open() -> None:
    found = at_equal_time(reached("net", 1, 20.0, 0.49, noise=0.4), [reached("net", 0, 10.0, 0.5, noise=0.4)])
    assert found is not None
    assert found.verdict == OPEN
    assert found.gain.low < 0 < found.gain.high


def scene(size: str, vertices: int, network_ms: float, noise: float = 0.02) -> list[Reached]:
    """The solver needs 50 ms for γ = 0.04."""
    shared = {"size": size, "vertices": vertices, "noise": noise}
    return [*solver(CURVE, **shared), reached("net", 0, network_ms, 0.04, **shared)]  # type: ignore[arg-type]


def test_the_crossover_is_named_where_the_solver_gives_way() -> None:
    items = scene("1k", 1000, 200.0, noise=0.0) + scene("4k", 4000, 12.5, noise=0.0)
    found = verdicts_by_size(items)
    assert [(s.size, s.winner) for s in found] == [("1k", SOLVER), ("4k", NETWORK)]
    said = crossover(found, "CPU (made up)")
    assert said == (
        "Up to 1,000 vertices on this CPU (made up) the solver alone is the better choice, from 4,000 on a network that "
        "reaches the same γ in less time: net, fp32 at 4,000 vertices (γ = 0.04)."
    )


def test_an_undecided_size_between_is_named_and_every_winner_has_its_own_size() -> None:
    sizes = scene("1k", 1000, 200.0), scene("4k", 4000, 50.0, noise=0.4), scene("12k", 12000, 12.5), scene("40k", 40000, 10.0)
    said = crossover(verdicts_by_size([item for size in sizes for item in size]), "CPU")
    assert said.startswith("Up to 1,000 vertices on this CPU the solver alone is the better choice, from 12,000 on a network")
    assert "net, fp32 at 12,000 vertices (γ = 0.04); net, fp32 at 40,000 vertices (γ = 0.04)." in said
    assert "At 4,000 vertices no claim is made" in said


def test_a_fast_network_that_is_far_off_is_no_choice() -> None:
    items = [*solver(CURVE), reached("net", 0, 1.0, 2.3), reached("net", 1, 2.0, 0.9)]
    assert [(one.winner, one.best) for one in verdicts_by_size(items)] == [(SOLVER, None)]
    few = [replace(item, rollouts=LEAST_ROLLOUTS - 1) for item in items]
    assert [(one.winner, one.best) for one in verdicts_by_size(few)] == [(OPEN, None)]


def test_few_rollouts_allow_no_verdict() -> None:
    few = [replace(item, rollouts=LEAST_ROLLOUTS - 1) for item in scene("1k", 1000, 10.0)]
    assert verdicts_by_size(few)[0].winner == OPEN
    assert "rollouts are fewer than 6" in crossover(verdicts_by_size(few), "CPU")
    found = at_equal_time(replace(exact("net", 1, 9.9, 0.05), rollouts=3), [exact("net", 0, 10.0, 0.5)])
    assert found is not None
    assert found.verdict == OPEN


def test_no_crossover_is_said_as_well() -> None:
    all_lost = crossover(verdicts_by_size(scene("1k", 1000, 200.0) + scene("4k", 4000, 300.0)), "CPU")
    assert "At 1,000 vertices and 4,000" not in all_lost
    assert "At 1,000 and 4,000 vertices on this CPU the solver alone is the better choice; no crossover" in all_lost
    assert "No size was seen below which" in crossover(verdicts_by_size(scene("1k", 1000, 10.0)), "CPU")
    backwards = crossover(verdicts_by_size(scene("1k", 1000, 10.0) + scene("4k", 4000, 300.0)), "CPU")
    assert "there is no single size" in backwards


def test_intervals_that_overlap_make_no_claim() -> None:
    found = verdicts_by_size(scene("1k", 1000, 50.0, noise=0.4))
    assert found[0].winner == OPEN
    said = crossover(found, "CPU")
    assert said.startswith("On this CPU no crossover was seen. At 1,000 vertices no claim is made")
    assert "The network's best setting at 1,000 vertices, net, fp32, took" in said
    assert found[0].best is not None
    assert f"({1 / found[0].best.high:.2g} to {1 / found[0].best.low:.2g})." in said
    mixed = crossover(verdicts_by_size(scene("1k", 1000, 200.0) + scene("4k", 4000, 50.0, noise=0.4)), "CPU")
    assert "At 4,000 vertices no claim is made: the intervals overlap" in mixed
    assert crossover([], "CPU").startswith("No network was measured")


def test_a_setting_that_overstretches_wins_nothing() -> None:
    items = scene("1k", 1000, 10.0)
    assert verdicts_by_size(items)[0].winner == NETWORK
    assert [(one.winner, one.best) for one in verdicts_by_size(items, {items[-1].point})] == [(SOLVER, None)]
    assert verdicts_by_size(solver(CURVE)) == []


def test_refinement_is_held_against_the_same_network_at_the_same_size() -> None:
    items = [
        exact("net", 0, 100.0, 0.5), exact("net", 5, 200.0, 0.1, strain=0.08), exact("net", 2, 150.0, 0.2, strain=0.3),
        exact("net", 5, 900.0, 0.1, strain=0.08, size="4k"), *solver(CURVE),
    ]  # fmt: skip
    found = refined_networks(items)
    assert [(one.reached.point.refine, one.plain is items[0], one.stretched, one.deeper, one.worse) for one in found] == [
        (5, True, 0, 0, False), (2, True, 8, 0, True),
    ]  # fmt: skip


def test_refinement_that_pushes_cloth_into_the_body_or_breaks_down_is_worse() -> None:
    plain, deeper = exact("net", 0, 1.0, 1.0), replace(exact("net", 5, 1.0, 1.0), penetrations=(1e-3,) * 8)
    once = replace(exact("net", 20, 1.0, 1.0), penetrations=(1e-3, *(0.0,) * 7))
    broken = exact("net", 10, 1.0, 1.0, strain=float("nan"))
    found = refined_networks([plain, deeper, once, broken])
    assert [(one.worse, one.stretched, one.deeper) for one in found] == [(True, 0, 8), (False, 0, 1), (True, 8, 0)]


@pytest.mark.parametrize("strain, worse", [(0.12, False), (0.104, False), (0.16, True)])
def test_refinement_may_raise_the_strain_to_the_solvers(strain: float, worse: bool) -> None:
    items = [
        exact("net", 0, 1.0, 1.0, strain=0.05),
        exact("net", 5, 1.0, 1.0, strain=strain),
        exact("newton", 0, 1.0, 0.0, strain=0.12),
    ]
    assert [one.worse for one in refined_networks(items)] == [worse]
    assert [one.worse for one in refined_networks(items[:2])] == [True]  # nobody says what the strain should be


def test_refinement_that_saves_a_rollout_from_breaking_down_is_no_worse() -> None:
    plain = replace(exact("net", 0, 1.0, 1.0), strains=(float("inf"),) * 8, penetrations=(float("inf"),) * 8)
    (found,) = refined_networks([plain, exact("net", 5, 1.0, 1.0)])
    assert (found.worse, found.stretched, found.deeper) == (False, 0, 0)

"""When a refinement stops: counts, targets, strain, and a budget of time on a clock that is moved by hand."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.problem import StepProblem
from hood.steppers.stopping import Budget, Costs, Count, MaxStrain, RefinementState, TargetResidual
from hood.testing import grid, make_problem


@pytest.fixture(scope="module")
def problem() -> StepProblem:
    return make_problem(build_cloth(*grid(5, 5, 0.2), Material()))


def at(
    problem: StepProblem, iterations: int, residual: float = 1.0, stretch: float = 0.0, elapsed: float = 0.0
) -> RefinementState:
    return RefinementState(problem, (1.0 + stretch) * problem.cloth.rest_pos, iterations, residual, elapsed)


def test_a_count_counts(problem: StepProblem) -> None:
    assert not Count(0).begin(at(problem, 0))
    goal = Count(3)
    assert goal.begin(at(problem, 0))
    assert [goal.proceed(at(problem, k)) for k in range(5)] == [True, True, True, False, False]


def test_a_target_is_met_or_reported_as_missed(problem: StepProblem) -> None:
    goal = TargetResidual(0.1, most=4)
    assert goal.proceed(at(problem, 1, 0.2))
    assert not goal.proceed(at(problem, 1, 0.1))
    assert not goal.proceed(at(problem, 4, 0.2))
    assert goal.proceed(at(problem, 1, float("nan")))
    assert goal.end(at(problem, 1, 0.1)) == {"refine_met": 1.0}
    assert goal.end(at(problem, 4, 0.2)) == {"refine_met": 0.0}


def test_strain_asks_for_more_where_it_is_above_and_for_less_where_it_is_below(problem: StepProblem) -> None:
    goal = MaxStrain(0.05, most=6, floor=2)
    assert at(problem, 0, stretch=0.04).strain == pytest.approx(0.04, abs=1e-5)
    assert goal.begin(at(problem, 0))
    assert goal.proceed(at(problem, 1, stretch=0.0))  # never below the floor
    assert not goal.proceed(at(problem, 2, stretch=0.04))
    assert goal.proceed(at(problem, 2, stretch=0.06))
    assert not goal.proceed(at(problem, 6, stretch=0.06))
    assert goal.end(at(problem, 6, stretch=0.06)) == {"refine_met": 0.0}
    assert goal.floor == 3
    assert goal.end(at(problem, 3, stretch=0.045)) == {"refine_met": 1.0}
    assert goal.floor == 3
    for floor in (2, 1, 0, 0):
        assert goal.end(at(problem, 0, stretch=0.01)) == {"refine_met": 1.0}
        assert goal.floor == floor
    assert not goal.begin(at(problem, 0, stretch=0.01))
    assert goal.begin(at(problem, 0, stretch=0.06))


class Machine:
    """Frames on a clock of its own: the network's time, the set-up and the iterations, all with noise.

    Args:
        busy: for every 10 ms of work, the probability of a pause of 20 ms and more for the work of others.
    """

    def __init__(
        self, problem: StepProblem, network: float, setup: float, cost: float, noise: float, seed: int = 0, busy: float = 0.0
    ) -> None:
        self.problem, self.network, self.setup, self.cost, self.noise = problem, network, setup, cost, noise
        self.random, self.busy = random.Random(seed), busy

    def frame(self, goal: Budget, network: bool = True, slower: float = 1.0) -> tuple[float, int]:
        """Milliseconds and iterations of a frame."""
        now, done = self._some(self.network, 0.05) if network else 0.0, 0
        if goal.begin(at(self.problem, 0, elapsed=now)):
            now += slower * self._some(self.setup, self.noise)
            while goal.proceed(at(self.problem, done, elapsed=now)):
                now += slower * self._some(self.cost, self.noise)
                done += 1
        goal.end(at(self.problem, done, elapsed=now))
        return now, done

    def _some(self, ms: float, noise: float) -> float:
        taken = ms * self.random.lognormvariate(0.0, noise)
        paused = sum(self.random.random() < self.busy for _ in range(round(taken / 10.0)))
        return taken + sum(20.0 + self.random.expovariate(1.0 / 20.0) for _ in range(paused))


@pytest.mark.parametrize("network, setup, cost", [(60.0, 12.0, 14.0), (500.0, 40.0, 60.0)])
@pytest.mark.parametrize("factor", [1.2, 2.0, 4.0])
def test_a_budget_is_used_and_kept(problem: StepProblem, network: float, setup: float, cost: float, factor: float) -> None:
    """Iterations vary by 40%, the first frame takes three times as long as the others."""
    machine = Machine(problem, network, setup, cost, 0.4)
    goal = Budget(factor * network)
    machine.frame(goal, network=False, slower=3.0)
    frames = [machine.frame(goal) for _ in range(300)]
    ms, iterations = np.array([frame[0] for frame in frames]), np.array([frame[1] for frame in frames])
    assert np.quantile(ms, 0.95) <= goal.budget_ms
    assert np.median(ms) >= 0.7 * goal.budget_ms
    if factor > 1.2:
        assert np.median(iterations) >= 1


@pytest.mark.parametrize("busy", [0.002, 0.01])
@pytest.mark.parametrize("factor", [2.0, 4.0])
def test_a_budget_is_kept_on_a_machine_with_other_work(problem: StepProblem, factor: float, busy: float) -> None:
    """A few iterations take five times as long as the others: the usual cost says nothing about them."""
    for seed in range(4):
        machine, goal = Machine(problem, 100.0, 12.0, 14.0, 0.2, seed, busy), Budget(factor * 105.0)
        ms = np.array([machine.frame(goal)[0] for _ in range(300)])
        assert np.quantile(ms, 0.95) <= goal.budget_ms
        assert np.median(ms) >= 0.7 * goal.budget_ms


@pytest.mark.parametrize("network, noise, busy", [(60.0, 0.4, 0.0), (160.0, 0.3, 0.002)])
def test_a_tight_budget_is_kept_where_the_network_alone_keeps_it(
    problem: StepProblem, network: float, noise: float, busy: float
) -> None:
    for seed in range(6):
        machine, goal = Machine(problem, network, 12.0, 14.0, noise, seed, busy), Budget(1.2 * network)
        ms = np.array([machine.frame(goal)[0] for _ in range(300)])
        assert np.quantile(ms, 0.95) <= goal.budget_ms
        assert np.median(ms) >= 0.7 * goal.budget_ms


def test_where_the_network_alone_is_late_too_often_nothing_is_refined(problem: StepProblem) -> None:
    machine, goal = Machine(problem, 100.0, 12.0, 14.0, 0.2, busy=0.02), Budget(170.0)
    done = [machine.frame(goal)[1] for _ in range(300)]
    assert np.mean(done) > 0.3
    crowded, goal = Machine(problem, 150.0, 12.0, 14.0, 0.2, busy=0.02), Budget(170.0)
    done = [crowded.frame(goal)[1] for _ in range(300)]
    assert np.mean(np.array(done[20:]) > 0) < 0.05


def test_a_budget_begins_where_a_table_says(problem: StepProblem) -> None:
    """Measured on a machine twice as fast; without a table the first frame tries one iteration and learns."""
    told, own = Budget(200.0, measured=Costs(iteration=5.0, setup=10.0, frame=30.0)), Budget(200.0)
    relaxing = make_problem(problem.cloth, dt=1.0 / 3.0)
    for goal in (told, own):  # no frame, and its time says nothing about the machine
        assert goal.begin(at(relaxing, 0, elapsed=0.01))
        goal.end(at(relaxing, 0, elapsed=0.01))
    machine = Machine(problem, 60.0, 20.0, 10.0, 0.0)
    assert machine.frame(told)[1] in (11, 12)  # about 60 for the network: 60 + 20 + 12 · 10 = 200
    assert told.begin(at(problem, 0, elapsed=60.0))
    assert not Budget(100.0, measured=Costs(40.0, 25.0, 60.0)).begin(at(problem, 0, elapsed=60.0))
    assert Budget(100.0, measured=Costs(20.0, 10.0, 60.0)).begin(at(problem, 0, elapsed=60.0))


def test_a_table_from_a_slower_day_does_not_end_refinement_for_good(problem: StepProblem) -> None:
    machine, goal = Machine(problem, 50.0, 10.0, 10.0, 0.1), Budget(120.0, measured=Costs(500.0, 10.0, 50.0))
    later = [machine.frame(goal)[1] for _ in range(100)]
    assert later[0] == 0
    assert np.median(later[-20:]) >= 2


def test_a_budget_follows_a_machine_that_slows_down(problem: StepProblem) -> None:
    machine, goal = Machine(problem, 50.0, 10.0, 10.0, 0.2), Budget(150.0)
    fast = [machine.frame(goal)[1] for _ in range(100)]
    slow = [machine.frame(goal, slower=3.0) for _ in range(200)]
    assert np.median([done for _, done in slow]) < 0.5 * np.median(fast[10:])
    assert np.quantile([ms for ms, _ in slow], 0.9) <= 150.0
    back = [machine.frame(goal)[1] for _ in range(300)]
    assert np.median(back[200:]) >= np.median(fast[10:]) - 2


def test_one_expensive_start_does_not_end_refinement_for_good(problem: StepProblem) -> None:
    machine, goal = Machine(problem, 50.0, 10.0, 10.0, 0.1), Budget(120.0)
    assert machine.frame(goal, slower=30.0)[0] > 120.0
    later = [machine.frame(goal)[1] for _ in range(60)]
    assert np.median(later[-20:]) >= 2


def test_values_that_mean_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match="refine is -1"):
        Count(-1)
    with pytest.raises(ValueError, match="target_rg is 0"):
        TargetResidual(0.0)
    with pytest.raises(ValueError, match="budget_ms is -3"):
        Budget(-3.0)
    with pytest.raises(ValueError, match="max_strain is nan"):
        MaxStrain(float("nan"))


def test_strain_of_frames_that_are_not_finite_is_missed(problem: StepProblem) -> None:
    broken = RefinementState(problem, torch.full_like(problem.cloth.rest_pos, torch.nan), 3, 1.0, 0.0)
    assert MaxStrain(0.05, floor=3).end(broken) == {"refine_met": 0.0}

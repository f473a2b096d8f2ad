"""Schedules as functions of the iteration."""

from __future__ import annotations

import pytest

from hood.losses.potential import default_potential
from hood.training.curriculum import CollisionRamp, Horizon, StepDecay, WarmupCosine


def test_horizon_grows_step_by_step_to_its_maximum() -> None:
    horizon = Horizon(every=5000, maximum=5)
    assert [horizon(i) for i in (0, 4999, 5000, 9999, 19999, 20000, 150000)] == [1, 1, 2, 2, 4, 5, 5]


def test_step_decay_is_the_references() -> None:
    decay = StepDecay(every=50000, floor=0.01)
    assert [decay(i, 150000) for i in (0, 49999, 50000, 100000)] == pytest.approx([1.01, 1.01, 0.51, 0.26])


def test_warm_up_is_linear_and_the_cosine_ends_at_the_floor() -> None:
    schedule = WarmupCosine(warmup=50, floor=0.01)
    assert [schedule(i, 1000) for i in (0, 24, 49)] == pytest.approx([0.02, 0.5, 1.0])
    assert schedule(50, 1000) == pytest.approx(1.0)
    assert schedule(525, 1000) == pytest.approx(0.505)
    assert schedule(1000, 1000) == schedule(5000, 1000) == pytest.approx(0.01)
    rates = [schedule(i, 1000) for i in range(50, 1001)]
    assert all(later < earlier for earlier, later in zip(rates, rates[1:], strict=False))


def test_schedules_survive_runs_shorter_than_the_warm_up() -> None:
    assert 0 < WarmupCosine(warmup=50)(9, 10) < 1


def test_collision_weight_rises_linearly() -> None:
    ramp = CollisionRamp(5e3, 5e5, 50, 150)
    assert [ramp(i) for i in (0, 50, 100, 150, 999)] == pytest.approx([5e3, 5e3, 252500, 5e5, 5e5])
    assert CollisionRamp(1.0, 7.0, 0, 0)(0) == 7.0


def test_the_weight_reaches_collision_and_friction_and_nothing_else() -> None:
    potential = default_potential()
    applied = CollisionRamp(1e3, 1e3).apply(potential, 0)
    for name in ("collision", "friction"):
        assert applied.terms[name].weight == 1e3
        assert potential.terms[name].weight == 5e5
    for name in ("stretching", "bending", "inertia", "gravity"):
        assert applied.terms[name] is potential.terms[name]

"""Schedules as functions of the iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from hood.app.settings.compose import build, load_config
from hood.energies.friction import Friction
from hood.energies.mass_points import Gravity
from hood.energies.potential import default_potential, reference_potential
from hood.training.curriculum import CollisionRamp, Horizon, InverseRoot, StepDecay, WarmupCosine
from hood.training.settings import TrainerSettings


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


def test_the_inverse_root_does_not_ask_how_long_a_run_is() -> None:
    schedule = InverseRoot(warmup=50, steady=100)
    assert [schedule(i, 1000) for i in (0, 24, 49, 100)] == pytest.approx([0.02, 0.5, 1.0, 1.0])
    assert [schedule(i, 1000) for i in (400, 2500, 10_000)] == pytest.approx([0.5, 0.2, 0.1])
    assert all(schedule(i, 1000) == schedule(i, 150_000) for i in range(0, 1000, 7))
    assert schedule.scaled(0.5) == InverseRoot(25, 50)


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


def test_a_weight_that_the_ramp_would_overwrite_is_refused() -> None:
    level, rising = CollisionRamp(5e5, 5e5), CollisionRamp(5e3, 5e5, 50, 150)
    for ramp in (level, rising):
        ramp.require_its_weight(default_potential())
        ramp.require_its_weight(reference_potential())
    CollisionRamp(1e6, 1e6).require_its_weight(default_potential(1e6))
    CollisionRamp(1e6, 1e6).require_its_weight(default_potential())
    with pytest.raises(ValueError, match=r"^losses\.terms\.collision\.weight=1000000: a training takes") as error:
        level.require_its_weight(default_potential(1e6))
    assert "give trainer.collision.end=1000000 and trainer.collision.start=1000000 instead" in str(error.value)
    with pytest.raises(
        ValueError, match=r"collision\.weight=0: .*give trainer\.collision\.end=0 instead \(it rises from .*5000\)"
    ):
        rising.require_its_weight(default_potential(0.0))
    other = default_potential().with_terms(friction=Friction(weight=2e5))
    with pytest.raises(ValueError, match=r"losses\.terms\.friction\.weight=200000"):
        level.require_its_weight(other)


class Steady(Gravity):
    """A contact of another package whose weight is its own."""

    def with_weight(self, weight: float) -> Steady:
        return self


def test_a_contact_of_another_package_keeps_its_own_weight_if_it_says_so() -> None:
    potential, ramp = default_potential().with_terms(collision=Steady()), CollisionRamp(1e3, 1e3)
    ramp.require_its_weight(potential)
    applied = ramp.apply(potential, 0)
    assert applied.terms["collision"] is potential.terms["collision"]
    assert applied.terms["friction"].weight == 1e3  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=r"terms\.collision \(hood\.energies\.mass_points\.Gravity\).*no method with_weight"):
        ramp.require_its_weight(potential.with_terms(collision=Gravity()))


PAPER = TrainerSettings()


def test_time_scale_compresses_everything_alike() -> None:
    """At the same share of the run the compressed schedule stands where the whole one stands."""
    short = replace(PAPER, time_scale=0.02).compressed()
    assert short.iterations == 3000
    for share in (0.0, 0.02, 0.1, 0.33, 0.34, 0.5, 0.667, 0.99, 1.0):
        long_at, short_at = round(150_000 * share), round(3000 * share)
        assert short.horizon(short_at) == PAPER.horizon(long_at)
        assert short.schedule(short_at, 3000) == PAPER.schedule(long_at, 150_000)
        assert short.collision(short_at) == pytest.approx(PAPER.collision(long_at), rel=0.01)
    assert (short.horizon.every, short.collision.begin_iteration, short.collision.end_iteration) == (100, 1000, 3000)


def test_time_scale_leaves_rates_sample_counts_and_the_rest() -> None:
    short = replace(PAPER, time_scale=0.02).compressed()
    for name in ("learning_rate", "statistics_iterations", "clip_norm", "checkpoint_every", "batch_size"):
        assert getattr(short, name) == getattr(PAPER, name)
    assert short.compressed() is short
    assert PAPER.compressed() is PAPER
    warm = replace(PAPER, schedule=WarmupCosine(50), time_scale=0.1).compressed()
    assert warm.schedule == WarmupCosine(5)


@pytest.mark.parametrize(
    "factor, words",
    [
        (0.0, "trainer.time_scale is 0.0"),
        (-1.0, "trainer.time_scale is -1.0"),
        (float("nan"), "trainer.time_scale is nan"),
        (float("inf"), "trainer.time_scale is inf"),
        (1e-9, r"leaves nothing of trainer.iterations=150000"),
        (6e-4, r"leaves 90 iterations, of which the first 100 only collect statistics"),
    ],
)
def test_time_scales_that_leave_no_training_are_refused(factor: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(PAPER, time_scale=factor)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Horizon(start=8, maximum=2), "trainer.horizon.start is 8, maximum 2"),
        (lambda: WarmupCosine(floor=2), "trainer.schedule.floor is 2; it is a share"),
        (lambda: StepDecay(floor=1.5), "trainer.schedule.floor is 1.5; it is a share"),
        (lambda: TrainerSettings(by_rollout=True, torn_strain=0.25), "trainer.torn_strain=0.25: with trainer.by_rollout=true"),
        (lambda: TrainerSettings(statistics_iterations=-2), "trainer.statistics_iterations is -2; it must be at least 0"),
    ],
)
def test_settings_that_contradict_themselves_are_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


def test_the_configs_hold_the_papers_numbers() -> None:
    config = load_config("train", ["experiment=paper", "trainer.time_scale=0.02"])
    assert config.trainer.time_scale == 0.02
    assert build(config.trainer).compressed() == replace(PAPER, time_scale=0.02, workers=None, kernels="auto").compressed()
    assert config.model.features == "paper"
    sampling = config.data.sampling
    assert (sampling.beta_range, list(sampling.size_range), sampling.piecewise_fraction) == (2.0, [0.9, 1.1], 0.0)

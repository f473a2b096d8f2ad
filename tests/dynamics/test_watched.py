"""Energies that are left out come back in the frame where they matter; the price bounds what they are worth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from layer_scenes import sheets_on_sphere

from hood.dynamics.rollout import simulate
from hood.dynamics.stepper import NewtonStepper
from hood.dynamics.watched import PLAN_METRICS, WatchedStepper, force_bound, lacking
from hood.evaluation.gap import gap
from hood.evaluation.leaving_out import Effect, Variant, begin, take_steps
from hood.evaluation.windows import Window
from hood.losses.layers import LayerBarrier
from hood.losses.potential import Potential, default_potential, scale
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings

FULL = default_potential()
TIGHT = NewtonSettings(target_rg=1e-3)


def without(*names: str) -> Potential:
    return Potential({name: term for name, term in FULL.terms.items() if name not in names})


def watched(scene: Scene, lean: Potential, limit: float, ratio: float = 1.0, hold: int = 2) -> WatchedStepper:
    return WatchedStepper(NewtonStepper(lean, TIGHT), NewtonStepper(FULL, TIGHT), (lean, FULL), scene, limit, ratio, hold)


def rolled(stepper: Any, scene: Scene, count: int = 5) -> list[Any]:
    return list(simulate(stepper, scene, FULL, count, relaxing_steps=0, metrics="none"))


@pytest.mark.parametrize("names", [("bending",), ("friction",), ("bending", "friction")])
def test_the_bound_is_not_below_gamma(names: tuple[str, ...], tank_scene: Scene) -> None:
    full = Variant(NewtonStepper(FULL, TIGHT), FULL, tank_scene)
    lean = Variant(NewtonStepper(without(*names), TIGHT), without(*names), tank_scene)
    (one,) = begin(full, [Window(0, "the start")], "paper", lead=1)
    pos, _ = take_steps(lean, one, 1, Effect())
    gamma = float(gap(FULL, one.step, pos).gamma)
    assert gamma > 1e-6
    assert force_bound(FULL, list(names), one.step, pos) >= gamma


def test_a_lone_force_is_worth_what_inertia_gives_it(tank_scene: Scene) -> None:
    """Weight alone: γ of ignoring it is 1, its share of e0, where nothing but inertia resists."""
    full = Variant(NewtonStepper(FULL, TIGHT), FULL, tank_scene)
    (one,) = begin(full, [Window(0, "the start")], "paper", lead=0)
    assert force_bound(FULL, ["gravity"], one.step, one.state.pos) == pytest.approx(1.0, rel=1e-5)
    assert force_bound(FULL, ["attachment"], one.step, one.state.pos) == 0.0


def test_layers_are_priced_by_their_own_gradient() -> None:
    potential = FULL.with_terms(layers=LayerBarrier())
    problem = potential.prepare(sheets_on_sphere(1 / 30, gap=1e-3))
    pos = problem.state.pos
    gradient, _ = potential.only({"layers": potential.terms["layers"]}).gradient(problem, pos)
    square = float(((gradient**2).sum(dim=1) / problem.cloth.mass).sum())
    expected = 0.5 * float(problem.step.dt) ** 2 * square / float(scale(problem))
    assert expected > 0.0
    assert force_bound(potential, ["layers"], problem, pos) == pytest.approx(expected, rel=1e-4)
    assert force_bound(potential, ["layers", "gravity"], problem, pos) != force_bound(potential, ["layers"], problem, pos)
    apart = potential.prepare(sheets_on_sphere(1 / 30, gap=0.05))
    assert force_bound(potential, ["layers"], apart, apart.state.pos) == 0.0


def test_below_the_limit_the_rollout_is_the_lean_one(tank_scene: Scene) -> None:
    lean = without("bending")
    frames = rolled(watched(tank_scene, lean, 1e9), tank_scene)
    alone = rolled(NewtonStepper(lean, TIGHT), tank_scene)
    assert all(torch.equal(one.world_pos, other.world_pos) for one, other in zip(frames, alone, strict=True))
    assert [frame.metrics["plan_full"] for frame in frames[1:]] == [0.0] * 4
    assert all(frame.metrics["plan_price"] > 0.0 for frame in frames[1:])


def test_above_the_limit_the_rollout_is_the_full_one(tank_scene: Scene) -> None:
    frames = rolled(watched(tank_scene, without("collision", "friction"), 1e-12), tank_scene)
    alone = rolled(NewtonStepper(FULL, TIGHT), tank_scene)
    assert all(torch.equal(one.world_pos, other.world_pos) for one, other in zip(frames, alone, strict=True))
    assert [frame.metrics["plan_full"] for frame in frames[1:]] == [1.0] * 4


def test_the_part_is_back_within_the_frame_and_goes_again(tank_scene: Scene) -> None:
    stepper = watched(tank_scene, without("bending"), 1e9, hold=2)
    priced = stepper.price
    calls: list[int] = []

    def alarmed(problem: Any, pos: Any) -> float:
        calls.append(len(calls))
        return 1e10 if len(calls) == 2 else priced(problem, pos)

    stepper.price = alarmed  # type: ignore[method-assign]
    frames = rolled(stepper, tank_scene, 7)
    assert [frame.metrics["plan_full"] for frame in frames[1:]] == [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]


def test_a_model_that_fails_at_once_is_tried_less_often(tank_scene: Scene) -> None:
    stepper = watched(tank_scene, without("bending"), 1e9, hold=1)
    tried: list[int] = []

    def failing(problem: Any, pos: Any) -> float:
        tried.append(len(tried))
        return 1e10

    stepper.price = failing  # type: ignore[method-assign]
    frames = rolled(stepper, tank_scene, 9)
    assert [frame.metrics["plan_full"] for frame in frames[1:]] == [1.0] * 8
    assert len(tried) == 4  # before steps 1, 2, 4 and 8


def test_the_ratio_divides_the_price(tank_scene: Scene) -> None:
    one, ten = (rolled(watched(tank_scene, without("bending"), 1e9, ratio), tank_scene, 2)[1] for ratio in (1.0, 10.0))
    assert one.metrics["plan_price"] == pytest.approx(10.0 * ten.metrics["plan_price"], rel=1e-6)


def test_what_is_not_finite_is_taken_by_the_full_model(tank_scene: Scene) -> None:
    class Broken(NewtonStepper):
        def predict(self, *arguments: Any) -> Any:
            found = super().predict(*arguments)
            return replace(found, next_pos=found.next_pos * float("nan"))

    lean = without("bending")
    stepper = WatchedStepper(Broken(lean, TIGHT), NewtonStepper(FULL, TIGHT), (lean, FULL), tank_scene, 0.01, 1.0, 2)
    frames = rolled(stepper, tank_scene, 3)
    assert all(bool(torch.isfinite(frame.world_pos).all()) for frame in frames)
    assert frames[-1].metrics["plan_full"] == 1.0


def test_its_metrics_name_both_models(tank_scene: Scene) -> None:
    stepper = watched(tank_scene, without("bending"), 0.01)
    assert set(PLAN_METRICS) <= set(stepper.metrics)
    assert set(NewtonStepper(FULL).metrics) <= set(stepper.metrics)
    assert lacking(without("bending"), FULL) == ["bending"]

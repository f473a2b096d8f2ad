"""Energies that are left out come back in the frame where they matter; the price bounds what they are worth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from layer_scenes import sheets_on_sphere

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.load import load_sequence
from hood.energies.potential import Potential, default_potential, scale
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier
from hood.evaluation.gap import gap
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import NewtonStepper
from hood.steppers.watched import (
    GROWTH,
    MOST_OVERSTATED,
    PLAN_METRICS,
    REMEMBERED,
    WatchedStepper,
    _Known,
    force_bound,
    lacking,
)
from hood.studies.plan.ablation import AblationWindow, Effect, Variant, begin, take_steps
from hood.testing import cylinder

FULL = default_potential()
TIGHT = NewtonSettings(target_rg=1e-3)


def without(*names: str) -> Potential:
    return Potential({name: term for name, term in FULL.terms.items() if name not in names})


def watched(scene: Scene, reduced: Potential, limit: float, hold: int = 2) -> WatchedStepper:
    return WatchedStepper(NewtonStepper(reduced, TIGHT), NewtonStepper(FULL, TIGHT), (reduced, FULL), scene, limit, hold)


def rolled(stepper: Any, scene: Scene, count: int = 5) -> list[Any]:
    return list(simulate(stepper, scene, FULL, count, relaxing_steps=0, metrics="none"))


@pytest.mark.parametrize("names", [("bending",), ("friction",), ("bending", "friction")])
def test_the_bound_is_not_below_gamma(names: tuple[str, ...], tank_scene: Scene) -> None:
    full = Variant(NewtonStepper(FULL, TIGHT), FULL, tank_scene)
    reduced = Variant(NewtonStepper(without(*names), TIGHT), without(*names), tank_scene)
    (one,) = begin(full, [AblationWindow(0, "the start")], "paper", lead=1)
    pos, _ = take_steps(reduced, one, 1, Effect())
    gamma = float(gap(FULL, one.step, pos).gamma)
    assert gamma > 1e-6
    assert force_bound(FULL, list(names), one.step, pos) >= gamma


def test_a_lone_force_is_worth_what_inertia_gives_it(tank_scene: Scene) -> None:
    """Weight alone: γ of ignoring it is 1, its share of e0, where nothing but inertia resists."""
    full = Variant(NewtonStepper(FULL, TIGHT), FULL, tank_scene)
    (one,) = begin(full, [AblationWindow(0, "the start")], "paper", lead=0)
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
    reduced = without("bending")
    frames = rolled(watched(tank_scene, reduced, 1e9), tank_scene)
    alone = rolled(NewtonStepper(reduced, TIGHT), tank_scene)
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
    stepper._worth = lambda *given: 1e10  # type: ignore[method-assign]
    frames = rolled(stepper, tank_scene, 7)
    assert [frame.metrics["plan_full"] for frame in frames[1:]] == [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]


def test_a_model_that_fails_at_once_is_tried_less_often(tank_scene: Scene) -> None:
    stepper = watched(tank_scene, without("bending"), 1e9, hold=1)
    tried: list[int] = []

    def failing(problem: Any, pos: Any) -> float:
        tried.append(len(tried))
        return 1e10

    stepper.price = failing  # type: ignore[method-assign]
    stepper._worth = lambda *given: 1e10  # type: ignore[method-assign]
    frames = rolled(stepper, tank_scene, 9)
    assert [frame.metrics["plan_full"] for frame in frames[1:]] == [1.0] * 8
    assert len(tried) == 4  # before steps 1, 2, 4 and 8


def test_a_price_that_was_too_high_is_known_from_then_on(tank_scene: Scene) -> None:
    """The bound of bending is several times its γ: one step by the full model, and forces like those are priced by what they
    were worth."""
    probe = rolled(watched(tank_scene, without("bending"), 1e9), tank_scene, 8)
    bound = max(frame.metrics["plan_price"] for frame in probe[1:])
    stepper = watched(tank_scene, without("bending"), 0.6 * bound, hold=4)
    frames = rolled(stepper, tank_scene, 5)
    assert [frame.metrics["plan_full"] for frame in frames[1:]] == [1.0, 0.0, 0.0, 0.0]
    assert frames[1].metrics["plan_price"] > 0.6 * bound
    known = stepper._known["bending"]
    assert 1.0 < known.ratio <= MOST_OVERSTATED
    assert known.left == REMEMBERED - 3
    seen = stepper._priced("bending", known.forces / GROWTH)
    assert seen == pytest.approx(float(known.forces.sum()) / GROWTH / known.ratio)


def test_forces_where_there_were_none_are_priced_higher(tank_scene: Scene) -> None:
    stepper, forces = watched(tank_scene, without("bending"), 0.01), torch.tensor([2.0, 0.0], dtype=torch.float64)
    stepper._known["bending"] = _Known(16.0, forces, 9)
    assert stepper._priced("bending", torch.tensor([1.0, 3.0], dtype=torch.float64)) == pytest.approx(1.0 / 16.0 + 3.0 / 4.0)
    assert stepper._priced("bending", torch.tensor([5.0, 0.0], dtype=torch.float64)) == pytest.approx(2.0 / 16.0 + 3.0 / 4.0)


def test_what_was_known_of_a_price_is_forgotten(tank_scene: Scene) -> None:
    stepper, forces = watched(tank_scene, without("bending"), 0.01), torch.ones(5, dtype=torch.float64)
    stepper._known["bending"] = _Known(10.0, forces, 2)
    assert [stepper._priced("bending", forces) for _ in range(3)] == pytest.approx([0.5, 0.5, 5.0])


def test_layers_are_always_priced_in_full() -> None:
    full = FULL.with_terms(layers=LayerBarrier())
    stepper = object.__new__(WatchedStepper)
    stepper._potential, stepper._known = full, {"layers": _Known(10.0, torch.ones(5), 9)}
    assert stepper._priced("layers", torch.ones(5)) == 5.0


@pytest.mark.parametrize(
    ("motion", "first", "radius", "names"),
    [
        ("kicks", 40, 0.35, ("collision", "friction")),  # a leg comes up
        ("squats", 30, 0.24, ("collision", "friction")),  # she sits down
        ("lunges", 30, 0.23, ("collision", "friction")),
        ("walk_proud", 60, 0.21, ("bending",)),
        ("dance_mixed", 100, 0.21, ("bending", "friction")),
    ],
)
def test_no_step_is_left_to_the_lean_model_that_the_full_one_would_take_otherwise(
    motion: str, first: int, radius: float, names: tuple[str, ...], body: Body
) -> None:
    """A band around the waist, of which the second half of a motion asks what the first did not: in every frame that is worth
    more than the limit the full model takes the step, in that very frame."""
    pos, faces = cylinder(24, 8, radius, 0.3)
    garment = Garment("band", pos + [0.0, -0.1, 0.02], faces, pos[:, 1] > 0.149)
    scene = build_scene(garment, body, load_sequence(motion).window(first, first + 24))
    stepper, limit, worths = watched(scene, without(*names), 0.01, hold=3), 0.01, []
    inner, prepared = NewtonStepper(FULL, TIGHT), {}
    taken = stepper.predict

    def judged(problem: Any, given: Any, watch: Any = None) -> Any:
        found = taken(problem, given, watch)
        fresh = FULL.prepare(StepProblem(problem.cloth, problem.state, problem.step, gravity=problem.gravity))
        right = inner.predict(fresh, prepared.setdefault("", inner.prepare(scene.cloth, scene.garment.rest_pos)))
        worths.append((found.metrics["plan_full"], stepper._worth(fresh, found.next_pos, right.next_pos)))
        return found

    stepper.predict = judged  # type: ignore[method-assign]
    rolled(stepper, scene, 24)
    left = [worth for full, worth in worths if not full]
    assert all(worth <= limit for worth in left)
    assert {full for full, _ in worths} == {0.0, 1.0}


def test_what_is_not_finite_is_taken_by_the_full_model(tank_scene: Scene) -> None:
    class Broken(NewtonStepper):
        def predict(self, *arguments: Any) -> Any:
            found = super().predict(*arguments)
            return replace(found, next_pos=found.next_pos * float("nan"))

    reduced = without("bending")
    stepper = WatchedStepper(Broken(reduced, TIGHT), NewtonStepper(FULL, TIGHT), (reduced, FULL), tank_scene, 0.01, 2)
    frames = rolled(stepper, tank_scene, 3)
    assert all(bool(torch.isfinite(frame.world_pos).all()) for frame in frames)
    assert frames[-1].metrics["plan_full"] == 1.0


def test_its_metrics_name_both_models(tank_scene: Scene) -> None:
    stepper = watched(tank_scene, without("bending"), 0.01)
    assert set(PLAN_METRICS) <= set(stepper.metrics)
    assert set(NewtonStepper(FULL).metrics) <= set(stepper.metrics)
    assert lacking(without("bending"), FULL) == ["bending"]

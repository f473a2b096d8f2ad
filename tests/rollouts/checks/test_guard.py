"""The guard: no alarm changes nothing, alarms are written down, steps are repaired and never made worse."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.contact.contact import find_contact
from hood.contact.further import CUT_SHARE
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.rollouts.checks import guard as guard_module
from hood.rollouts.checks.guard import (
    CHECK,
    CHECK_EVERY,
    CHECK_GROWTH,
    CHECK_LIMIT,
    CUT,
    DEPTH_LIMIT,
    FINITE,
    FORCE,
    INSIDE,
    SPEED,
    STRAIN,
    STRAIN_LIMIT,
    TARGET,
    TURN,
    Guard,
)
from hood.rollouts.checks.step_repair import (
    LEFT,
    NOT_TRIED,
    REFINED,
    SOLVED,
    Limits,
    RepairedStep,
    StepQuality,
    repair_step,
    step_quality,
)
from hood.rollouts.frame import Frame, metric_names
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.network import Prediction
from hood.steppers.newton import NewtonStepper, Stepper
from hood.steppers.protocol import Stopwatch
from hood.steppers.refined import GuessStepper, RefinedStepper
from hood.steppers.stopping import Count

POTENTIAL = default_potential()
SETTINGS = NewtonSettings(target_rg=1e-2)


@pytest.fixture(scope="module")
def scene(body: Body, garments: dict[str, Garment], walk: PoseSequence) -> Scene:
    return build_scene(garments["skirt"], body, walk, dtype=torch.float64)


def newton(**settings: Any) -> NewtonStepper:
    return NewtonStepper(POTENTIAL, replace(SETTINGS, **settings))


def guess(iterations: int) -> RefinedStepper:
    return RefinedStepper(GuessStepper(POTENTIAL), POTENTIAL, Count(iterations))


class Spoilt:
    """The solver, but for what ``spoil`` makes of the positions of one step; it says nothing of its accuracy."""

    times, relaxing, config, metrics = NewtonStepper.times, NewtonStepper.relaxing, {"stepper": "spoilt"}, ()

    def __init__(self, frame: int, spoil: Any) -> None:
        self._inner, self._frame, self._spoil, self._step = newton(), frame, spoil, 0
        self.gravity = self._inner.gravity

    def prepare(self, cloth: Any, rest_pos: Any) -> None: ...

    def search(self, problem: StepProblem) -> StepProblem:
        return self._inner.search(problem)

    def predict(self, problem: StepProblem, prepared: None, watch: Stopwatch | None = None) -> Prediction:
        self._step += 1
        pos = self._inner.predict(problem, None, watch).next_pos
        pos = self._spoil(pos) if self._step == self._frame else pos
        return Prediction(pos, problem.acceleration(pos))

    def next_velocity(self, problem: StepProblem, prediction: Prediction) -> torch.Tensor:
        return self._inner.next_velocity(problem, prediction)


def frames(stepper: Stepper, scene: Scene, guard: Guard | None, count: int = 6, **options: Any) -> list[Frame]:
    return list(simulate(stepper, scene, POTENTIAL, count, relaxing_steps=0, guard=guard, **{"metrics": "none", **options}))


def same(first: list[Frame], second: list[Frame]) -> bool:
    pairs = [(a, b) for one, two in zip(first, second, strict=True) for a, b in zip(*map(kept, (one, two)), strict=True)]
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def kept(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    return frame.world_pos.numpy(), frame.state.vel.numpy()


@pytest.mark.parametrize("metrics", ["all", "none"])
@pytest.mark.parametrize("make", [newton, lambda: guess(12)], ids=["newton", "refined"])
def test_quiet_steps_are_the_same_to_the_bit(make: Any, metrics: str, scene: Scene) -> None:
    plain = frames(make(), scene, None, metrics=metrics)
    for mode in ("report", "repair", "strict"):
        guard = Guard(mode, make(), POTENTIAL)
        assert same(plain, frames(make(), scene, guard, metrics=metrics))
        assert guard.alarms == []
        assert guard.stopped is None


def stretched(pos: torch.Tensor) -> torch.Tensor:
    """Half as long again, downwards."""
    top = pos[:, 1].max()
    return torch.stack([pos[:, 0], top + 1.5 * (pos[:, 1] - top), pos[:, 2]], dim=1)


def lost(pos: torch.Tensor) -> torch.Tensor:
    return torch.full_like(pos, math.nan)


def shaken(pos: torch.Tensor) -> torch.Tensor:
    """A millimetre here and there: little strain, much force."""
    return pos + 1e-3 * torch.sin(1e3 * pos.flip(1))


@pytest.mark.parametrize("spoil, cause", [(stretched, STRAIN), (lost, FINITE), (shaken, FORCE)])
def test_a_bad_step_is_told_and_mended(spoil: Any, cause: str, scene: Scene) -> None:
    good = frames(Spoilt(99, spoil), scene, None)
    report = Guard("report", Spoilt(3, spoil), POTENTIAL)
    told = frames(Spoilt(3, spoil), scene, report)
    assert same(told, frames(Spoilt(3, spoil), scene, None))
    assert (report.alarms[0].frame, report.alarms[0].cause, report.alarms[0].repair) == (3, cause, NOT_TRIED)
    if spoil is stretched:  # told is the gravest, the others are known
        assert report.alarms[0].strain == report.alarms[0].value
        assert report.alarms[0].force > 0
        assert report.alarms[0].depth >= 0
    repair = Guard("repair", Spoilt(3, spoil), POTENTIAL)
    repaired = frames(Spoilt(3, spoil), scene, repair)
    assert [alarm.frame for alarm in repair.alarms] == [3]
    alarm = repair.alarms[0]
    assert alarm.repair == (SOLVED if spoil is lost else REFINED)
    assert alarm.iterations > 0
    assert alarm.rg_after <= 1e-2
    assert not alarm.rg_before <= 1.0
    # The rollout goes on from there as if nothing had happened.
    off = (repaired[-1].world_pos - good[-1].world_pos).norm(dim=1).max()
    assert off < 2e-3
    assert all(torch.isfinite(frame.world_pos).all() for frame in repaired)


def test_every_twentieth_step_and_the_most_strained_are_held_against_a_solver(scene: Scene) -> None:
    """Strain that a network gets wrong by a few points is within every limit; what a solver makes of the step tells."""

    def scaled(pos: torch.Tensor) -> torch.Tensor:
        return (pos - pos.mean(0)) * 1.06 + pos.mean(0)

    problem, prediction = one_step(scene)
    solved = prediction.next_pos
    strained = step_quality(POTENTIAL, problem, replace(prediction, next_pos=scaled(solved))).strain
    for frame, looked_at, expected in (
        (CHECK_EVERY, 1.0, True),
        (CHECK_EVERY + 1, strained, False),  # as strained as one that was looked at before
        (CHECK_EVERY + 1, strained / CHECK_GROWTH - 1e-3, True),
    ):
        guard = quiet_guard("report")
        guard._checked_strain = looked_at
        guard.see(frame, problem, Prediction(solved, problem.acceleration(solved)))
        assert not guard.alarms
        wrong = Prediction(scaled(solved), problem.acceleration(scaled(solved)))
        seen = guard.see(frame, problem, wrong)
        assert seen is wrong
        assert [alarm.cause for alarm in guard.alarms] == ([CHECK] if expected else [])
    before = step_quality(POTENTIAL, problem, wrong)
    mending = quiet_guard("repair")
    kept = mending.see(CHECK_EVERY, problem, wrong)
    (alarm,) = mending.alarms
    assert alarm.value > CHECK_LIMIT
    assert alarm.repair == REFINED
    assert alarm.rg_after < 1e-2 * alarm.rg_before
    assert abs(step_quality(POTENTIAL, problem, kept).strain - before.strain) == pytest.approx(alarm.value)


def quiet_guard(mode: str) -> Guard:
    """Of a network alone, that is used to forces out of balance."""
    guard = Guard(mode, Spoilt(-1, None), POTENTIAL)
    guard._calm.extend([1e6] * 30)
    return guard


def test_strict_keeps_the_frames_before(scene: Scene) -> None:
    guard = Guard("strict", Spoilt(3, stretched), POTENTIAL)
    kept = frames(Spoilt(3, stretched), scene, guard)
    assert len(kept) == 3
    assert guard.stopped is not None
    assert (guard.stopped.frame, guard.stopped.cause) == (3, STRAIN)
    assert guard.stopped.value > STRAIN_LIMIT


def test_a_solver_that_misses_is_given_more_patience(scene: Scene) -> None:
    hasty = newton(max_iterations=4)
    told, repaired = (Guard(mode, hasty, POTENTIAL) for mode in ("report", "repair"))
    frames(hasty, scene, told)
    rows = frames(hasty, scene, repaired)
    missed = [alarm.frame for alarm in told.alarms]
    assert missed
    assert {alarm.cause for alarm in told.alarms} == {TARGET}
    better = [alarm for alarm in repaired.alarms if alarm.repair == REFINED]
    assert better
    assert all(alarm.rg_after < alarm.rg_before for alarm in better)
    for alarm in better:
        metrics = rows[alarm.frame].metrics
        assert metrics["solver_iterations"] == 4 + alarm.iterations
        assert alarm.iterations <= 4  # as many again, from where it was
        assert metrics["solver_converged"] == (alarm.rg_after <= 1e-2)


def test_what_met_the_target_is_not_solved_again(scene: Scene) -> None:
    """Cloth that hangs heavily is strained where the solver takes the step: there is nothing to repair."""
    guard = Guard("repair", newton(), POTENTIAL)
    problem, prediction = one_step(scene)
    long = replace(prediction, next_pos=stretched(prediction.next_pos), residual=1e-3)
    assert guard.see(1, problem, long) is long
    assert [(alarm.cause, alarm.repair) for alarm in guard.alarms] == [(STRAIN, NOT_TRIED)]


def one_step(scene: Scene) -> tuple[StepProblem, Prediction]:
    stepper = newton()
    state = scene.start(0)
    problem = stepper.search(StepProblem(scene.cloth, state, scene.step_input(0, state), gravity=stepper.gravity.to(state.pos)))
    return problem, stepper.predict(problem, None)


def test_a_mended_step_is_never_worse(scene: Scene) -> None:
    problem, prediction = one_step(scene)
    before = step_quality(POTENTIAL, problem, prediction)
    hopeless = repair_step(POTENTIAL, problem, prediction, before, Limits(1e-12, 0.0), replace(SETTINGS, max_iterations=0), 0)
    assert hopeless.kind == LEFT
    assert hopeless.prediction is prediction
    # Less force for much more strain is no bargain.
    indefinite_part = replace(prediction, next_pos=prediction.next_pos.clone())
    said = StepQuality(True, residual=1e9, strain=-1.0)
    refused = repair_step(POTENTIAL, problem, indefinite_part, said, Limits(1.0, 0.25), SETTINGS, 5)
    assert refused.kind == LEFT


def test_the_motion_of_the_body_is_told(scene: Scene) -> None:
    problem, prediction = one_step(scene)
    obstacle = problem.step.obstacle
    assert obstacle is not None
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]).to(obstacle.pos)
    aside = torch.tensor([0.5, 0.0, 0.0]).to(obstacle.pos)
    for move, cause, value in ((lambda pos: pos @ turn.T, TURN, 90.0), (lambda pos: pos + aside, SPEED, 0.5)):
        guard = Guard("repair", newton(), POTENTIAL)
        step = replace(problem.step, obstacle=replace(obstacle, next_pos=move(obstacle.next_pos)))
        along = replace(prediction, next_pos=move(prediction.next_pos))
        assert guard.see(1, replace(problem, step=step), along) is along
        assert [(alarm.cause, alarm.repair) for alarm in guard.alarms] == [(cause, NOT_TRIED)]
        assert guard.alarms[0].value == pytest.approx(value, abs=1e-3)


def pushed_in(pos: torch.Tensor) -> torch.Tensor:
    """All of it 25 mm backwards: its front is inside the body."""
    return pos - torch.tensor([0.0, 0.0, 0.025]).to(pos)


def test_cloth_inside_the_body_is_told_and_taken_out(scene: Scene) -> None:
    """By the search of the surface itself: what the guard measures is not asked."""
    problem, sound = one_step(scene)
    obstacle = problem.step.obstacle
    assert obstacle is not None
    inside = replace(sound, next_pos=pushed_in(sound.next_pos), residual=1.0)
    told = Guard("report", newton(), POTENTIAL)
    assert told.see(1, problem, inside) is inside
    assert (told.alarms[0].cause, told.alarms[0].repair) == (INSIDE, NOT_TRIED)
    assert told.alarms[0].value > DEPTH_LIMIT
    guard = Guard("repair", guess(12), POTENTIAL)
    better = guard.see(1, problem, inside)
    assert (guard.alarms[0].cause, guard.alarms[0].repair) == (INSIDE, REFINED)
    later = replace(obstacle, pos=obstacle.next_pos)
    depth = -find_contact(better.next_pos, problem.cloth.vertex_scene, later).dist
    assert float(depth.max()) < 3e-3


@pytest.mark.parametrize("always", [False, True])
def test_a_repair_that_leads_deeper_into_the_body_is_not_taken(
    always: bool, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, sound = one_step(scene)
    wild = replace(sound, next_pos=sound.next_pos * 1.3, residual=80.0)  # strained, in front of the body
    assert not problem.next_depth(wild.next_pos) > DEPTH_LIMIT
    calls = []

    def into_the_body(*given: Any) -> RepairedStep:
        calls.append(given[1])
        found = repair_step(*given)
        pos = pushed_in(sound.next_pos) if always or len(calls) == 1 else found.prediction.next_pos
        return replace(found, kind=REFINED, prediction=replace(found.prediction, next_pos=pos))

    monkeypatch.setattr(guard_module, "repair_step", into_the_body)
    monkeypatch.setattr(StepProblem, "with_entered", lambda known, pos: replace(known))
    guard = Guard("repair", guess(3), POTENTIAL, SETTINGS)
    kept = guard.see(1, problem, wild)
    assert [one is problem for one in calls] == [True, False]  # the second try knows of the skin
    assert not problem.next_depth(kept.next_pos) > DEPTH_LIMIT
    assert (kept is wild) == always
    assert guard.alarms[0].repair == (LEFT if always else REFINED)


def test_cut_cloth_is_told_where_it_is_measured() -> None:
    guard = Guard("report", newton(), POTENTIAL)
    for row in ({}, {"cut_face_share": math.nan}, {"cut_face_share": 0.01}, {"cut_face_share": 0.5}):
        guard.see_surface(7, row)
    assert [(alarm.frame, alarm.cause, alarm.value) for alarm in guard.alarms] == [(7, CUT, 0.5)]


def drawn_in(pos: torch.Tensor) -> torch.Tensor:
    """All of it 8 mm backwards: triangles of its front are in the skin, and no vertex is as deep as a guard minds."""
    return pos - torch.tensor([0.0, 0.0, 0.008]).to(pos)


def in_skin(problem: StepProblem, pos: torch.Tensor) -> float:
    return int(problem.num_in_skin(pos)) / len(problem.cloth.faces)


def test_triangles_in_the_skin_are_taken_out_by_a_repair_alone(scene: Scene) -> None:
    problem, sound = one_step(scene)
    cut = replace(sound, next_pos=drawn_in(sound.next_pos), residual=1.0)
    share = in_skin(problem, cut.next_pos)
    assert in_skin(problem, sound.next_pos) <= CUT_SHARE < share
    told = Guard("report", guess(12), POTENTIAL)
    assert told.see(1, problem, cut) is cut
    assert told.alarms == []
    guard = Guard("repair", guess(12), POTENTIAL)
    better = guard.see(1, problem, cut)
    (alarm,) = guard.alarms
    assert (alarm.frame, alarm.cause, alarm.repair) == (1, CUT, REFINED)
    assert (alarm.value, alarm.limit) == (pytest.approx(share), CUT_SHARE)
    assert alarm.rg_after < alarm.rg_before
    assert better.held_off is not None
    assert in_skin(problem, better.next_pos) <= CUT_SHARE
    hasty = Guard("repair", guess(12), POTENTIAL, most=1)
    assert hasty.see(1, problem, cut) is cut
    assert [(alarm.cause, alarm.repair) for alarm in hasty.alarms] == [(CUT, LEFT)]
    solver = Guard("repair", newton(), POTENTIAL)
    assert solver.see(1, problem, replace(cut, residual=0.0)).next_pos is cut.next_pos


def test_the_limit_follows_the_level_of_the_rollout(scene: Scene) -> None:
    """What is usual in this rollout is no alarm, five times of it is."""
    guard = Guard("report", guess(1), POTENTIAL)
    problem, prediction = one_step(scene)
    level: Iterator[float] = iter([40.0] * 12 + [150.0, 250.0])
    for frame, residual in enumerate(level, start=1):
        guard.see(frame, problem, replace(prediction, residual=residual))
    assert [(alarm.frame, alarm.cause) for alarm in guard.alarms] == [(14, FORCE)]
    assert guard.alarms[0].limit == pytest.approx(200.0)


def test_an_unknown_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="guard is 'off'; choose report, repair, strict"):
        Guard("off", newton(), POTENTIAL)


def test_its_time_has_a_column(scene: Scene) -> None:
    stepper = newton()
    rows = [frame.metrics for frame in frames(stepper, scene, Guard("report", stepper, POTENTIAL), 3)]
    assert set(rows[2]) <= set(metric_names(POTENTIAL, stepper, "none", guarded=True))
    parts = [rows[2][f"ms_{part}"] for part in ("search", "solver", "rest", "guard")]
    assert rows[2]["ms_total"] == pytest.approx(np.sum(parts))
    assert "ms_guard" not in frames(stepper, scene, None, 3)[2].metrics

"""Training that meets what is not finite, a full disk, a damaged checkpoint: skipped, taken back, reported, never silent."""

from __future__ import annotations

import errno
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import build_simulator
from hood.training.checkpoint import load_checkpoint, previous
from hood.training.curriculum import CollisionRamp, Horizon, WarmupCosine
from hood.training.outcome import Skipped, told
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings
from hood.training.trainer import Trainer

SETTINGS = TrainerSettings(
    iterations=10, batch_size=1, learning_rate=1e-3, schedule=WarmupCosine(3), horizon=Horizon(every=100, maximum=2, start=2),
    collision=CollisionRamp(), signal="scaled", ema_decay=0.9, statistics_iterations=0, checkpoint_every=3, log_every=1,
    max_skipped=3, max_rollbacks=2,
)  # fmt: skip


class Fault:
    """An energy that is 0 but at the calls ``when`` says: a loss or a gradient without a number there. What friction asks of
    all energies before the step is no call."""

    def __init__(self, when: Callable[[int], bool], loss: float = 0.0, slope: float = 0.0) -> None:
        self.when, self.loss, self.slope = when, loss, slope
        self.calls = 0

    def applies(self, problem: StepProblem) -> bool:
        return True

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        before_the_step = problem.contact is not None and problem.internal_force is None
        self.calls += not before_the_step
        bad = not before_the_step and self.when(self.calls)
        slope = self.slope if bad else 0.0
        varying = slope * (next_pos - next_pos.detach()).sum()
        return (varying + (self.loss if bad else 0.0)).expand(problem.num_scenes)


def make(folder: Path, sampler: SceneSampler, fault: Fault | None = None, settings: TrainerSettings = SETTINGS) -> Trainer:
    torch.manual_seed(0)
    # The paper's features do not look at the potential: a fault is called once an update.
    simulator = build_simulator("paper", "velocity_base", "1x(mesh+coarse0)", latent_dim=8, output_init=0.1)
    potential = default_potential() if fault is None else default_potential().with_terms(fault=fault)
    return Trainer(simulator, potential, sampler, settings, folder, 0)


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def weights(trainer: Trainer) -> Tensor:
    return torch.cat([p.detach().reshape(-1) for p in trainer.simulator.parameters()])


@pytest.mark.parametrize(
    "fault", [{"loss": math.inf}, {"loss": math.nan}, {"slope": math.nan}], ids=["infinite loss", "NaN loss", "NaN gradient"]
)
def test_an_update_without_a_number_is_skipped_and_counted(fault: dict, tmp_path: Path, sampler: SceneSampler) -> None:
    trainer = make(tmp_path, sampler, Fault(lambda call: call in (3, 4), **fault))
    seen = [weights(trainer)]

    def watch(iteration: int, report: dict[str, float] | None) -> None:
        seen.append(weights(trainer))

    assert trainer.run(watch)
    assert trainer.skipped == 2
    assert trainer.rollbacks == 0
    assert [record["skipped"] for record in lines(tmp_path)] == [0, 0, 1, 2, 2, 2, 2, 2, 2, 2]
    moved = [not torch.equal(a, b) for a, b in zip(seen, seen[1:], strict=False)]
    assert moved == [True, True, False, False, True, True, True, True, True, True]
    assert bool(torch.isfinite(weights(trainer)).all())


def test_too_many_in_a_row_go_back_to_the_last_good_checkpoint(
    tmp_path: Path, sampler: SceneSampler, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three bad updates from the fifth on: back to iteration 3, on with other scenes, and then to the end."""
    trainer = make(tmp_path, sampler, Fault(lambda call: call in (5, 6, 7), loss=math.nan))
    draws_at_checkpoint = {}

    def watch(iteration: int, report: dict[str, float] | None) -> None:
        if iteration == 5 and not draws_at_checkpoint:
            state = load_checkpoint(trainer.checkpoint_path)
            assert state["iteration"] == 3
            draws_at_checkpoint.update({i: entry["draws"] for i, entry in state["slots"].items()})

    assert trainer.run(watch)
    assert (trainer.iteration, trainer.skipped, trainer.rollbacks) == (10, 3, 1)
    assert "iteration 7 is not finite; back to iteration 3" in capsys.readouterr().err
    records = lines(tmp_path)
    assert [record["iteration"] for record in records] == [1, 2, 3, 3, *range(4, 11)]
    assert records[3] == {"iteration": 3, "rolled_back_from": 7.0, "rollbacks": 1.0, "skipped": 3.0}
    final = load_checkpoint(trainer.checkpoint_path)
    assert final["rollbacks"] == [1, 0, 7]  # passing iteration 7 forgives
    assert final["slots"][0]["draws"] > draws_at_checkpoint[0] + 2


def test_going_back_is_deterministic_and_moves_on(tmp_path: Path, sampler: SceneSampler) -> None:
    def run(name: str) -> tuple[Tensor, list[dict]]:
        trainer = make(tmp_path / name, sampler, Fault(lambda call: call in (5, 6, 7), slope=math.nan))
        assert trainer.run()
        records = [{k: v for k, v in r.items() if k != "iterations_per_second"} for r in lines(tmp_path / name)]
        return weights(trainer), records

    (first, first_log), (second, second_log) = run("a"), run("b")
    assert torch.equal(first, second)
    assert first_log == second_log
    plain = make(tmp_path / "plain", sampler)
    assert plain.run()
    undisturbed = {r["iteration"]: r["total"] for r in lines(tmp_path / "plain")}
    disturbed = {r["iteration"]: r["total"] for r in first_log if "total" in r}
    assert disturbed[3] == undisturbed[3]
    assert disturbed[4] != undisturbed[4], "the same scenes again"


def test_weights_without_numbers_go_back_at_once(tmp_path: Path, sampler: SceneSampler) -> None:
    trainer = make(tmp_path, sampler)
    poisoned = []

    def poison(iteration: int, report: dict[str, float] | None) -> None:
        if iteration == 4 and not poisoned:
            poisoned.append(iteration)
            with torch.no_grad():
                next(trainer.simulator.parameters()).fill_(math.nan)

    assert trainer.run(poison)
    assert (trainer.skipped, trainer.rollbacks) == (1, 1)
    assert bool(torch.isfinite(weights(trainer)).all())
    assert all(bool(torch.isfinite(v).all()) for v in load_simulator(tmp_path / "model.safetensors").state_dict().values())


@pytest.mark.parametrize("iteration", [6, 10], ids=["at a checkpoint", "at the end"])
def test_weights_without_numbers_are_never_saved(iteration: int, tmp_path: Path, sampler: SceneSampler) -> None:
    """The update itself may break them: losses were finite then, so only a look at the weights can tell."""
    trainer = make(tmp_path, sampler)
    real, done = trainer.optimizer.step, []

    def broken() -> None:
        real()
        if trainer.iteration == iteration - 1 and not done:
            done.append(iteration)
            with torch.no_grad():
                next(trainer.simulator.parameters()).fill_(math.inf)

    trainer.optimizer.step = broken  # type: ignore[method-assign, assignment]
    assert trainer.run()
    assert trainer.rollbacks == 1
    for path in (trainer.checkpoint_path, previous(trainer.checkpoint_path)):
        assert all(bool(torch.isfinite(v).all()) for v in load_checkpoint(path)["simulator"].values())


def test_training_that_never_stays_finite_ends_with_one_sentence(tmp_path: Path, sampler: SceneSampler) -> None:
    trainer = make(tmp_path, sampler, Fault(lambda call: call > 7, loss=math.nan))
    with pytest.raises(ValueError, match=r"9 updates skipped, 2 times back .* past iteration 10.*checkpoint\.pt") as error:
        trainer.run()
    assert "\n" not in str(error.value)
    # First back to the newest checkpoint, then to the one before it.
    back = [record["iteration"] for record in lines(tmp_path) if "rolled_back_from" in record]
    assert back == [3]  # the line of the first return, to 6, was cut off by the second
    assert load_checkpoint(trainer.checkpoint_path)["iteration"] == 6


def test_training_that_makes_no_update_is_no_success(tmp_path: Path, sampler: SceneSampler) -> None:
    """Fewer updates than lead back to a checkpoint; nor is it one when it is resumed."""
    settings, why = replace(SETTINGS, iterations=2), "energy fault is nan"
    trainer = make(tmp_path, sampler, Fault(lambda call: True, loss=math.nan), settings)
    start = weights(trainer)
    with pytest.raises(ValueError, match=rf"2 of 2 updates were skipped \(iteration 2: {why}\); .*model\.safetensors"):
        trainer.run()
    assert torch.equal(weights(trainer), start)
    again = make(tmp_path, sampler, settings=settings)
    again.resume(again.checkpoint_path)
    with pytest.raises(ValueError, match=rf"2 of 2 updates were skipped \(iteration 2: {why}\)"):
        again.run()


def test_the_reason_is_the_energy_or_else_the_gradient() -> None:
    skips = Skipped()
    skips.skip(3, {"inertia": 1.0, "wind": math.inf}, math.nan)
    assert skips.reason == "iteration 3: energy wind is inf"
    skips.skip(4, {"inertia": 1.0}, math.inf)
    assert skips.reason == "iteration 4: the length of the gradient is inf"
    skips.skip(5, {"inertia": 1.0}, 1.0)  # another process saw it
    assert told([skips.reason, "iteration 5: energy wind is nan"]) == " (iteration 5: energy wind is nan)"
    assert (skips.count, skips.in_row, skips.made, told([""])) == (3, 3, 0, "")


def test_one_update_that_is_made_is_a_training(tmp_path: Path, sampler: SceneSampler) -> None:
    trainer = make(tmp_path, sampler, Fault(lambda call: call == 1, loss=math.nan), replace(SETTINGS, iterations=2))
    assert trainer.run()
    assert trainer.why_skipped() == " (iteration 1: energy fault is nan)"


def test_a_streak_goes_on_over_a_resume(tmp_path: Path, sampler: SceneSampler) -> None:
    """Two skipped updates, a stop, one more: that is three in a row."""
    first = make(tmp_path, sampler, Fault(lambda call: call in (5, 6), loss=math.nan))
    assert not first.run(should_stop=lambda: first.iteration >= 6)
    second = make(tmp_path, sampler, Fault(lambda call: call == 1, loss=math.nan))
    second.resume(second.checkpoint_path)
    assert second.run()
    assert (second.skipped, second.rollbacks) == (3, 1)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("name", ["checkpoint.pt", "model.safetensors", "metrics.jsonl"])
def test_a_full_disk_ends_training_with_the_last_checkpoint_intact(name: str, tmp_path: Path, sampler: SceneSampler) -> None:
    trainer = make(tmp_path, sampler)

    def fill(iteration: int, report: dict[str, float] | None) -> None:
        if iteration == 5:
            (tmp_path / f"{name}.partial").symlink_to("/dev/full")
            if name == "metrics.jsonl":
                assert trainer.reporter._metrics is not None
                trainer.reporter._metrics._file = open("/dev/full", "ab", buffering=0)

    with pytest.raises(OSError, match=name) as error:
        trainer.run(fill)
    assert error.value.errno == errno.ENOSPC
    state = load_checkpoint(trainer.checkpoint_path)
    assert state["iteration"] == (6 if name == "model.safetensors" else 3)
    load_simulator(tmp_path / "model.safetensors")
    (tmp_path / f"{name}.partial").unlink(missing_ok=True)
    again = make(tmp_path, sampler)
    again.resume(again.checkpoint_path)
    assert again.run()
    assert [record["iteration"] for record in lines(tmp_path)] == list(range(1, 11))


def test_a_damaged_checkpoint_costs_one_interval(
    tmp_path: Path, sampler: SceneSampler, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = make(tmp_path / "whole", sampler)
    assert whole.run()
    first = make(tmp_path / "run", sampler)
    assert not first.run(should_stop=lambda: first.iteration >= 6)
    path = first.checkpoint_path
    path.write_bytes(path.read_bytes()[:1000])
    second = make(tmp_path / "run", sampler)
    second.resume(path)
    assert second.iteration == 3
    assert "going on from checkpoint.previous.pt, iteration 3" in capsys.readouterr().err
    assert second.run()
    assert torch.equal(weights(second), weights(whole))

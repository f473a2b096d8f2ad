"""Updates that the host reads late: the device takes back what must not be used, and rollouts that are lost wait."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.energies.potential import default_potential
from hood.model.graph.static_shapes import Capacity
from hood.steppers.network import NetworkStepper, build_simulator
from hood.training import updates
from hood.training.curriculum import CollisionRamp, Horizon, StepDecay
from hood.training.optimiser import WeightSteps, make_optimizer
from hood.training.outcome import StartedUpdate, read_figures
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings, make_whitening
from hood.training.trainer import Trainer
from hood.training.updates import CapturedUpdates

SETTINGS = TrainerSettings(
    iterations=13, learning_rate=1e-3, schedule=StepDecay(), horizon=Horizon(start=3, every=1000), ema_decay=0.9,
    collision=CollisionRamp(), statistics_iterations=1, log_every=4, checkpoint_every=8, step="fixed",
)  # fmt: skip


def model(scale: float = 1e-3) -> NetworkStepper:
    """The paper's, which predicts next to nothing at first."""
    torch.manual_seed(0)
    made = build_simulator("paper", "acceleration", "1x(mesh+coarse0)", latent_dim=8).train()
    with torch.no_grad():
        for name, value in made.network.named_parameters():
            if name.startswith("decoder"):
                value.mul_(scale)
    return made


@pytest.fixture(scope="module")
def scenes(body: Body, garments: dict[str, Garment], walk: PoseSequence) -> SceneSampler:
    return SceneSampler(body, [garments["tank"], garments["skirt"]], [walk.window(0, 90)])


@pytest.fixture
def make(scenes: SceneSampler, tmp_path: Path) -> Callable[..., Trainer]:
    def made(name: str, scale: float = 1e-3, **settings: Any) -> Trainer:
        chosen = replace(SETTINGS, **settings)
        return Trainer(model(scale), default_potential(), scenes, chosen, tmp_path / name, 0)

    return made


@pytest.fixture
def late(monkeypatch: pytest.MonkeyPatch) -> None:
    """A CPU reads as late as a GPU."""
    monkeypatch.setattr(CapturedUpdates, "reads_late", property(lambda self: True))


def learned(trainer: Trainer) -> list[Tensor]:
    states = [value for p in trainer.simulator.parameters() for value in trainer.optimizer.state[p].values()]
    tensors = [value for value in states if isinstance(value, Tensor)]
    return [value.clone() for value in (*trainer.simulator.parameters(), *tensors, *trainer._steps.average.values())]


@pytest.mark.parametrize("batch_size", [1, 2])
def test_late_or_at_once_the_same_is_learned(
    make: Callable[..., Trainer], batch_size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_once = make("at once", batch_size=batch_size)
    assert at_once.run()
    monkeypatch.setattr(CapturedUpdates, "reads_late", property(lambda self: True))
    late = make("late", batch_size=batch_size)
    reads = []

    def counted(begun: list[StartedUpdate]) -> None:
        reads.append(len(begun))
        read_figures(begun)

    monkeypatch.setattr("hood.training.trainer.read_figures", counted)
    assert late.run()
    assert reads == [1, 3, 4, 4, 1]  # the first collects statistics; then every log interval, and the end
    assert all(torch.equal(one, other) for one, other in zip(learned(at_once), learned(late), strict=True))
    records = [(trainer.folder / "metrics.jsonl").read_text().count("\n") for trainer in (at_once, late)]
    assert records == [4, 4]
    assert late.made == at_once.made == 12


def test_a_lost_rollout_waits_for_the_next_read(make: Callable[..., Trainer], late: None) -> None:
    trainer = make("lost", torn_strain=1e-6)
    trainer.update()
    for _ in range(3):
        trainer.begin()
    before = learned(trainer)
    reports = trainer.look()
    assert [report["waiting"] for report in reports] == [0.0, 1.0, 1.0]
    assert math.isnan(reports[1]["loss"])
    assert trainer.made == 1
    assert trainer.skipped == 0
    trainer.begin()  # another rollout
    assert trainer.look()[0]["waiting"] == 0.0
    assert trainer.made == 2
    assert not all(torch.equal(one, other) for one, other in zip(before, learned(trainer), strict=True))


def test_waiting_changes_nothing_of_what_is_learned(make: Callable[..., Trainer], late: None) -> None:
    trainer = make("still", torn_strain=1e-6)
    trainer.update()
    trainer.begin()
    after_one = learned(trainer)
    for _ in range(3):
        trainer.begin()
    trainer.look()
    assert all(torch.equal(one, other) for one, other in zip(after_one, learned(trainer), strict=True))


def test_what_is_not_finite_is_taken_back(make: Callable[..., Trainer], late: None) -> None:
    trainer = make("poisoned")
    for _ in range(2):
        trainer.update()
    before = learned(trainer)
    (slot,) = trainer.slots._slots.values()
    assert slot.state is not None
    slot.state.vel.fill_(torch.inf)
    trainer.begin()
    trainer.begin()
    reports = trainer.look()
    assert [report["waiting"] for report in reports] == [0.0, 1.0]
    assert trainer.skipped == 1
    assert reports[-1]["skipped"] == 1.0
    assert "iteration 3" in trainer.why_skipped()
    assert all(torch.equal(one, other) for one, other in zip(before, learned(trainer), strict=True))


def test_a_gradient_that_is_not_finite_is_skipped_where_the_energies_are(
    make: Callable[..., Trainer], late: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = make("gradient")
    for _ in range(2):
        trainer.update()
    before = learned(trainer)
    surrogate_of = updates.surrogate_of
    monkeypatch.setattr(updates, "surrogate_of", lambda *given: torch.inf * surrogate_of(*given))
    report = trainer.update()
    assert math.isfinite(report["total"])
    assert (trainer.skipped, trainer.made) == (1, 1)
    assert "length of the gradient is nan" in trainer.why_skipped()
    assert all(torch.equal(one, other) for one, other in zip(before, learned(trainer), strict=True))


def test_a_rollout_without_room_ends_and_the_next_has_it(
    make: Callable[..., Trainer], late: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(updates, "first_capacity", lambda *_: Capacity(2, 2))
    trainer = make("room")
    trainer.update()
    draws = [slot.draws for slot in trainer.slots._slots.values()]
    reports = [trainer.update() for _ in range(12)]
    waited = [report["waiting"] for report in reports]
    assert waited[0] == 1.0
    assert sum(waited) <= 4  # two garments and their mirror images
    assert waited[-1] == 0.0
    assert [slot.draws for slot in trainer.slots._slots.values()] > draws
    assert trainer.made == 12 - sum(waited)


@pytest.mark.parametrize("name", ["adam", "muon"])
def test_steps_are_taken_back_to_the_last_bit(name: str) -> None:
    """Also the first, before which the optimiser has no state; the next one is as if there had been none."""
    trained = {}
    for refused in (False, True):
        simulator = model(1.0)
        optimizer = make_optimizer(name, simulator, 1e-2)
        steps = WeightSteps(simulator, optimizer, make_whitening(simulator, False), 0.9)
        for number, wanted in enumerate([False, True, False, True]):
            if not (wanted or refused):
                continue
            torch.manual_seed(number)
            for p in simulator.parameters():
                p.grad = torch.randn_like(p)
            steps.take(number, torch.tensor(wanted))
            steps.forget(not wanted)
        trained[refused] = [*(p.detach() for p in simulator.parameters()), *steps.average.values()]
    assert all(torch.equal(one, other) for one, other in zip(trained[False], trained[True], strict=True))


def test_a_training_ends_where_it_has_read(make: Callable[..., Trainer], late: None) -> None:
    """Whatever is asked between: a resumed run then takes the same updates."""
    whole = make("whole")
    assert whole.run()
    half = make("half")
    assert not half.run(should_stop=lambda: half.iteration > 1)
    assert half.iteration == 4
    resumed = make("half")
    resumed.resume(resumed.checkpoint_path)
    assert resumed.run()
    assert all(torch.equal(one, other) for one, other in zip(learned(whole), learned(resumed), strict=True))

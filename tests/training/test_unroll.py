"""Losses that look at several steps: their gradient, what an exact network gets, and what stays as it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, State, StepInput
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import SignedSelfContactPenalty
from hood.model.features.normalizer import RunningNormalizer
from hood.model.readout import edges
from hood.solver.newton import NewtonSettings, minimize
from hood.steppers.network import NetworkStepper, Prediction, build_simulator
from hood.tensors import dense
from hood.tensors.batch import without_gradient
from hood.tensors.conjugate_gradients import Steps
from hood.testing import grid
from hood.training import updates
from hood.training.curriculum import CollisionRamp, Horizon, WarmupCosine
from hood.training.outcome import Signal
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings
from hood.training.slots import Slots, TrainingStep
from hood.training.trainer import Trainer
from hood.training.updates import further_loss, plain_update

REAL = torch.float64
PAPER = {"features": "paper", "output": "acceleration"}
MODELS = {
    "paper": PAPER,
    "velocity": {"features": "physical", "output": "velocity_base"},
    "edges": {"features": "physical", "output": "edges"},
    "local": {"features": "local", "output": "edges"},
}
SETTINGS = TrainerSettings(
    iterations=4, batch_size=2, learning_rate=1e-3, schedule=WarmupCosine(3), horizon=Horizon(every=3, maximum=3),
    collision=CollisionRamp(5e5, 5e5), signal="scaled", ema_decay=0.9, statistics_iterations=1, checkpoint_every=100,
    log_every=1, unroll=2,
)  # fmt: skip


class Straight:
    """What is ahead on a body that moves on."""

    def __init__(self, there: bool = True) -> None:
        ball = trimesh.creation.icosphere(2, 0.15)
        self._points = torch.tensor(np.array(ball.vertices)) + torch.tensor([0.1, 0.1, -0.151], dtype=REAL)
        self._faces, self._there = torch.tensor(np.array(ball.faces), dtype=torch.int64), there

    def velocity(self, next_vel: Tensor) -> Tensor:
        return next_vel

    def step(self, number: int, pos: Tensor) -> tuple[StepInput, Tensor]:
        none = torch.zeros(len(self._points), dtype=torch.int64)
        way = torch.tensor([0.0, 0.002, 0.002], dtype=REAL)
        now, after, before = (self._points + (number + step) * way for step in (0, 1, -1))
        obstacle = Obstacle(now, after, before, self._faces, none, torch.zeros_like(self._faces[:, 0]), none > 0)
        return StepInput(torch.full((1,), 1 / 30, dtype=REAL), obstacle), torch.tensor([self._there])


def tiny(options: dict[str, Any]) -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator(**{"schedule": "2x(mesh)", "latent_dim": 8, **options})


def scene(simulator: NetworkStepper, ahead: Straight) -> TrainingStep:
    """A sheet that is bent, moves and touches a ball."""
    torch.manual_seed(1)
    pos, faces = grid(5, 5, 0.2)
    cloth = build_cloth(pos @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]).T, faces, Material(), dtype=REAL)
    start, vel = (scale * torch.randn(cloth.rest_pos.shape, dtype=REAL) for scale in (1e-3, 0.1))
    state = State(cloth.rest_pos + start, vel, torch.zeros(1, 3, dtype=REAL))
    return TrainingStep(cloth, simulator.prepare(cloth, pos), state, ahead.step(0, vel)[0], ahead=ahead)  # type: ignore[arg-type]


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Solves that are iterated to their end: derivatives are those of their results."""
    monkeypatch.setattr(updates, "_NEAR", NewtonSettings(target_rg=1e-10, max_iterations=100))
    monkeypatch.setattr(edges, "_STEPS", Steps(40.0, 200))


def in_double(options: dict[str, Any]) -> NetworkStepper:
    simulator = tiny(options).double().train()
    for module in simulator.modules():
        if isinstance(module, RunningNormalizer):
            module.set_statistics(torch.zeros(module.width), torch.full((module.width,), 1e-2))
    return simulator


@pytest.mark.parametrize("model, unroll", [("paper", 3), ("velocity", 3), ("edges", 2), ("local", 2)])
def test_the_gradient_is_that_of_the_stated_loss(model: str, unroll: int, exact: None) -> None:
    """By the longest gradients of weights, along a direction."""
    simulator, potential, signal = in_double(MODELS[model]), default_potential(), Signal("potential")
    part = scene(simulator, Straight())

    def loss() -> Tensor:
        problem = potential.prepare(StepProblem(part.cloth, part.state, part.step, gravity=simulator.gravity))
        prediction = simulator.predict(problem, part.prepared)
        energies = potential.energies(problem, prediction.next_pos.detach())
        assert float(energies["collision"] + energies["friction"]) > 0
        first, given = potential.total(problem, prediction.next_pos).sum(), (problem, prediction)
        return (first + further_loss(simulator, part, potential, signal, 9.0, given, unroll - 1)).detach()

    update = plain_update(simulator, simulator, part, potential, signal, 9.0, unroll=unroll)
    assert update.backward is not None
    update.backward()
    weights = [weight for weight in simulator.parameters() if weight.grad is not None]
    for weight in sorted(weights, key=lambda one: -float(one.grad.norm()))[:3]:
        way = torch.nn.functional.normalize(torch.randn_like(weight), dim=None)  # type: ignore[arg-type]
        found, values = (weight.grad * way).sum(), []
        for step in (1e-5, -1e-5):
            weight.data.add_(step * way)
            values.append(loss())
            weight.data.sub_(step * way)
        assert float(found) == pytest.approx(float(values[0] - values[1]) / 2e-5, rel=1e-6)


def test_the_way_back_takes_the_parts_of_the_way_forth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrays of several blocks: the first step goes through them by blocks, further ones at once."""
    found = []
    for unit in (dense.UNIT, 16):
        monkeypatch.setattr(dense, "UNIT", unit)
        monkeypatch.setattr(dense, "BLOCK_BYTES", 1)
        simulator, potential = in_double(MODELS["local"]), default_potential()
        part = scene(simulator, Straight())
        update = plain_update(simulator, simulator, part, potential, Signal("potential"), 9.0, unroll=2)
        assert update.backward is not None
        update.backward()
        found.append(torch.cat([weight.grad.flatten() for weight in simulator.parameters() if weight.grad is not None]))
    torch.testing.assert_close(found[0], found[1], rtol=1e-6, atol=1e-10)


class Exact(torch.nn.Module):
    """A network that takes every step to its minimum, and ``off`` (V, 3) [m] from it."""

    def __init__(self, like: NetworkStepper, potential: Potential, count: int) -> None:
        super().__init__()
        self.gravity, self.next_velocity, self._potential = like.gravity, like.next_velocity, potential
        self.off = torch.nn.Parameter(torch.zeros(count, 3, dtype=REAL))

    def predict(self, problem: StepProblem, prepared: object, watch: object = None) -> Prediction:
        pos = minimize(self._potential, without_gradient(problem), settings=NewtonSettings(target_rg=1e-10))[0] + self.off
        return Prediction(pos, problem.acceleration(pos))


@pytest.mark.parametrize("off, bound", [(0.0, 1e-9), (1e-4, None)])
def test_an_exact_network_has_no_further_loss(off: float, bound: float | None, exact: None) -> None:
    """Neither itself, nor a gradient by the state that it came to; any other has some."""
    simulator, potential = in_double(MODELS["velocity"]), default_potential()
    part = scene(simulator, Straight())
    network = Exact(simulator, potential, part.cloth.num_vertices)
    problem = potential.prepare(StepProblem(part.cloth, part.state, part.step, gravity=simulator.gravity))
    began = network.predict(problem, None)
    reached = replace(began, next_pos=began.next_pos.detach().requires_grad_())
    reached = replace(reached, acc=problem.acceleration(reached.next_pos))
    with torch.no_grad():
        network.off += off * torch.randn_like(network.off)
    loss = further_loss(network, part, potential, Signal("scaled"), 9.0, (problem, reached), 1)  # type: ignore[arg-type]
    gradients = torch.autograd.grad(loss, [reached.next_pos, network.off])
    if bound is None:
        assert float(loss.detach()) > 1e-3
        assert all(float(one.norm()) > 1.0 for one in gradients)
    else:
        assert 0 <= float(loss.detach()) + 1e-12 < bound
        assert all(float(one.norm()) < 1e3 * bound for one in gradients)


@pytest.mark.parametrize("there, torn", [(False, 9.0), (True, 1e-9)], ids=["the motion ends", "torn"])
def test_scenes_that_end_have_no_further_loss(there: bool, torn: float) -> None:
    simulator, potential = in_double(MODELS["velocity"]), default_potential()
    part = scene(simulator, Straight(there))
    gradients = []
    for unroll in (1, 3):
        simulator.zero_grad()
        update = plain_update(simulator, simulator, part, potential, Signal("scaled"), torn, unroll=unroll)
        assert update.backward is not None
        update.backward()
        gradients.append([weight.grad for weight in simulator.parameters() if weight.grad is not None])
    assert all(torch.equal(one, other) for one, other in zip(*gradients, strict=True))


def make(folder: Path, sampler: SceneSampler, options: dict[str, Any] = PAPER, **changed: Any) -> Trainer:
    return Trainer(tiny(options), default_potential(), sampler, replace(SETTINGS, **changed), folder, 0)


def weights(trainer: Trainer) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in trainer.simulator.state_dict().items()}


def test_what_an_update_takes_is_one_step_all_the_same(tmp_path: Path, sampler: SceneSampler) -> None:
    """Rollouts and statistics are those of one step; weights are not."""
    after = {}
    for unroll in (1, 2):
        trainer = make(tmp_path, sampler, unroll=unroll)
        reports = [trainer.update() for _ in range(2)]
        after[unroll] = weights(trainer), trainer.slots.state_dict(), reports
    (ones, slots, reports), (others, other_slots, other_reports) = after[1], after[2]
    assert reports[-1]["loss"] == other_reports[-1]["loss"]
    assert reports[-1]["parameter_gradient_norm"] != other_reports[-1]["parameter_gradient_norm"]
    for index, entry in slots.items():
        assert entry["age"] == other_slots[index]["age"] == 2
        assert torch.equal(entry["pos"], other_slots[index]["pos"])
    normalizers = [name for name in ones if "normalizer" in name]
    assert normalizers
    assert all(torch.equal(ones[name], others[name]) for name in normalizers)
    assert any(not torch.equal(ones[name], others[name]) for name in ones)


def test_one_step_asks_for_no_other(tmp_path: Path, sampler: SceneSampler, monkeypatch: pytest.MonkeyPatch) -> None:
    class Asked(Exception):
        pass

    def further_loss(*arguments: Any) -> None:
        raise Asked

    monkeypatch.setattr(updates, "further_loss", further_loss)
    make(tmp_path, sampler, unroll=1, statistics_iterations=0).update()
    with pytest.raises(Asked):
        make(tmp_path, sampler, unroll=2, statistics_iterations=0).update()


@pytest.mark.parametrize("changed", [{}, {"precision": "bf16", "activation_checkpointing": True}], ids=["fp32", "bf16"])
def test_a_resumed_run_is_the_uninterrupted_one(changed: dict[str, Any], tmp_path: Path, sampler: SceneSampler) -> None:
    whole = make(tmp_path / "whole", sampler, **changed)
    assert whole.run()
    begun = make(tmp_path / "begun", sampler, **changed)
    assert not begun.run(should_stop=lambda: begun.iteration == 2)
    resumed = make(tmp_path / "begun", sampler, **changed)
    resumed.resume(resumed.checkpoint_path)
    assert resumed.run()
    assert whole.made == resumed.made == 3
    for name, value in weights(whole).items():
        assert torch.equal(value, resumed.simulator.state_dict()[name]), name


def test_latents_that_are_computed_again_give_the_same(tmp_path: Path, sampler: SceneSampler) -> None:
    found = []
    for on in (False, True):
        trainer = make(tmp_path, sampler, MODELS["local"], activation_checkpointing=on)
        trainer.update()
        found.append(weights(trainer))
    assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())


@pytest.mark.parametrize("maximum", [1, 2])
def test_a_horizon_shorter_than_what_is_looked_at(maximum: int, tmp_path: Path, sampler: SceneSampler) -> None:
    slots = Slots(sampler, tiny(PAPER), 2, 0, maximum)
    ahead = slots.batch(maximum).ahead
    assert ahead is not None
    there = [ahead.step(number, slots.batch(maximum).state.pos)[1].tolist() for number in (1, 2, 3)]
    assert there == [[number <= maximum] * 2 for number in (1, 2, 3)]
    trainer = make(tmp_path, sampler, horizon=Horizon(every=1, maximum=maximum), unroll=4)
    assert all(np.isfinite(list(trainer.update().values())).all() for _ in range(maximum + 2))


@pytest.mark.parametrize("changed, said", [
    ({"unroll": 0}, "trainer.unroll is 0; it must be at least 1"),
    ({"step": "captured"}, "trainer.step=captured with trainer.unroll=2: further steps are taken operation by operation; give"),
    ({"step": "fixed"}, "trainer.step=fixed with trainer.unroll=2"),
])  # fmt: skip
def test_settings_that_are_refused(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        replace(SETTINGS, **changed)


@pytest.mark.parametrize("options, potential, ranks, said", [
    ({"features": "local", "output": "local_steps", "schedule": "1x(mesh) | 1x(mesh)"}, {}, 1, "passes of a further step"),
    ({"layer_radius": 0.03}, {}, 1, "layers of cloth"),
    ({"frame_dt": 1 / 30}, {}, 1, "counts in frames"),
    ({}, {"layer_sides": SignedSelfContactPenalty()}, 1, "layers of cloth"),
    ({}, default_potential(contact="edges").terms, 1, "contact at edges or faces"),
    ({}, {}, 2, "several processes"),
])  # fmt: skip
def test_what_gradients_cannot_go_through_is_refused(
    options: dict[str, Any], potential: dict[str, Any], ranks: int, said: str
) -> None:
    simulator, asked = tiny({**PAPER, **options}), default_potential().with_terms(**potential)
    with pytest.raises(ValueError, match=f"trainer.unroll=2: .*{said}.*; use trainer.unroll=1"):
        SETTINGS.require_unroll(simulator, asked, ranks)
    replace(SETTINGS, unroll=1).require_unroll(simulator, asked, ranks)


def test_updates_are_taken_operation_by_operation(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a device that has graphs as well."""
    monkeypatch.setattr(updates, "has_graphs", lambda _: True)
    assert updates.make_captured(tiny(PAPER), SETTINGS, 1.5) is None
    assert updates.make_captured(tiny(PAPER), replace(SETTINGS, unroll=1), 1.5) is not None

"""Updates of fixed shapes: gradients, measures and statistics of the plain ones, whatever is drawn anew."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.energies.potential import Potential, coded_potential, default_potential
from hood.energies.self_contact import for_networks
from hood.model.features.normalizer import RunningNormalizer
from hood.model.graph.static_shapes import Capacity
from hood.steppers.network import NetworkStepper, build_simulator
from hood.steppers.static_shapes.cuda_graph import trace
from hood.tensors.dense import assumed
from hood.training import updates
from hood.training.curriculum import CollisionRamp, Horizon, WarmupCosine
from hood.training.outcome import Figures, Signal, StartedUpdate, Update, read_figures
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings
from hood.training.slots import Slots, TrainingStep
from hood.training.trainer import Trainer
from hood.training.updates import CapturedUpdates, make_captured, plain_update

PAPER = {"features": "paper", "output": "acceleration"}
PASSES = {"features": "local", "output": "local_steps", "schedule": "1x(mesh+coarse0) | 1x(mesh)"}
EDGES = {"features": "physical", "output": "edges"}
LEVELS = "1x(mesh+coarse0) 1x(coarse0+coarse1) 1x(mesh+coarse0)"
#: float32 sums in another order; a gradient is compared with the longest of its tensor.
APART = 2e-4
#: A weight of contact that changes.
RAMP = CollisionRamp(1e5, 5e5, 0, 4)


def tiny(options: dict[str, Any]) -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator(**{"schedule": LEVELS, "latent_dim": 8, **options}).train()


@pytest.fixture(scope="module")
def scenes(body: Body, garments: dict[str, Garment], walk: PoseSequence) -> SceneSampler:
    """Two garments, mirrored or not, of all sizes and fabrics."""
    return SceneSampler(body, [garments["tank"], garments["skirt"]], [walk.window(0, 90)])


def figures_of(update: Update) -> Figures:
    begun = StartedUpdate(update, None, {})
    read_figures([begun])
    assert begun.figures is not None
    return begun.figures


def taken(captured: CapturedUpdates, parts: list[TrainingStep], potential: Potential) -> tuple[Update, Figures]:
    """The update, again where there was no room for what it found."""
    for _ in range(2):
        update = captured(parts, potential)
        figures = figures_of(update)
        if all(figures.counted):
            return update, figures
        captured.make_room(update, figures)
    raise AssertionError("no room for the second time")


def both(
    simulator: NetworkStepper, parts: list[TrainingStep], whole: TrainingStep, captured: CapturedUpdates, weight: float
) -> None:
    """An update both ways, from the same weights and statistics: they must agree."""
    potential = CollisionRamp(weight, weight).apply(default_potential(), 0)
    simulator.use_potential(for_networks(potential))
    before = {name: value.clone() for name, value in simulator.named_buffers()}
    simulator.zero_grad(set_to_none=True)
    plain = plain_update(simulator, simulator, whole, potential, captured.signal, captured.torn_strain)
    assert plain.backward is not None
    plain.backward()
    gradients = {name: p.grad for name, p in simulator.named_parameters()}
    counted = {name: value.clone() for name, value in simulator.named_buffers()}
    for name, value in simulator.named_buffers():
        value.copy_(before[name])
    simulator.zero_grad(set_to_none=True)
    fixed, figures = taken(captured, parts, potential)
    assert fixed.backward is None
    expected = figures_of(plain)
    begins = 0
    for part, lost in zip(parts, expected.lost, strict=True):  # those that are lost stay where they were
        rows = slice(begins, begins := begins + part.cloth.num_vertices)
        pos, vel = (part.state.pos, part.state.vel) if lost else (plain.next_pos[rows], plain.next_vel[rows])
        torch.testing.assert_close(fixed.next_pos[rows], pos, rtol=0, atol=2e-6)
        torch.testing.assert_close(fixed.next_vel[rows], vel, rtol=1e-4, atol=1e-4)
    assert figures.measured.keys() == expected.measured.keys()
    for name, value in figures.measured.items():
        if len(parts) == 1 or name not in ("relative_gradient", "output_spread"):  # a mean of scenes, not of all together
            assert value == pytest.approx(expected.measured[name], rel=1e-3, abs=1e-6), name
    assert figures.lost == expected.lost
    torch.testing.assert_close(figures.centres, expected.centres, rtol=0, atol=2e-6)
    # What all of them have in common is rounded: small gradients are sums of large ones that cancel.
    rounding = 1e-5 * max(float(gradient.abs().max()) for gradient in gradients.values() if gradient is not None)
    for name, parameter in simulator.named_parameters():
        expected_gradient = gradients[name]
        if expected_gradient is None:
            assert not parameter.grad.any()
        else:
            most = float(expected_gradient.abs().max())
            torch.testing.assert_close(parameter.grad, expected_gradient, rtol=0, atol=APART * most + rounding, msg=name)
    if len(parts) == 1:
        for name, value in simulator.named_buffers():
            torch.testing.assert_close(value, counted[name], rtol=1e-6, atol=1e-9, msg=name)


@pytest.mark.parametrize("signal", ["potential", "scaled"])
@pytest.mark.parametrize("options", [PAPER, PASSES, EDGES], ids=["paper", "passes", "edges"])
def test_a_scene_alone(options: dict[str, Any], signal: str, scenes: SceneSampler) -> None:
    simulator = tiny(options)
    captured = CapturedUpdates(simulator, Signal(signal), 1.5, "fixed")
    slots = Slots(scenes, simulator, 1, 0, 2, workers=0)
    for _ in range(7):  # more than two scenes of a garment: one plan has to fit several
        parts = slots.each(1)
        both(simulator, parts, parts[0], captured, 5e5)
        slots.advance(parts[0].state.pos + 1e-3, parts[0].state.vel)
    assert len(captured._plans) <= 4


def test_a_rising_weight_of_contact_is_read_anew(scenes: SceneSampler) -> None:
    simulator = tiny(PAPER)
    captured = CapturedUpdates(simulator, Signal("potential"), 1.5, "fixed")
    part = Slots(scenes, simulator, 1, 0, 2, workers=0).each(1)
    for weight in (1e5, 1e6):
        both(simulator, part, part[0], captured, weight)
    assert len(captured._plans) == 1


def test_a_batch_is_the_mean_of_its_scenes(scenes: SceneSampler) -> None:
    simulator = tiny(PASSES)
    captured = CapturedUpdates(simulator, Signal("scaled"), 1.5, "fixed")
    slots = Slots(scenes, simulator, 3, 0, 2, workers=0)
    both(simulator, slots.each(1), slots.batch(1), captured, 5e5)


def test_more_edges_than_places_make_the_update_anew(scenes: SceneSampler, monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = tiny(PAPER)
    monkeypatch.setattr(updates, "first_capacity", lambda *_: Capacity(2, 2))
    captured = CapturedUpdates(simulator, Signal("potential"), 1.5, "fixed")
    parts = Slots(scenes, simulator, 1, 0, 2, workers=0).each(1)
    both(simulator, parts, parts[0], captured, 5e5)
    (plan,) = captured._plans.values()
    assert plan.layout.capacity.edges > 2
    assert captured._found


def test_a_torn_cloth_is_lost(scenes: SceneSampler) -> None:
    simulator = tiny(PAPER)
    captured = CapturedUpdates(simulator, Signal("potential"), 1e-6, "fixed")
    parts = Slots(scenes, simulator, 1, 0, 2, workers=0).each(1)
    update = captured(parts, default_potential())
    assert figures_of(update).lost == [True]
    assert update.acceptance is not None
    assert update.acceptance.goes_on.tolist() == [False]
    torch.testing.assert_close(update.next_pos, parts[0].state.pos)  # it waits where it was
    again = captured([parts[0]._replace(runs=update.acceptance.goes_on[0])], default_potential())
    assert figures_of(again).counted == [False]
    assert not again.acceptance.usable
    assert not any(p.grad.any() for p in simulator.parameters())


@pytest.mark.parametrize("decay", [0.0, 0.9, 1.0])
def test_rows_that_are_not_filled_do_not_count(decay: float) -> None:
    plain, filled = RunningNormalizer(3, decay), RunningNormalizer(3, decay)
    for count in (4, 0, 7):
        rows, there = torch.randn(9, 3), torch.arange(9) < count
        plain.leading(rows[:count].clone())
        given = filled.leading(rows.clone(), there)
        assert given.isfinite().all()
        for name, value in filled.named_buffers():
            torch.testing.assert_close(value, getattr(plain, name))
    filled.freeze()
    before = filled.first.clone()
    filled.leading(torch.randn(9, 3), torch.ones(9, dtype=torch.bool))
    assert torch.equal(filled.first, before)


@pytest.mark.parametrize(
    "options, settings, ranks, words",
    [
        (PAPER, {"step": "captured"}, 1, "needs device=cuda"),
        (PAPER, {}, 2, "several processes"),
        (PAPER, {"activation_checkpointing": True}, 1, "activation_checkpointing"),
        (PAPER | {"layer_radius": 0.03}, {}, 1, "edges between layers"),
        (PAPER | {"frame_dt": 1 / 30}, {}, 1, "counts in frames"),
        (PASSES, {"collision": RAMP}, 1, "rises"),
    ],
)
def test_what_has_no_such_form_is_refused(options: dict[str, Any], settings: dict[str, Any], ranks: int, words: str) -> None:
    given = TrainerSettings(**{"step": "fixed", "collision": CollisionRamp(), **settings})
    with pytest.raises(ValueError, match=words):
        make_captured(tiny(options), given, 1.5, ranks=ranks)
    assert make_captured(tiny(options), replace(given, step="auto"), 1.5, ranks=ranks) is None  # a CPU has no graphs


def test_a_gpu_takes_few_scenes_by_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(updates, "has_graphs", lambda device: True)
    settings = TrainerSettings(collision=CollisionRamp())
    captured = make_captured(tiny(PAPER), settings, 1.5, scenes=8)
    assert captured is not None
    assert captured.mode == "captured"
    assert make_captured(tiny(PAPER), settings, 1.5, scenes=9) is None
    assert make_captured(tiny(PAPER), replace(settings, step="captured"), 1.5, scenes=9) is not None


def test_energies_that_search_for_more_are_refused(scenes: SceneSampler) -> None:
    simulator = tiny(PAPER)
    captured = CapturedUpdates(simulator, Signal("potential"), 1.5, "fixed")
    with pytest.raises(ValueError, match="step=plain"):
        captured(Slots(scenes, simulator, 1, 0, 2, workers=0).each(1), coded_potential())


def test_a_training_learns_the_same(scenes: SceneSampler, tmp_path: Path) -> None:
    settings = TrainerSettings(
        iterations=8, batch_size=1, learning_rate=1e-3, schedule=WarmupCosine(3), horizon=Horizon(every=3, maximum=2),
        collision=CollisionRamp(1e5, 5e5, 2, 6), statistics_iterations=2, log_every=1, ema_decay=0.0,
    )  # fmt: skip
    weights = {}
    for step in ("plain", "fixed"):
        trainer = Trainer(tiny(PAPER), default_potential(), scenes, replace(settings, step=step), tmp_path / step, 0)
        assert trainer.run()
        weights[step] = trainer.averaged().state_dict()
    for name, value in weights["plain"].items():
        torch.testing.assert_close(weights["fixed"][name], value, rtol=1e-3, atol=1e-4, msg=name)


def test_the_kernels_of_a_gpu_are_part_of_it(scenes: SceneSampler) -> None:
    """Forward and backward: tracing fails where something asks the device, or has no gradient of fixed shape."""
    simulator = tiny(PAPER | {"latent_dim": 16})
    captured = CapturedUpdates(simulator, Signal("potential"), 1.5, "fixed")
    (part,) = Slots(scenes, simulator, 1, 0, 2, workers=0).each(1)
    captured([part], default_potential())
    (plan,) = captured._plans.values()
    plan._run._owner.mode = "captured"  # searches as on a GPU
    with assumed():
        traced = trace(plan._run, plan._memory, fold=False)
    names = Counter(str(node.target) for node in traced.graph.nodes if node.op == "call_function")
    own = {name.split(".")[1]: count for name, count in names.items() if name.startswith("hood.")}
    sets = 3 * 3  # steps, edge sets of a step
    assert own["step_edges"] == own["edge_gradients"] == sets
    assert own["step_nodes"] == 3
    assert own["mlp_tail"] == 5  # encoders of nodes and four kinds of edges; the decoder has no layer norm
    assert own["tail_gradients"] == own["step_nodes"] + own["mlp_tail"]

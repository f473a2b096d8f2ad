"""Training: the signal goes down, a resumed run is the uninterrupted one, other runs are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.optim.lr_scheduler import (
    CosineAnnealingLR,
    LinearLR,
    MultiStepLR,
    OneCycleLR,
    ReduceLROnPlateau,
    SequentialLR,
    StepLR,
)

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import PoseSequence
from hood.energies.potential import Potential, default_potential
from hood.energies.self_contact import SignedSelfContactPenalty, for_networks
from hood.model.features.inputs import Inputs
from hood.model.network.kernel_choice import KernelChoice
from hood.model.readout.network_step import Feedback
from hood.model.readout.output import AccelerationOutput
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import NetworkStepper, build_simulator
from hood.steppers.ranges import training_conditions
from hood.training.curriculum import CollisionRamp, Horizon, InverseRoot, WarmupCosine
from hood.training.scenes import SceneSampler, Window
from hood.training.settings import TrainerSettings
from hood.training.trainer import Trainer

PHYSICAL = {"features": "physical", "output": "velocity_base", "output_init": 0.1}
PAPER = {"features": "paper", "output": "acceleration"}
PASSES = {"features": "local", "output": "local_steps", "schedule": "1x(mesh+coarse0) | 1x(mesh)", "output_init": 0.1}
SETTINGS = TrainerSettings(
    iterations=12, batch_size=2, learning_rate=1e-3, schedule=WarmupCosine(3), horizon=Horizon(every=3, maximum=2),
    collision=CollisionRamp(5e5, 5e5), signal="scaled", ema_decay=0.9, statistics_iterations=4, checkpoint_every=100,
    log_every=1,
)  # fmt: skip


def tiny(options: dict, seed: int = 0) -> NetworkStepper:
    torch.manual_seed(seed)
    return build_simulator(**{"schedule": "1x(mesh+coarse0)", "latent_dim": 8, **options})


def make(
    folder: Path,
    sampler: SceneSampler,
    options: dict = PHYSICAL,
    settings: TrainerSettings = SETTINGS,
    seed: int = 0,
    potential: Potential | None = None,
) -> Trainer:
    return Trainer(tiny(options), potential or default_potential(), sampler, settings, folder, seed)


class OneScene(SceneSampler):
    """Always the same scene, whatever the generator."""

    def sample(self, rng: np.random.Generator, num_steps: int, garment: int | None = None) -> Window:
        return super().sample(np.random.default_rng(3), num_steps, garment)


@pytest.mark.parametrize("signal, precision", [("scaled", "fp32"), ("potential", "fp32"), ("scaled", "bf16")])
def test_the_signal_goes_down_on_a_fixed_scene(
    signal: str, precision: str, tmp_path: Path, body: Body, garments: dict[str, Garment], walk: PoseSequence
) -> None:
    constant = {"schedule": WarmupCosine(5, floor=1.0), "horizon": Horizon(every=100, maximum=1)}
    settings = replace(SETTINGS, iterations=60, batch_size=1, signal=signal, precision=precision, **constant)
    trainer = make(tmp_path, OneScene(body, [garments["tank"]], [walk.window(0, 60)]), settings=settings)
    reports = [trainer.update() for _ in range(20)]
    assert all(np.isfinite(list(report.values())).all() for report in reports)
    # A relaxing step and a regular one take turns; the relaxing one is the same problem every time.
    totals = np.array([report["total"] for report in reports[::2]])
    assert (np.diff(totals) < 1e-6).all()
    assert totals[-1] < totals[0] - 1e-3
    assert all(p.dtype == torch.float32 for p in trainer.averaged().parameters())


def test_a_network_learns_to_leave_layers_on_their_sides(tmp_path: Path, body: Body, garments: dict[str, Garment]) -> None:
    constant = {"schedule": WarmupCosine(1, floor=1.0), "horizon": Horizon(every=100, maximum=1)}
    scenes = OneScene(body, [garments["longsleeve"]], [load_sequence("dance_mixed", 30.0).window(30, 90)])
    felt = {}
    for weight in (1e-3, 5e6):
        potential = default_potential().with_terms(layer_sides=SignedSelfContactPenalty(weight, epsilon=5e-3))
        settings = replace(SETTINGS, batch_size=1, learning_rate=1e-2, **constant)
        trainer = make(tmp_path / str(weight), scenes, PHYSICAL | {"output_init": 1.0}, settings, potential=potential)
        assert "layer_sides" not in trainer.simulator.potential.terms
        assert trainer.simulator.trained_for is not None
        assert "layer_sides" not in trainer.simulator.trained_for.potential
        felt[weight] = [trainer.update()["layer_sides"] / weight for _ in range(40)][1::2]  # every other step is a relaxing one
    # Single updates go up and down, and cloth that an untrained network stretches meets itself the more: the one that is not
    # taught shows how much.
    assert np.mean(felt[5e6][5:9]) < 0.6 * np.mean(felt[1e-3][5:9])
    assert np.mean(felt[5e6][10:]) < 0.6 * np.mean(felt[1e-3][10:])


@pytest.mark.parametrize("options", [PAPER, PHYSICAL, PASSES], ids=["paper", "physical", "passes"])
def test_models_with_edges_between_layers_train(
    options: dict, tmp_path: Path, body: Body, garments: dict[str, Garment]
) -> None:
    scenes = OneScene(body, [garments["longsleeve"], garments["tank"]], [load_sequence("dance_mixed", 30.0).window(30, 90)])
    trainer = make(tmp_path, scenes, options | {"layer_radius": 0.03}, replace(SETTINGS, statistics_iterations=2))
    network = trainer.simulator.network
    weight = network.edge_encoders["layers"].first.weight
    before = weight.detach().clone()
    reports = [trainer.update() for _ in range(5)]
    assert all(np.isfinite(list(report.values())).all() for report in reports)
    assert not torch.equal(weight, before)
    trainer.save()
    again = load_simulator(tmp_path / "model.safetensors")
    assert again.layer_radius == 0.03
    torch.testing.assert_close(
        again.network.edge_encoders["layers"].first.weight, trainer.averaged().network.edge_encoders["layers"].first.weight
    )


def test_features_look_at_the_potential_that_is_trained(
    tmp_path: Path, sampler: SceneSampler, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its ramp included, so that every pass answers to the potential of the last one."""
    settings = replace(SETTINGS, collision=CollisionRamp(5e3, 5e5, 0, 2))
    trainer = make(tmp_path, sampler, PASSES, settings, potential=default_potential(friction_coefficient=3.0))
    looked_at: list[dict] = []
    gradient = Feedback.__call__

    def watched(feedback: Feedback, inputs: Inputs, pos: Tensor, held_back: Tensor | None = None) -> tuple[Inputs, Tensor]:
        looked_at.append(feedback.potential.settings)
        return gradient(feedback, inputs, pos, held_back)

    monkeypatch.setattr(Feedback, "__call__", watched)
    for _ in range(3):
        trainer.update()
    assert [one["collision"]["weight"] for one in looked_at] == [5e3, 5e3, 252500.0, 252500.0, 5e5, 5e5]
    assert {one["friction"]["coefficient"] for one in looked_at} == {3.0}


def test_the_model_file_says_what_it_was_trained_for(tmp_path: Path, sampler: SceneSampler) -> None:
    settings = replace(SETTINGS, collision=CollisionRamp(5e3, 4e5, 0, 2))
    trainer = make(tmp_path, sampler, settings=settings, potential=default_potential(friction_coefficient=3.0))
    trainer.save()
    trained_for = load_simulator(tmp_path / "model.safetensors").trained_for
    assert trained_for == training_conditions(sampler, for_networks(default_potential(4e5, friction_coefficient=3.0)))


def test_the_loss_that_is_reported_is_the_one_that_is_trained(tmp_path: Path, sampler: SceneSampler) -> None:
    """With the scaled signal a scene counts less the further it is from rest; with the potential's every scene counts alike."""
    settings = replace(SETTINGS, batch_size=1)
    scaled = make(tmp_path / "a", sampler, settings=settings).update()
    plain = make(tmp_path / "b", sampler, settings=replace(settings, signal="potential")).update()
    assert scaled["relative_gradient"] == plain["relative_gradient"] > 1.0
    assert scaled["loss"] == pytest.approx(plain["loss"] / (1.0 + scaled["relative_gradient"] / 3.0), rel=1e-5)


def test_relaxing_steps_count_as_frames_with_the_signal_by_frame(tmp_path: Path, sampler: SceneSampler) -> None:
    """A relaxing step is ten times as long as a frame, and its e0 a hundred times that of one."""
    settings = replace(SETTINGS, batch_size=1, clip_norm=1e9, learning_rate=1e-12)
    reports = {}
    for signal in ("scaled", "scaled_by_frame"):
        trainer = make(tmp_path / signal, sampler, settings=replace(settings, signal=signal))
        reports[signal] = [trainer.update() for _ in range(2)]  # the relaxing step, and a frame
    for name in ("loss", "parameter_gradient_norm"):
        relaxing, frame = ([report[name] for report in reports[signal]] for signal in ("scaled", "scaled_by_frame"))
        assert frame[0] == pytest.approx(100.0 * relaxing[0], rel=1e-4)
        assert frame[1] == pytest.approx(relaxing[1], rel=1e-4)


def test_whitening_is_of_all_encoders_of_edges_and_of_places_alone(tmp_path: Path, sampler: SceneSampler) -> None:
    settings = replace(SETTINGS, whitening=True, learning_rate=1e-3)
    trainer, plain = make(tmp_path / "a", sampler, PAPER, settings), make(tmp_path / "b", sampler, PAPER)
    for _ in range(4):
        trainer.update(), plain.update()
    assert not trainer.whitening.state_dict()["bases"]  # statistics are still collected
    trainer.update(), plain.update()
    bases = trainer.whitening.state_dict()["bases"]
    assert {name: len(basis) for name, basis in bases.items()} == {"mesh": 9, "coarse0": 9, "body": 9}
    first, other = (one.simulator.network.edge_encoders["mesh"].first.weight for one in (trainer, plain))
    assert float((first[:, :8] - other[:, :8]).detach().abs().max()) > 0.1
    # One update of Adam: the same length in both.
    torch.testing.assert_close(first[:, 8:], other[:, 8:], atol=2.1e-3, rtol=0)


def test_whitening_goes_on_from_trained_weights_as_they_are(tmp_path: Path, sampler: SceneSampler) -> None:
    """Whatever their file says of updates: published weights say nothing, but have statistics."""
    make(tmp_path / "before", sampler, PAPER, replace(SETTINGS, iterations=6)).run()
    weights = load_simulator(tmp_path / "before" / "model.safetensors")
    first = weights.network.edge_encoders["mesh"].first.weight
    before = first.detach().clone()
    settings = replace(SETTINGS, whitening=True, learning_rate=1e-30)
    trainer = Trainer(weights, default_potential(), sampler, settings, tmp_path / "after", 0)
    for _ in range(5):
        trainer.update()
    assert set(trainer.whitening.state_dict()["bases"]) == {"mesh", "coarse0", "body"}
    torch.testing.assert_close(first.detach(), before, atol=1e-6, rtol=0)


def test_whitening_of_features_without_places_is_refused(tmp_path: Path, sampler: SceneSampler) -> None:
    with pytest.raises(ValueError, match="trainer.whitening: of all features only paper"):
        make(tmp_path, sampler, PHYSICAL, replace(SETTINGS, whitening=True))


def test_a_network_whose_units_died_is_told_once(
    tmp_path: Path, sampler: SceneSampler, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its output is one constant: the loss goes on as if nothing were wrong."""
    paper = {"features": "paper", "output": "acceleration"}
    alive = make(tmp_path / "alive", sampler, paper)
    alive.run()
    assert "the network gives every vertex the same" not in capsys.readouterr().err
    assert all(line["output_spread"] > 0.01 for line in metrics(tmp_path / "alive"))
    dead = make(tmp_path / "dead", sampler, paper)
    with torch.no_grad():
        dead.simulator.network.decoder.second.bias.fill_(-1e3)
    dead.run()
    assert capsys.readouterr().err.count("the network gives every vertex the same acceleration") == 1
    assert all(line["output_spread"] < 1e-6 for line in metrics(tmp_path / "dead"))


def metrics(folder: Path) -> list[dict]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key != "iterations_per_second"} for line in lines]


def assert_same(first: object, second: object) -> None:
    if isinstance(first, Tensor):
        assert torch.equal(first, second)
    elif isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key])
    elif isinstance(first, (list, tuple)):
        for a, b in zip(first, second, strict=True):
            assert_same(a, b)
    else:
        assert first == second


#: A warm-up, then a cosine.
STAGES = partial(
    SequentialLR,
    schedulers=[partial(LinearLR, total_iters=4), partial(CosineAnnealingLR, T_max=16)],
    milestones=[4],
)
VARIANTS = {
    "physical": (PHYSICAL, {}),
    "paper": (PAPER, {"signal": "potential"}),
    "passes": (PASSES, {"optimizer": "muon"}),
    "bf16": (PHYSICAL, {"precision": "bf16", "ema_decay": 0.0}),
    "edges": (PHYSICAL | {"output": "edges"}, {}),
    "white": (PAPER, {"signal": "scaled_by_frame", "whitening": True}),
    "torch": (PHYSICAL, {"optimizer": partial(torch.optim.AdamW, weight_decay=0.1, amsgrad=True), "schedule": STAGES}),
    "cycle": (
        PAPER,
        {"optimizer": partial(torch.optim.SGD, momentum=0.9), "schedule": partial(OneCycleLR, max_lr=0.1, total_steps=20)},
    ),
    "fixed": (
        PHYSICAL,
        {"optimizer": partial(torch.optim.AdamW), "schedule": partial(MultiStepLR, milestones=[3, 12]), "step": "fixed"},
    ),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_ten_and_ten_iterations_are_twenty(variant: str, tmp_path: Path, sampler: SceneSampler) -> None:
    """The second half in a new trainer, as in a new process: weights, optimiser, curriculum, scenes, generators, log."""
    options, changes = VARIANTS[variant]
    settings = replace(SETTINGS, iterations=20, **{"log_every": 3 if variant == "bf16" else 1, **changes})
    whole = make(tmp_path / "whole", sampler, options, settings)
    assert whole.run()
    first = make(tmp_path / "parts", sampler, options, settings)
    assert not first.run(should_stop=lambda: first.iteration >= 10)
    torch.manual_seed(99)  # a new process has another generator and other weights
    second = make(tmp_path / "parts", sampler, options, settings)
    second.resume(second.checkpoint_path)
    assert second.iteration == 10
    assert second.run()
    assert metrics(tmp_path / "parts") == metrics(tmp_path / "whole")
    assert [line["iteration"] for line in metrics(tmp_path / "parts")] == sorted(
        {*range(settings.log_every, 21, settings.log_every), 20}
    )
    states = [torch.load(tmp_path / name / "checkpoint.pt", weights_only=True) for name in ("whole", "parts")]
    assert_same(*states)
    models = [load_simulator(tmp_path / name / "model.safetensors").state_dict() for name in ("whole", "parts")]
    assert_same(*models)


def test_the_paper_model_collects_statistics_first(tmp_path: Path, sampler: SceneSampler) -> None:
    """Output statistics are those of skinned accelerations: millimetres per frame², not metres."""
    trainer = make(tmp_path, sampler, PAPER)
    before = {name: value.clone() for name, value in trainer.simulator.named_parameters()}
    for _ in range(4):
        assert "learning_rate" not in trainer.update()
    assert all(torch.equal(value, before[name]) for name, value in trainer.simulator.named_parameters())
    output = trainer.simulator.output
    assert isinstance(output, AccelerationOutput)
    assert int(output.normalizer.num_updates) == 4
    deviation = output.normalizer.statistics(torch.float64)[1]
    assert bool((deviation > 1e-6).all())
    assert bool((deviation < 0.05).all())
    assert "learning_rate" in trainer.update()
    assert int(output.normalizer.num_updates) == 4
    assert not all(torch.equal(value, before[name]) for name, value in trainer.simulator.named_parameters())


def test_a_run_that_would_only_collect_statistics_is_refused(tmp_path: Path, sampler: SceneSampler) -> None:
    short = replace(SETTINGS, iterations=4)
    with pytest.raises(ValueError, match=r"trainer.iterations=4: the first 4 only collect statistics"):
        make(tmp_path, sampler, PAPER, short)
    make(tmp_path, sampler, PHYSICAL, short)  # has none to collect


def test_averaged_weights(tmp_path: Path, sampler: SceneSampler) -> None:
    trainer = make(tmp_path, sampler)
    for _ in range(3):
        trainer.update()
    plain, averaged = trainer.simulator.state_dict(), trainer.averaged().state_dict()
    assert any(not torch.equal(plain[name], averaged[name]) for name in plain)
    off = make(tmp_path, sampler, settings=replace(SETTINGS, ema_decay=0.0))
    off.update()
    assert_same(dict(off.simulator.state_dict()), dict(off.averaged().state_dict()))


def test_marked_iterations_are_kept_and_are_whole_runs(tmp_path: Path, sampler: SceneSampler) -> None:
    """What is kept of a long run is the run that ends there, and the long run can go on from it."""
    endless = replace(SETTINGS, iterations=6, schedule=InverseRoot(2, 3), keep_at=[3, 5])
    whole = make(tmp_path / "long", sampler, settings=endless)
    assert whole.run()
    kept = tmp_path / "long" / "kept"
    names = [f"{number}.{kind}" for number in ("000003", "000005") for kind in ("pt", "safetensors")]
    assert sorted(path.name for path in kept.iterdir()) == names
    short = make(tmp_path / "short", sampler, settings=replace(endless, iterations=3))
    assert short.run()
    assert_same(dict(load_simulator(kept / "000003.safetensors").state_dict()), dict(short.averaged().state_dict()))

    again = make(tmp_path / "again", sampler, settings=endless)
    again.resume(kept / "000003.pt")
    assert again.run()
    assert_same(dict(again.averaged().state_dict()), dict(whole.averaged().state_dict()))
    assert not (tmp_path / "again" / "kept" / "000003.pt").exists()
    with pytest.raises(ValueError, match="keep_at"):
        replace(SETTINGS, keep_at=[0])


def test_kernels_are_those_that_train_fastest_here(
    tmp_path: Path, sampler: SceneSampler, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert make(tmp_path, sampler).choice is None  # as named

    def choose(precision: str, width: int, device: torch.device, training: bool) -> KernelChoice:
        assert (precision, width, device.type, training) == ("bf16", 8, "cpu", True)
        return KernelChoice("torch", "measured")

    monkeypatch.setattr("hood.model.network.kernel_choice.choose_kernels", choose)
    trainer = make(tmp_path, sampler, settings=replace(SETTINGS, kernels="auto", precision="bf16"))
    assert str(trainer.choice) == "kernels=auto: torch (measured)"
    assert trainer.simulator.network.kernels == "torch"


@pytest.mark.parametrize(
    "options, words",
    [
        ({"optimizer": partial(torch.optim.AdamW, weight_decai=0.1)}, "trainer.optimizer: .*did you mean 'weight_decay'"),
        ({"optimizer": partial(torch.optim.AdamW, weight_decay=-1.0)}, "trainer.optimizer: .*Invalid weight_decay"),
        ({"schedule": partial(StepLR)}, "trainer.schedule: .*step_size"),
        ({"optimizer": partial(torch.optim.SGD), "step": "fixed"}, "steps of trainer.optimizer must be undone.*step=plain"),
    ],
)
def test_classes_of_torch_are_refused_with_their_key(options: dict, words: str, tmp_path: Path, sampler: SceneSampler) -> None:
    with pytest.raises(ValueError, match=words):
        make(tmp_path / "run", sampler, settings=replace(SETTINGS, **options))
    assert not (tmp_path / "run").exists()


def test_schedulers_of_torch_count_iterations_without_a_step(tmp_path: Path, sampler: SceneSampler) -> None:
    """Four collect statistics; as functions of the iteration do, the scheduler counts them."""
    trainer = make(tmp_path, sampler, PAPER, replace(SETTINGS, schedule=partial(StepLR, step_size=3, gamma=0.5)))
    rates = [trainer.update().get("learning_rate") for _ in range(7)]
    assert rates == [None, None, None, None, 5e-4, 5e-4, 2.5e-4]


def test_the_learning_rate_follows_its_schedule(tmp_path: Path, sampler: SceneSampler) -> None:
    trainer = make(tmp_path, sampler)
    rates = [trainer.update()["learning_rate"] for _ in range(3)]
    assert rates == pytest.approx([1e-3 / 3, 2e-3 / 3, 1e-3])


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory, sampler: SceneSampler) -> Path:
    trainer = make(tmp_path_factory.mktemp("run"), sampler, settings=replace(SETTINGS, iterations=1))
    trainer.run()
    return trainer.checkpoint_path


@pytest.mark.parametrize(
    "change, words",
    [
        ({"options": {**PHYSICAL, "output_scale": 1e-2}}, ("trained with model", "'output_scale': 0.005")),
        ({"seed": 5}, ("trained with seed 0", "seed=0")),
        ({"settings": replace(SETTINGS, batch_size=3)}, ("trainer.batch_size=2",)),
    ],
    ids=["model", "seed", "batch size"],
)
def test_checkpoints_of_other_runs_are_refused(
    change: dict, words: tuple[str, ...], tmp_path: Path, sampler: SceneSampler, checkpoint: Path
) -> None:
    trainer = make(tmp_path, sampler, **change)
    before = {name: value.clone() for name, value in trainer.simulator.state_dict().items()}
    with pytest.raises(ValueError, match=r"checkpoint\.pt") as error:
        trainer.resume(checkpoint)
    assert all(word in str(error.value) for word in words), str(error.value)
    assert_same(before, dict(trainer.simulator.state_dict()))


def test_a_training_without_whitening_does_not_go_on_with_it(tmp_path: Path, sampler: SceneSampler) -> None:
    """Its optimiser's moments are of other coordinates; the other way round those are not plain."""
    white = replace(SETTINGS, whitening=True)
    for name, settings, other in (("plain", SETTINGS, white), ("white", white, SETTINGS)):
        make(tmp_path / name, sampler, PAPER, replace(settings, iterations=5)).run()
        trainer = make(tmp_path / name, sampler, PAPER, other)
        with pytest.raises(ValueError, match=f"pass trainer.whitening={str(settings.whitening).lower()} to resume it"):
            trainer.resume(trainer.checkpoint_path)


@pytest.mark.parametrize(
    "options, word",
    [
        ({"signal": "plain"}, "trainer.signal"),
        ({"whitening": True, "statistics_iterations": 0}, "trainer.whitening needs statistics"),
        ({"precision": "fp16"}, "trainer.precision"),
        ({"kernels": "fast"}, "trainer.kernels"),
        ({"iterations": 0}, "trainer.iterations"),
        ({"batch_size": 0}, "trainer.batch_size"),
        ({"learning_rate": 0.0}, "trainer.learning_rate"),
        ({"optimizer": "adamw"}, "give 'adam' or 'muon', or a class"),
        ({"optimizer": partial(torch.optim.AdamW, lr=1.0)}, "the rate is trainer.learning_rate"),
        ({"optimizer": partial(torch.optim.LBFGS)}, "LBFGS needs to compute the loss several times"),
        ({"optimizer": partial(torch.optim.SparseAdam)}, "SparseAdam needs sparse gradients"),
        ({"optimizer": partial(StepLR, step_size=3)}, "StepLR is no class of torch.optim"),
        ({"schedule": partial(torch.optim.AdamW)}, "AdamW is no class of torch.optim.lr_scheduler.LRScheduler"),
        ({"schedule": 0.5}, "no method __call__"),
        ({"schedule": partial(ReduceLROnPlateau)}, "give trainer.validate_every"),
        ({"schedule": partial(StepLR, step_size=3), "time_scale": 2.0}, r"StepLR, which has no method scaled"),
    ],
)
def test_wrong_settings_are_named(options: dict, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        TrainerSettings(**options)

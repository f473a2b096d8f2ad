"""Validation during training: figures and pictures in the run folder, and the best weights kept."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch.optim.lr_scheduler import ReduceLROnPlateau

from hood.energies.potential import default_potential
from hood.evaluation.gap import REFERENCE
from hood.evaluation.validation import Validation
from hood.scene.scene import Scene
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import NetworkStepper, build_simulator
from hood.training.callbacks import ValidationWatch
from hood.training.curriculum import CollisionRamp, Horizon, WarmupCosine
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings
from hood.training.trainer import Trainer

SETTINGS = TrainerSettings(
    iterations=6, batch_size=1, learning_rate=1e-3, schedule=WarmupCosine(3), horizon=Horizon(every=100, maximum=2, start=2),
    collision=CollisionRamp(), signal="scaled", ema_decay=0.5, statistics_iterations=0, checkpoint_every=2, log_every=1,
    validate_every=2,
)  # fmt: skip


def tiny() -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator("physical", "velocity_base", "1x(mesh)", latent_dim=4, output_init=0.1)


def make(folder: Path, sampler: SceneSampler, watch: Callable) -> Trainer:
    return Trainer(tiny(), default_potential(), sampler, SETTINGS, folder, 0, watch)  # type: ignore[arg-type]


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


class Scripted:
    """Scores by iteration; remembers the weights it was shown."""

    def __init__(self, scores: dict[int, float]) -> None:
        self.scores, self.seen = scores, {}  # type: ignore[var-annotated]

    def __call__(self, simulator: NetworkStepper, iteration: int) -> tuple[dict[str, float], None]:
        self.seen[iteration] = simulator.state_dict()
        return {"score": self.scores[iteration]}, None


def test_the_best_weights_stay_beside_the_last(tmp_path: Path, sampler: SceneSampler) -> None:
    watch = Scripted({2: 3.0, 4: 1.0, 6: 2.0})
    trainer = make(tmp_path, sampler, watch)
    assert trainer.run()
    best, last = (load_simulator(tmp_path / f"{name}.safetensors").state_dict() for name in ("best", "model"))
    assert all(torch.equal(value, watch.seen[4][name]) for name, value in best.items())
    assert all(torch.equal(value, watch.seen[6][name]) for name, value in last.items())
    assert any(not torch.equal(value, last[name]) for name, value in best.items())
    with safe_open(tmp_path / "best.safetensors", framework="pt") as file:
        assert file.metadata()["iteration"] == "4"
        assert json.loads(file.metadata()["validation"]) == {"score": 1.0}
    assert [line["validation_score"] for line in lines(tmp_path) if "validation_score" in line] == [3.0, 1.0, 2.0]


def test_a_resumed_run_knows_what_was_best(tmp_path: Path, sampler: SceneSampler) -> None:
    first = make(tmp_path, sampler, Scripted({2: 1.0, 4: 5.0}))
    assert not first.run(should_stop=lambda: first.iteration >= 4)
    before = (tmp_path / "best.safetensors").read_bytes()
    second = make(tmp_path, sampler, Scripted({6: 2.0}))
    second.resume(second.checkpoint_path)
    assert second.run()
    assert second.best == 1.0
    assert (tmp_path / "best.safetensors").read_bytes() == before


def test_a_rate_that_falls_on_a_plateau_reads_the_score(tmp_path: Path, sampler: SceneSampler) -> None:
    settings = replace(SETTINGS, schedule=partial(ReduceLROnPlateau, patience=0, factor=0.5), iterations=8)
    trainer = Trainer(tiny(), default_potential(), sampler, settings, tmp_path, 0, Scripted({2: 3.0, 4: 3.0, 6: 1.0, 8: 1.0}))  # type: ignore[arg-type]
    assert trainer.run()
    rates = [line["learning_rate"] for line in lines(tmp_path) if "learning_rate" in line]
    assert rates == [1e-3] * 4 + [5e-4] * 4
    assert trainer.optimizer.param_groups[0]["lr"] == 2.5e-4


def test_models_that_break_are_never_best(tmp_path: Path, sampler: SceneSampler) -> None:
    assert make(tmp_path, sampler, Scripted(dict.fromkeys((2, 4, 6), float("inf")))).run()
    assert not (tmp_path / "best.safetensors").exists()


def test_validation_does_not_count_as_training(tmp_path: Path, sampler: SceneSampler, monkeypatch: pytest.MonkeyPatch) -> None:
    """An update takes one second here, a validation a hundred."""
    now = [0.0]
    monkeypatch.setattr("hood.training.log.time.monotonic", lambda: now[0])

    def watch(simulator: NetworkStepper, iteration: int) -> tuple[dict[str, float], None]:
        now[0] += 100.0
        return {"score": 1.0}, None

    trainer = make(tmp_path, sampler, watch)
    begin, told = trainer.begin, []

    def counted() -> None:
        now[0] += 1.0
        begin()

    trainer.begin = counted  # type: ignore[method-assign]
    assert trainer.run(lambda iteration, report: told.append((iteration, report is None)))
    rates = [line["iterations_per_second"] for line in lines(tmp_path) if "iterations_per_second" in line]
    assert rates == pytest.approx([1.0] * 6)
    assert [iteration for iteration, away in told if away] == [2, 4, 6]


def test_validation_changes_nothing_that_is_learned(tmp_path: Path, sampler: SceneSampler, band_scene: Scene) -> None:
    watch = ValidationWatch(_validation(band_scene, states=0), tmp_path / "watched", pictures=0)
    watched = make(tmp_path / "watched", sampler, watch)
    plain = Trainer(tiny(), default_potential(), sampler, replace(SETTINGS, validate_every=0), tmp_path / "plain", 0)
    assert watched.run()
    assert plain.run()
    assert all(torch.equal(value, plain.simulator.state_dict()[name]) for name, value in watched.simulator.state_dict().items())


def _validation(scene: Scene, states: int) -> Validation:
    motion, reference = scene.motion, replace(REFERENCE, max_iterations=20)
    return Validation(motion.body, [scene.garment], [motion.sequence], default_potential(), 5, states, reference)


def test_a_strip_of_frames_and_the_figures(tmp_path: Path, band_scene: Scene) -> None:
    from PIL import Image

    model = tiny().eval()
    watch = ValidationWatch(_validation(band_scene, states=1), tmp_path, pictures=4)
    values, strip = watch(model, 1200)
    assert values == watch.validation(model)
    assert {"gap", "strain_p99", "penetration_share", "score"} <= set(values)
    assert strip is not None
    picture = np.asarray(Image.open(tmp_path / "validation" / "strip_001200.png"))
    assert np.array_equal(picture, strip)
    height, width = picture.shape[:2]
    assert width == 4 * height * 240 // 336
    pictures = np.split(picture.astype(int), 4, axis=1)
    for image in pictures:
        blue = image[..., 2] - image[..., 0]
        assert (blue > 40).mean() > 0.01, "no cloth to be seen"
    assert np.abs(pictures[0] - pictures[3]).max() > 40, "nothing moves"


def test_without_picture_libraries_there_is_no_strip_and_one_line(
    tmp_path: Path, band_scene: Scene, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(*args: object, **options: object) -> None:
        raise ImportError("labels on pictures need Pillow")

    monkeypatch.setattr("hood.media.film.Film.sheet", missing)
    watch = ValidationWatch(_validation(band_scene, states=0), tmp_path)
    for iteration in (1, 2):
        values, strip = watch(tiny().eval(), iteration)
        assert strip is None
        assert np.isfinite(values["strain_p99"])
    assert capsys.readouterr().err.count("no validation pictures") == 1
    assert not (tmp_path / "validation").exists()

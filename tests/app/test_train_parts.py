"""Optimisers, schedules, loggers and callbacks that ``hood train`` is given as classes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from torch.optim.lr_scheduler import CosineAnnealingLR, SequentialLR

from hood.app.settings.compose import load_config
from hood.app.settings.rollout_settings import overrides
from hood.app.train import make_trainer
from hood.cli.main import main
from hood.training.callbacks import EarlyStopping
from hood.training.curriculum import InverseRoot, WarmupCosine
from hood.training.log import Csv, TensorBoard
from hood.training.trainer import Trainer

SMALL = [
    "model.latent_dim=4", "model.schedule='1x(mesh)'", "data.garments=[tank]", "data.sequences=[walk_proud]",
    "trainer.batch_size=1", "trainer.log_every=1", "trainer.kernels=torch", "trainer.workers=0",
]  # fmt: skip
ADAMW = "trainer.optimizer={_target_: torch.optim.AdamW, weight_decay: 1e-2}"
STEPS = "trainer.schedule={_target_: torch.optim.lr_scheduler.StepLR, step_size: 2, gamma: 0.5}"


def trainer(*overrides: str) -> Trainer:
    return make_trainer(load_config("train", [*SMALL, *overrides]))


def part(key: str, name: str, **arguments: Any) -> str:
    return f"{key}={{{', '.join([f'_target_: {name}', *(f'{key}: {value}' for key, value in arguments.items())])}}}"


def test_classes_of_torch_with_their_arguments() -> None:
    made = trainer(ADAMW, "trainer.learning_rate=0.01")
    assert type(made.optimizer) is torch.optim.AdamW
    assert (made.optimizer.defaults["weight_decay"], made.optimizer.defaults["lr"]) == (0.01, 0.01)
    two = "[{_target_: torch.optim.lr_scheduler.LinearLR}, {_target_: torch.optim.lr_scheduler.CosineAnnealingLR, T_max: 9}]"
    staged = trainer(part("trainer.schedule", "torch.optim.lr_scheduler.SequentialLR", schedulers=two, milestones="[5]"))
    scheduler = staged._rates._scheduler
    assert isinstance(scheduler, SequentialLR)
    assert isinstance(scheduler._schedulers[1], CosineAnnealingLR)


def test_a_table_with_a_class_replaces_the_schedule_and_one_without_changes_it() -> None:
    assert trainer("trainer.schedule={warmup: 7}").settings.schedule == WarmupCosine(7, 0.01)
    root = part("trainer.schedule", "hood.training.curriculum.InverseRoot", steady=9)
    assert trainer(root).settings.schedule == InverseRoot(steady=9)
    assert trainer(root, "trainer.time_scale=2").settings.schedule == InverseRoot(100, 18)
    assert OmegaConf.to_container(load_config("train", [STEPS]).trainer.schedule) == {
        "_target_": "torch.optim.lr_scheduler.StepLR",
        "step_size": 2,
        "gamma": 0.5,
    }


def test_from_python_they_are_dictionaries() -> None:
    early = {"_target_": "hood.training.callbacks.EarlyStopping", "measure": "loss", "patience": 3}
    adamw = {"_target_": "torch.optim.AdamW", "weight_decay": 0.1}
    words = overrides({"trainer": {"optimizer": adamw, "schedule": {"warmup": 7}}, "callbacks": [early], "loggers": ["csv"]})
    made = trainer(*words)
    assert made.optimizer.defaults["weight_decay"] == 0.1
    assert made.settings.schedule == WarmupCosine(7, 0.01)
    assert [callback.patience for callback in made.reporter._callbacks] == [3]  # type: ignore[attr-defined]


def test_loggers_and_callbacks_of_a_run() -> None:
    early = "{_target_: hood.training.callbacks.EarlyStopping, measure: loss, patience: 3}"
    reporter = trainer("loggers=[csv,{_target_: hood.training.log.TensorBoard}]", f"callbacks=[{early}]").reporter
    assert reporter._loggers is not None
    assert [type(logger) for logger in reporter._loggers] == [Csv, TensorBoard]
    assert reporter._loggers[0].config["trainer"]["batch_size"] == 1
    (callback,) = reporter._callbacks
    assert isinstance(callback, EarlyStopping)
    assert (callback.measure, callback.patience) == ("loss", 3)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([part("trainer.optimizer", "os.system", command="ls")], "_target_ 'os.system' is not allowed"),
        ([part("trainer.optimizer", "torch.optim.AdamWW")], "trainer.optimizer: Error loading 'torch.optim.AdamWW'"),
        ([part("trainer.optimizer", "torch.optim.SGD", momentun=1)], "trainer.optimizer: .*did you mean 'momentum'"),
        (["trainer.optimizer={weight_decay: 1}"], "trainer.optimizer={weight_decay:1}: give a class in braces"),
        (["trainer.optimizer=sgd"], "trainer.optimizer 'sgd': give 'adam' or 'muon'"),
        ([part("trainer.schedule", "torch.optim.lr_scheduler.StepLR", step=3)], "trainer.schedule: .*did you mean 'step_size'"),
        ([part("trainer.schedule", "hood.training.curriculum.StepDecay", floor=2)], "trainer.schedule.floor is 2"),
        ([STEPS, "trainer.time_scale=2"], "StepLR, which has no method scaled"),
        (["loggers=[jsonl]"], "metrics.jsonl is always written"),
        (["loggers=[tensorbord]"], "unknown logger 'tensorbord': did you mean 'tensorboard'"),
        (["loggers=[{_target_: hood.training.callbacks.EarlyStopping}]"], "is no class of hood.training.log.Logger"),
        (["callbacks=[early]"], "callbacks=early: give a class in braces"),
        (["callbacks=[{_target_: hood.training.callbacks.EarlyStopping, patiance: 3}]"], "did you mean 'patience'"),
        (["callbacks=[{_target_: hood.training.callbacks.EarlyStopping}]"], "trainer.validate_every is 0"),
    ],
)
def test_what_cannot_be_built_is_one_sentence(
    words: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", *SMALL, *words, f"output={tmp_path}/run"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert not (tmp_path / "run").exists()
    with pytest.raises(ValueError, match=told.replace("{", r"\{")):
        raise ValueError(said)


def test_a_run_goes_on_with_its_classes_and_not_with_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Loggers and callbacks may differ: they change nothing that is learned."""
    run = ["train", *SMALL, ADAMW, STEPS, f"output={tmp_path}/run"]
    early = "callbacks=[{_target_: hood.training.callbacks.EarlyStopping, measure: learning_rate, patience: 1}]"
    assert main([*run, "trainer.iterations=5", early.replace("learning_rate", "loss"), "loggers=[]"]) == 0
    stopped = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[-1])["iteration"]
    assert stopped < 5
    assert f"stopped at iteration {stopped}: loss has not become better" in capsys.readouterr().out
    others = [word for word in run if not word.startswith("trainer.optimizer")]
    assert main([*others, "trainer.iterations=5", "resume=true"]) == 2
    assert "trainer.optimizer is {_target_:torch.optim.AdamW,weight_decay:0.01} there, muon" in capsys.readouterr().err
    assert main([*run, "trainer.iterations=5", "resume=true", "loggers=[csv]"]) == 0
    rates = [json.loads(line)["learning_rate"] for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rates == [5e-3, 5e-3, 2.5e-3, 2.5e-3, 1.25e-3]
    assert len((tmp_path / "run" / "metrics.csv").read_text().splitlines()) == 6


def test_a_checkpoint_of_before_goes_on(tmp_path: Path) -> None:
    """It says nothing of schedulers, callbacks and garments, and its record has no loggers."""
    words = [f"output={tmp_path}/run", "trainer.iterations=2"]
    assert main(["train", *SMALL, *words]) == 0
    checkpoint, record = tmp_path / "run" / "checkpoint.pt", tmp_path / "run" / "config.yaml"
    state = torch.load(checkpoint, weights_only=True)
    torch.save({key: value for key, value in state.items() if key not in ("rates", "callbacks", "garments")}, checkpoint)
    record.write_text("".join(line for line in record.open() if not line.startswith(("loggers", "callbacks", "- tensorboard"))))
    assert main(["train", *SMALL, *words, "resume=true"]) == 0

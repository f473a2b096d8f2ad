"""``hood train``: a model from a config; resumes exactly from its own checkpoints."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from hood.assets.body import load_body
from hood.assets.garment import load_garment
from hood.assets.library import motion_split
from hood.assets.sequence import load_sequence
from hood.commands.common import prepare_folder, require_device
from hood.config import ConfigError, build, load_config, plain, save_run_record
from hood.dynamics.simulator import Simulator
from hood.evaluation.validation import Validation
from hood.scene.dataset import SceneSampler
from hood.training import distributed
from hood.training.trainer import Trainer, TrainerSettings


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    config = load_config("train", overrides)
    require_device(config)
    distributed.start()
    try:
        return _train(config)
    finally:
        distributed.stop()


def _train(config: DictConfig) -> int:
    trainer = make_trainer(config)
    folder = prepare_folder(Path(str(config.output)).expanduser())
    _refuse_other_run(config, folder, trainer)
    main = distributed.rank() == 0
    if main:
        save_run_record(folder, config, int(config.seed))
    parameters = sum(p.numel() for p in trainer.simulator.parameters())
    if main:
        print(
            f"{parameters:,} parameters, {len(trainer.slots.sampler.garments)} garments, "
            f"{len(trainer.slots.sampler.sequences)} motions"
        )
    finished = _run_with_progress(trainer)
    if main:
        print(f"weights in {folder / 'model.safetensors'}, checkpoint in {trainer.checkpoint_path}")
    if not finished:
        if main:
            print(
                f"hood: stopped at iteration {trainer.iteration}; the same command with resume=true goes on",
                file=sys.stderr,
            )
        return 130
    return 0


def make_trainer(config: DictConfig) -> Trainer:
    """Everything named in the config, put together; seeds are set before the weights are made."""
    torch.manual_seed(int(config.seed))
    simulator: Simulator = build(config.model)
    simulator.to(str(config.device))
    settings: TrainerSettings = build(config.trainer)
    fps = float(config.data.fps)
    names = list(config.data.sequences) or motion_split()["train"]
    sampler = SceneSampler(
        body=load_body(str(config.data.body)),
        garments=[load_garment(str(name)) for name in config.data.garments],
        sequences=[load_sequence(str(name), fps, str(config.data.up)) for name in names],
        **plain(config.data.sampling),
        device=str(config.device),
    )
    potential = build(config.losses)
    validation = None
    if settings.validate_every:
        motions = [load_sequence(name, fps) for name in list(config.data.validation_sequences) or motion_split()["validation"]]
        validation = Validation(sampler.body, sampler.garments, motions, potential, int(config.data.validation_frames))
    return Trainer(simulator, potential, sampler, settings, Path(str(config.output)).expanduser(), int(config.seed), validation)


def _refuse_other_run(config: DictConfig, folder: Path, trainer: Trainer) -> None:
    if trainer.checkpoint_path.exists():
        if not bool(config.resume):
            raise ConfigError(f"{folder} holds a training run; pass resume=true to go on or another output")
        _check_same_config(config, folder)
        trainer.resume(trainer.checkpoint_path)
    elif bool(config.resume) and any(folder.glob("*.safetensors")):
        raise ConfigError(f"{folder}: nothing to resume, checkpoint.pt is missing")


def _check_same_config(config: DictConfig, folder: Path) -> None:
    """A resumed run must see the same data and schedule, or its losses would not be those of an uninterrupted one."""
    record = folder / "config.yaml"
    if not record.exists():
        return
    before = OmegaConf.load(record)
    assert isinstance(before, DictConfig)
    free = ("resume", "output", "device")
    for key in map(str, config):
        if key not in free and plain(before.get(key)) != plain(config[key]):
            raise ConfigError(
                f"{record}: {key} differs from this command's; resume with the same settings or use another output"
            )


def _run_with_progress(trainer: Trainer) -> bool:
    """Train under a progress bar; SIGTERM and Ctrl-C end it after the current iteration, with a checkpoint."""
    stop = {"asked": False}

    def ask(signum: int, frame: object) -> None:
        stop["asked"] = True

    previous = {number: signal.signal(number, ask) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        with tqdm(
            total=trainer.settings.iterations,
            initial=trainer.iteration,
            desc="train",
            unit="it",
            disable=distributed.rank() != 0 or None,
        ) as bar:

            def progress(iteration: int, report: dict[str, float]) -> None:
                bar.update(1)
                if iteration % 20 == 0:
                    bar.set_postfix(rg=f"{report['relative_gradient']:.2f}", horizon=int(report["horizon"]), refresh=False)

            return trainer.run(progress, lambda: stop["asked"])
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)

"""``hood train``: a model from a config; resumes exactly from its own checkpoints."""

from __future__ import annotations

import json
import logging
import math
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch.optim.lr_scheduler import LRScheduler

from hood.app.common import (
    held_folder,
    load_stepper,
    output_folder,
    require_device,
    require_same_model,
    tell_choice,
    together,
    warn_if_slow,
)
from hood.app.notices import collected, say
from hood.app.scene.garments import as_simulated
from hood.app.scene.motion import check_rate
from hood.app.settings.compose import ConfigError, build, load_config, plain, require_choice, shown
from hood.app.settings.record import require_same_config, save_run_record
from hood.app.stepping.cautions import idle_in_training
from hood.assets.body.load import load_body
from hood.assets.files.library import locate, motion_split, unknown
from hood.assets.files.said import ProgressLines
from hood.assets.garment.garment import Garment, garments_in, load_garment
from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.assets.motion.motion_files import MotionFiles, find_motions
from hood.assets.motion.skeleton import UP_AXES
from hood.energies.potential import Potential
from hood.energies.self_contact import for_networks
from hood.evaluation.validation import Validation
from hood.steppers.checkpoint import read_header
from hood.steppers.network import NetworkStepper
from hood.steppers.published import SUFFIXES
from hood.training import distributed
from hood.training.callbacks import Callback, ValidationWatch
from hood.training.checkpoint import previous, reached
from hood.training.curriculum import scaled_count
from hood.training.log import LOGGERS, Logger
from hood.training.optimiser import dotted_name, made
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings
from hood.training.trainer import Trainer

#: Keys that a resumed run may change: they do not change what is learned.
_FREE = ("resume", "output", "device", "validation_states", "loggers", "callbacks")
_BOOKKEEPING = (
    "kernels",
    "workers",
    "activation_checkpointing",
    "checkpoint_every",
    "keep_at",
    "log_every",
    "validate_every",
    "validation_frames",
    "max_rollbacks",
)


logging.getLogger("hydra.utils").disabled = True  # the error that follows says the same, in one sentence

#: Is told the iteration, and what was measured in it, None where it was validated.
Tick = Callable[[int, dict[str, float] | None], None]
#: From the iterations in all and those done, what shows how far a training is.
TrainingBar = Callable[[int, int], AbstractContextManager[Tick]]


@contextmanager
def tell_iterations(total: int, done: int) -> Iterator[Tick]:
    """A :data:`TrainingBar` that says how far it is every few seconds."""
    progress = ProgressLines("train")

    def tick(iteration: int, report: dict[str, float] | None) -> None:
        if report is not None:
            progress.tell(f"{iteration} of {total}, relative gradient {report['relative_gradient']:.2f}")

    yield tick


@dataclass(frozen=True)
class Trained:
    """What came of a training.

    Args:
        weights: their file.
        iteration: how many iterations are done.
        interrupted: by the user; the checkpoint is kept.
        notes: what was said meanwhile, a line each.
    """

    weights: Path
    iteration: int
    interrupted: bool
    notes: list[str]


def train(overrides: Sequence[str], bar: TrainingBar = tell_iterations) -> Trained:
    """Run what the words of ``hood train`` ask for.

    Raises:
        ConfigError, ValueError, OSError: words or files that cannot be used.
        hood.app.common.GivenUpError: on another process of torchrun.
    """
    with collected() as notes:
        return _train(overrides, bar, notes)


def _train(overrides: Sequence[str], bar: TrainingBar, notes: list[str]) -> Trained:
    config = load_config("train", overrides)
    require_device(config)
    if distributed.is_first():
        for sentence in idle_in_training(overrides, config):
            say(sentence)
    return together(lambda: _in_folder(config, bar, notes), distributed.TRAINING_TIMEOUT)


def _check_values(config: DictConfig) -> None:
    """Raise ConfigError where a key has a value that no training can have, before a file is read."""
    missing = next((key for key in load_config("train").data if key not in config.data), None)
    if missing is not None:  # in an option of a plugin
        raise ConfigError(f"data.{missing} is missing; let the option begin with defaults: [default, _self_]")
    for key, least in (("seed", 0), ("validation_states", 0), ("data.validation_frames", 2)):
        if int(OmegaConf.select(config, key)) < least:
            raise ConfigError(f"{key}={OmegaConf.select(config, key)}: must be at least {least}")
    require_choice(config, "data.unusable", ("refuse", "skip"))
    require_choice(config, "data.up", ("auto", *UP_AXES))
    check_rate(config, "data.fps")
    patterns = config.data.patterns
    if patterns is not None and not Path(str(patterns)).expanduser().is_dir():
        raise ConfigError(f"data.patterns={shown(patterns)}: no such folder; give one with garments that hood sew made")
    if not len(config.data.garments) and patterns is None:
        raise ConfigError("data.garments=[]: give at least one, such as data.garments=[dress], or data.patterns=FOLDER")


def _in_folder(config: DictConfig, bar: TrainingBar, notes: list[str]) -> Trained:
    trainer = make_trainer(config)
    with held_folder(config) as folder:
        return Trained(folder / "model.safetensors", *_run(config, trainer, folder, bar), notes)


def _run(config: DictConfig, trainer: Trainer, folder: Path, bar: TrainingBar) -> tuple[int, bool]:
    """How many iterations are done, and whether the user interrupted them."""
    main = distributed.rank() == 0
    if distributed.on_main(lambda: _is_resumed(config, folder, trainer.checkpoint_path)):
        trainer.resume(trainer.checkpoint_path)
    distributed.on_main(lambda: save_run_record(folder, config, int(config.seed)))
    if trainer.choice is not None:
        tell_choice(trainer.choice)
    if main:
        parameters = sum(p.numel() for p in trainer.simulator.parameters())
        say(
            f"{parameters:,} parameters, {len(trainer.slots.sampler.garments)} garments, "
            f"{len(trainer.slots.sampler.sequences)} motions"
        )
    try:
        finished = _run_with_progress(trainer, bar)
    except OSError:
        if main and trainer.checkpoint_path.exists():
            say(
                f"hood: stopped at iteration {trainer.iteration}; {trainer.checkpoint_path} is intact, the same command with "
                "resume=true goes on from it",
                error=True,
            )
        raise
    if trainer.skipped:
        why, tried = trainer.why_skipped(), trainer.skipped + trainer.made
        if main:
            say(f"hood: {trainer.skipped} of {tried} updates were skipped, the last one{why}", error=True)
    if main:
        say(f"weights in {folder / 'model.safetensors'}, checkpoint in {trainer.checkpoint_path}")
    if main and trainer.stopped:
        say(f"stopped at iteration {trainer.iteration}: {trainer.stopped}; with callbacks=[] resume=true it goes on")
    if main and not finished:
        say(f"hood: stopped at iteration {trainer.iteration}; the same command with resume=true goes on", error=True)
    return trainer.iteration, not finished


def make_trainer(config: DictConfig) -> Trainer:
    """Everything named in the config, put together; seeds are set before the weights are made."""
    _check_values(config)
    torch.manual_seed(int(config.seed))
    simulator: NetworkStepper = build(config.model)
    settings = _make_settings(config)
    loggers, callbacks = _make_loggers(config), [_part("callbacks", node, Callback) for node in config.callbacks]
    potential: Potential = build(config.losses)
    settings.collision.require_its_weight(potential)
    fps = float(config.data.fps)
    earlier = 0
    if config.weights is not None:
        earlier = _start_from(simulator, str(config.weights), fps)
        if not settings.whitening:  # which is of the rows that this training sees
            settings = replace(settings, statistics_iterations=0)  # they come with the weights
    simulator.to(str(config.device))
    warn_if_slow("trainer.precision", settings.precision, torch.device(str(config.device)))
    leave_out = str(config.data.unusable) == "skip"
    names = find_motions(list(config.data.sequences) or motion_split()["train"], check=not leave_out)
    sampler = _make_scenes(
        config,
        body=load_body(str(config.data.body)),
        garments=_read_garments(config),
        sequences=_open_motions(config, names, fps, settings.horizon.maximum + 3),
        **_sampling(config),
        device=str(config.device),
    )
    folder = output_folder(config)
    watch = _make_watch(config, sampler, settings.collision.at_end(potential), folder) if settings.validate_every else None
    return Trainer(simulator, potential, sampler, settings, folder, int(config.seed), watch, earlier, loggers, callbacks)


def _make_settings(config: DictConfig) -> TrainerSettings:
    """Of the trainer; optimisers and schedulers of torch are made later, since they take the weights."""
    node = plain(config.trainer)
    parts = {key: node.pop(key) for key in ("optimizer", "schedule")}
    if isinstance(parts["optimizer"], dict):
        parts["optimizer"] = _unmade("trainer.optimizer", parts["optimizer"])
    schedule = _unmade("trainer.schedule", parts["schedule"])
    scheduler = isinstance(schedule.func, type) and issubclass(schedule.func, LRScheduler)
    parts["schedule"] = schedule if scheduler else made("trainer.schedule", schedule)
    return replace(build({**node, "time_scale": 1.0}), **parts, time_scale=float(node["time_scale"]))


def _make_loggers(config: DictConfig) -> list[Logger]:
    """What is told the figures, beside metrics.jsonl."""
    loggers: list[Logger] = []
    for given in config.loggers:
        if given == "jsonl":
            raise ConfigError("loggers: metrics.jsonl is always written; leave jsonl out, loggers=[] for it alone")
        if isinstance(given, str) and given not in LOGGERS:
            raise ConfigError(f"loggers: {unknown('logger', given, LOGGERS)}, or a class {{_target_: …}}")
        loggers.append(LOGGERS[given]() if isinstance(given, str) else _part("loggers", given, Logger))
        loggers[-1].config = plain(config)
    return loggers


def _make_scenes(config: DictConfig, **arguments: Any) -> SceneSampler:
    """What draws the scenes: hood's own class, or the one that ``data`` names, with its keys."""
    usual = load_config("train").data
    own = {key: value for key, value in plain(config.data).items() if key not in usual}
    if not own:
        return SceneSampler(**arguments)
    if "_target_" not in own:
        raise ConfigError(f"data.{next(iter(own))}: {unknown('key', next(iter(own)), list(usual))}")
    return _part("data", own, SceneSampler, **arguments)  # type: ignore[no-any-return]


def _part(key: str, node: Any, base: type, **arguments: Any) -> Any:
    """The object of a class of ``base`` that a table under a key names by ``_target_``, with the table's other keys."""
    part = _unmade(key, node)
    if not (isinstance(part.func, type) and issubclass(part.func, base)):
        raise ConfigError(f"{key}: {dotted_name(part.func)} is no class of {dotted_name(base)}")
    return made(key, part, **arguments)


def _unmade(key: str, node: Any) -> partial[Any]:
    """The class and the arguments of such a table."""
    table = plain(node)
    if not isinstance(table, dict) or "_target_" not in table:
        raise ConfigError(f"{key}={shown(table)}: give a class in braces, such as {{_target_: my_package.module.Class}}")
    several = {}  # schedulers in a scheduler take the optimiser, too
    if key == "trainer.schedule":
        several = {name: [_unmade(key, one) if isinstance(one, dict) else one for one in value]
                   for name, value in table.items() if isinstance(value, list)}  # fmt: skip
    try:
        part: partial[Any] = build({**table, **dict.fromkeys(several), "_partial_": True})
    except ConfigError as error:
        raise ConfigError(f"{key}: {str(error).removeprefix('configuration: ')}") from error
    return partial(part.func, **{**part.keywords, **several})


def _start_from(simulator: NetworkStepper, name: str, fps: float) -> int:
    """Give the simulator the weights and statistics of a shipped model or of a file; the updates behind them, 0 if unknown.

    Raises:
        ConfigError: they are of another model.
    """
    path = locate("weights", name)
    given = load_stepper(path, fps)
    way_out = f"give the model= that weights={name} were trained as"
    # No weight depends on which levels are taken, nor on how statistics would go on.
    require_same_model(path, given, simulator, way_out, free=("coarse_edge", "normalizer_decay"))
    simulator.load_state_dict(given.state_dict())
    return 0 if path.suffix.lower() in SUFFIXES else int(read_header(path).get("iteration", 0))


def _sampling(config: DictConfig) -> dict[str, Any]:
    """How scenes are drawn, with the fabric that was given for all of them."""
    sampling = plain(config.data.sampling)
    fabric = sampling["material"]
    if fabric is not None:
        key = f"data.sampling.material={shown(fabric)}"
        if not isinstance(fabric, dict):
            raise ConfigError(f"{key}: give properties of a fabric in braces, such as data.sampling.material={{density:0.2}}")
        strange = next((name for name in fabric if name not in Material.names()), None)
        if strange is not None:
            raise ConfigError(f"{key}: {unknown('property', str(strange), Material.names())}")
        text = next((name for name, value in fabric.items() if isinstance(value, str)), None)
        if text is not None:
            raise ConfigError(f"{key}: {text} is {fabric[text]!r}; give a number")
        sampling["material"] = Material(**fabric)
    return sampling


def _read_garments(config: DictConfig) -> list[Garment]:
    """Those of ``data.garments``, and behind them those of the folder ``data.patterns``."""
    names, folder = [str(name) for name in config.data.garments], config.data.patterns
    if folder is not None:
        names += map(str, garments_in(Path(str(folder)).expanduser()))
    return [as_simulated(load_garment(name)) for name in names]


def _open_motions(config: DictConfig, names: list[str], fps: float, min_frames: int) -> MotionFiles:
    """The training motions, read when they are drawn."""
    reading = _reading(config)
    load = partial(load_sequence, fps=fps, **reading)
    skip = str(config.data.unusable) == "skip"
    motions = MotionFiles(names, load, fps, min_frames, skip, file_fps=reading["file_fps"])
    if motions.skipped and distributed.rank() == 0:
        say(f"hood: {len(motions.skipped)} of {len(names)} motions skipped, first: {motions.skipped[0]}", error=True)
    return motions


def _reading(config: DictConfig) -> dict[str, Any]:
    """The keys of ``data`` that say how motion files are read, for :func:`hood.assets.motion.load.load_sequence`."""
    person, rate = config.data.person, config.data.file_fps
    return {
        "up": str(config.data.up),
        "person": None if person is None else str(person),
        "trans_unit": str(config.data.trans_unit or "auto"),
        "file_fps": None if rate is None else float(rate),
    }


def _make_watch(config: DictConfig, sampler: SceneSampler, potential: Potential, folder: Path) -> ValidationWatch:
    names = find_motions(list(config.data.validation_sequences) or motion_split()["validation"], "validation")
    motions = [load_sequence(str(name), float(config.data.fps), **_reading(config)) for name in names]
    validation = Validation(
        sampler.body,
        sampler.garments[: len(config.data.garments) or None],  # hundreds of patterns would take longer than the training
        motions,
        for_networks(potential),
        num_frames=int(config.data.validation_frames),
        states=int(config.validation_states),
        device=str(config.device),
    )
    return ValidationWatch(validation, folder)


def is_finished(config: DictConfig, folder: Path) -> bool:
    """Whether the run in a folder has all iterations that the config asks for, and wrote its weights.

    Raises:
        ConfigError: the run there has other settings.
    """
    iteration, written = reached(folder)
    if iteration:
        require_same_config(config, folder, _FREE, _BOOKKEEPING)
    return written and iteration >= iterations_of(plain(config.trainer))


def iterations_of(trainer: Mapping[str, Any]) -> int:
    """Updates in all that the settings of a trainer say."""
    return scaled_count("trainer.iterations", int(trainer["iterations"]), float(trainer.get("time_scale", 1.0)))


def last_record(folder: Path) -> dict[str, float]:
    """The latest of every figure in the ``metrics.jsonl`` of a run, and the ``seconds`` that its updates took, at the rate of
    the last of its processes; empty where there is none. A line cut by a kill is passed over."""
    path = folder / "metrics.jsonl"
    figures: dict[str, float] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else ():
        try:
            read = {str(name): math.nan if value is None else float(value) for name, value in json.loads(line).items()}
        except (ValueError, TypeError, AttributeError):
            continue
        if read.get("iterations_per_second", 0.0) > 0:
            read["seconds"] = read.get("iteration", math.nan) / read["iterations_per_second"]
        figures |= read
    return figures


def _is_resumed(config: DictConfig, folder: Path, checkpoint: Path) -> bool:
    """Whether the folder's run goes on; a run that is in the way is refused."""
    if checkpoint.exists() or previous(checkpoint).exists():
        if not bool(config.resume):
            raise ConfigError(f"{folder} holds a training run; pass resume=true to go on or another output")
        # It must see the same data and schedule, or its losses would not be those of an uninterrupted run.
        require_same_config(config, folder, _FREE, _BOOKKEEPING)
        return True
    if bool(config.resume) and any(folder.glob("*.safetensors")):
        raise ConfigError(f"{folder}: nothing to resume, checkpoint.pt is missing")
    if bool(config.resume):
        say(f"resume=true: no training in {folder} yet, this one begins")
    return False


def _run_with_progress(trainer: Trainer, bar: TrainingBar) -> bool:
    """Train under what shows how far it is; SIGTERM and Ctrl-C end it after the current iteration, with a checkpoint."""
    stop = {"asked": False}

    def ask(signum: int, frame: object) -> None:
        stop["asked"] = True

    previous = {number: signal.signal(number, ask) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        with bar(trainer.settings.iterations, trainer.iteration) as tick:
            return trainer.run(tick, lambda: stop["asked"])
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)

"""What ``hood tradeoff`` refuses before hours are spent on it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from omegaconf import DictConfig

from hood.assets.files.library import locate
from hood.commands.batch import expand_sequences, require_motions
from hood.commands.common import UNTRAINED, require_device, require_distinct, require_package
from hood.commands.garments import shape_coefficients
from hood.commands.steppers import find_option
from hood.config import ConfigError, load_config, options, plain
from hood.dynamics.checkpoint import read_header
from hood.dynamics.reference import SUFFIXES
from hood.dynamics.refine import METHODS
from hood.evaluation.grid import Point
from hood.evaluation.table import GUESS, NEWTON
from hood.nn.precision import PRECISIONS, TF32, check_precision

#: Keys of ``hood evaluate`` that every point sets by itself.
_OWN = (
    "models", "garments", "sequences", "num_frames", "gap_states", "precision", "refine_method", "device", "output", "resume",
    "max_rollouts",
)  # fmt: skip


def check_config(config: DictConfig, sizes: Sequence[str]) -> None:
    """Raise ConfigError where a key cannot be meant; names it."""
    require_device(config)
    require_package("matplotlib", "matplotlib", "charts", "hood tradeoff")
    for key in ("jobs", "turns"):
        if int(config[key]) < 1:
            raise ConfigError(f"{key}={config[key]}: must be at least 1")
    for key, known in (("refine_methods", METHODS), ("precisions", (*PRECISIONS, TF32))):
        given = [str(name) for name in config[key]]
        if not given or not set(given) <= set(known):
            raise ConfigError(f"{key}={plain(config[key])}: give some of {', '.join(known)}")
        require_distinct(key, given)
    for precision in config.precisions:
        check_precision(str(precision), torch.device(str(config.device)))
    sequences = [str(name) for name in config.sequences]
    require_motions("sequences", sequences)
    motions = expand_sequences(sequences)
    if not motions:
        raise ConfigError("sequences=[]: give motions")
    require_distinct("sequences", motions)
    for size in sizes:
        _check_size(config, size)


def check_models(names: Sequence[str]) -> None:
    """Raise an error unless every name is one of weights that are there, of random ones, or of a stepper.

    Raises:
        FileNotFoundError: no such weights.
        ValueError: not a model file, or no network's name; names it.
    """
    require_distinct("models", names)
    for name in names:
        if name in (GUESS, NEWTON):
            raise ConfigError(f"models: {name!r} is the solver, which has keys of its own: newton=true and guess_1k, _4k, _12k")
        if name.startswith(UNTRAINED + ":"):
            if name.removeprefix(UNTRAINED + ":") not in options("model"):
                raise ConfigError(f"models: {name!r} is no model; known are {', '.join(options('model'))}")
            continue
        if find_option(name) is not None:
            continue
        path = locate("weights", name)
        if path.suffix.lower() not in SUFFIXES:
            read_header(path)


def check_points(points: Sequence[Point]) -> None:
    """Raise ConfigError unless there are points, and ``hood evaluate`` reads their settings."""
    if not points:
        raise ConfigError("no point is left to measure: give garments, and models or newton=true")
    for point in {point.size: point for point in points}.values():
        load_config("evaluate", point.settings)


def check_settings(settings: Sequence[str]) -> None:
    """Raise ConfigError where one of the further ``settings`` of every point is one that points differ in."""
    for text in settings:
        key = text.split("=")[0].strip()
        if key in _OWN:
            raise ConfigError(f"settings: {key} is set by hood tradeoff itself; leave it out")


def _check_size(config: DictConfig, size: str) -> None:
    for key, least, why in (("frames", 4, "the first frames are not timed"), ("states", 1, "γ is what the chart shows")):
        if int(config[f"{key}_{size}"]) < least:
            raise ConfigError(f"{key}_{size}={config[f'{key}_{size}']}: must be at least {least}, {why}")
    for key, least in (("refine", 0), ("guess", 1)):
        for value in plain(config[f"{key}_{size}"]):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ConfigError(f"{key}_{size}: {value!r} is no number of iterations; give whole numbers from {least} on")
    if not plain(config[f"shapes_{size}"]):
        raise ConfigError(f"shapes_{size}=[]: give shape coefficients; [[]] is the mean body")
    for shape in plain(config[f"shapes_{size}"]):
        shape_coefficients(shape, f"shapes_{size}")
    for key in ("garments", "models", "precisions", "refine", "guess", "shapes"):
        require_distinct(f"{key}_{size}", plain(config[f"{key}_{size}"]))

"""What the commands share: the output folder, the device, the word for random weights."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from omegaconf import DictConfig

from hood.config import ConfigError, require_choice
from hood.dynamics.reference import SUFFIXES, load_reference_checkpoint
from hood.dynamics.simulator import Simulator, load_simulator

#: ``checkpoint=untrained``: seeded random weights instead of a file.
UNTRAINED = "untrained"


def prepare_folder(folder: Path) -> Path:
    """The output folder, made and checked for writing.

    Raises:
        OSError: it cannot be made or written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(13, "Permission denied", str(folder))
    return folder


def read_model(path: Path, fps: float) -> Simulator:
    """The simulator in a model file or in published HOOD weights (``.pth``), for motions at ``fps``.

    Raises:
        ConfigError: the model knows another frame rate only.
    """
    simulator = load_reference_checkpoint(path) if path.suffix.lower() in SUFFIXES else load_simulator(path)
    frame_dt = simulator.rules.frame_dt
    if frame_dt is not None and abs(fps * frame_dt - 1) > 1e-3:
        raise ConfigError(f"fps={fps:g}: {path} knows steps of 1/{1 / frame_dt:g} s only; use fps={1 / frame_dt:g}")
    return simulator


def require_device(config: DictConfig) -> None:
    """Raise ConfigError unless ``config.device`` is known and present."""
    require_choice(config, "device", ("cpu", "cuda"))
    if str(config.device) == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device=cuda: no CUDA device is available; use device=cpu")

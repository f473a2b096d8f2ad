"""What the commands share: the output folder, the device, the word for random weights."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from omegaconf import DictConfig

from hood.config import ConfigError, require_choice

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


def require_device(config: DictConfig) -> None:
    """Raise ConfigError unless ``config.device`` is known and present."""
    require_choice(config, "device", ("cpu", "cuda"))
    if str(config.device) == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device=cuda: no CUDA device is available; use device=cpu")

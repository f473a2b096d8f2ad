"""``hood convert``: published HOOD weights in, a model file of this project out."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from hood.assets.library import locate
from hood.commands.common import prepare_folder
from hood.config import ConfigError, load_config
from hood.dynamics.reference import SUFFIXES, read_reference_checkpoint
from hood.dynamics.simulator import save_simulator

_MODEL = ".safetensors"


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    config = load_config("convert", overrides)
    source, target = _paths(config)
    simulator, layout = read_reference_checkpoint(source)
    prepare_folder(target.parent)
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    save_simulator(target, simulator, {"source": source.name, "source_sha256": digest, "layout": layout})
    count = sum(parameter.numel() for parameter in simulator.parameters())
    print(f"{source}: {layout} weights, {len(simulator.schedule)} steps, {count} parameters")
    print(f"written to {target}")
    return 0


def _paths(config: DictConfig) -> tuple[Path, Path]:
    """File to read and file to write."""
    if config.checkpoint is None:
        raise ConfigError("checkpoint is not given: hood convert checkpoint=weights.pth output=weights.safetensors")
    source = locate("weights", str(config.checkpoint))
    if source.suffix == _MODEL:
        raise ConfigError(f"{source}: is a model file already; give published weights ({', '.join(SUFFIXES)})")
    target = source.with_suffix(_MODEL) if config.output is None else Path(str(config.output)).expanduser()
    if target.suffix != _MODEL:
        raise ConfigError(f"output={target}: model files end in {_MODEL}")
    return source, target

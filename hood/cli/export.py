"""``hood export``: a rollout as files that other programs open.

``hood convert``: published HOOD weights in, a model file of this project out; or a model file at half its size.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig

from hood.app.common import prepare_folder
from hood.app.output.export import export
from hood.app.settings.compose import ConfigError, load_config
from hood.assets.files.library import locate
from hood.steppers.checkpoint import CAUTION, load_simulator, read_header, save_simulator
from hood.steppers.network import NetworkStepper
from hood.steppers.published import SUFFIXES, read_reference_checkpoint

_MODEL = ".safetensors"


def run(arguments: Sequence[str]) -> int:
    """Run the command ``export``; returns the exit code."""
    _, said = export(arguments)
    print("\n".join(said))
    return 0


def convert(overrides: Sequence[str]) -> int:
    """Run the command ``convert``; returns the exit code."""
    config = load_config("convert", overrides)
    source, target = _paths(config)
    simulator, header = _read(source)
    if config.caution is not None:
        simulator.caution = " ".join(str(config.caution).split())
        header.pop(CAUTION, None)
    prepare_folder(target.parent)
    save_simulator(target, simulator, header, half=bool(config.half))
    count = sum(parameter.numel() for parameter in simulator.parameters())
    print(f"{source}: {header.get('layout', 'native')} weights, {len(simulator.schedule)} steps, {count} parameters")
    print(f"written to {target}" + (f" in float16, weights changed by {_change(simulator, target):.1e}" if config.half else ""))
    return 0


def _read(source: Path) -> tuple[NetworkStepper, dict[str, str]]:
    """The model and what its file will say about where it comes from."""
    if source.suffix == _MODEL:
        return load_simulator(source), read_header(source)
    simulator, layout = read_reference_checkpoint(source)
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    return simulator, {"source": source.name, "source_sha256": digest, "layout": layout}


@torch.no_grad()
def _change(simulator: NetworkStepper, path: Path) -> float:
    """The root of the mean square change of the weights in the file over that of the weights."""
    written = dict(load_simulator(path).named_parameters())
    change = sum(float((written[name] - value).square().sum()) for name, value in simulator.named_parameters())
    return (change / sum(float(value.square().sum()) for value in simulator.parameters())) ** 0.5


def _paths(config: DictConfig) -> tuple[Path, Path]:
    """File to read and file to write."""
    if config.checkpoint is None:
        raise ConfigError("checkpoint is not given: hood convert checkpoint=weights.pth output=weights.safetensors")
    source = locate("weights", str(config.checkpoint))
    if source.suffix == _MODEL and not config.half and config.caution is None:
        raise ConfigError(
            f"{source}: is a model file already; give published weights ({', '.join(SUFFIXES)}), "
            "or half=true output=small.safetensors, or a caution for its users"
        )
    if source.suffix == _MODEL and config.output is None:
        raise ConfigError(f"output is not given: where the copy of {source} goes, e.g. output=small.safetensors")
    target = source.with_suffix(_MODEL) if config.output is None else Path(str(config.output)).expanduser()
    if target.suffix != _MODEL:
        raise ConfigError(f"output={target}: model files end in {_MODEL}")
    return source, target

"""Checkpoints: a model's weights as safetensors, with what it takes to build it in the header."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import first_line
from hood.dynamics.ranges import Conditions
from hood.dynamics.simulator import Simulator, build_simulator

_FORMAT = "hood-1"
_RANGES = "ranges"


def save_simulator(path: Path, simulator: Simulator, metadata: Mapping[str, str] | None = None, half: bool = False) -> None:
    """Write weights and model config as safetensors, atomically.

    ``half`` stores what was learned in float16; statistics stay in float32, their counts are beyond its range.

    Raises:
        ValueError: a weight is beyond the range of float16.
    """
    learned = {name for name, _ in simulator.named_parameters()} if half else set()
    tensors = {name: value.half() if name in learned else value for name, value in simulator.state_dict().items()}
    for name in learned:
        if not bool(torch.isfinite(tensors[name]).all()):
            raise ValueError(f"{name}: a weight beyond the range of float16; keep this model in float32")
    tensors = {name: value.contiguous() for name, value in tensors.items()}
    known = {} if simulator.trained_for is None else {_RANGES: simulator.trained_for.to_json()}
    header = {"format": _FORMAT, "model": json.dumps(simulator.config), **known, **(metadata or {})}
    write_atomically(path, save(tensors, header))


def record_ranges(path: Path, trained_for: Conditions) -> None:
    """Write into a model file what it was trained for; its tensors stay as they are, to the bit.

    Raises:
        ValueError: not a file written by :func:`save_simulator`.
    """
    _read_file(path)
    content = path.read_bytes()
    begin = 8 + int.from_bytes(content[:8], "little")  # of the tensors, after the size of the header and the header
    header = json.loads(content[8:begin])
    header["__metadata__"][_RANGES] = trained_for.to_json()
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # the format's alignment
    write_atomically(path, len(text).to_bytes(8, "little") + text + content[begin:])


def read_header(path: Path) -> dict[str, str]:
    """What a model file says about itself beside its weights: ``model``, ``ranges``, and where it comes from.

    Raises:
        ValueError: not a file written by :func:`save_simulator`.
    """
    return _read_file(path)[1]


def load_simulator(path: Path) -> Simulator:
    """Read a simulator written by :func:`save_simulator`.

    Raises:
        ValueError: not such a file, or weights that do not fit the model it names.
    """
    tensors, header = _read_file(path)
    try:
        trained_for = Conditions.from_json(header[_RANGES]) if _RANGES in header else None
    except ValueError as error:
        raise ValueError(f"{path}: {error}; the file is damaged") from error
    try:
        settings = _settings(header)
        with torch.device("meta"):  # shapes alone: a damaged header may name a model larger than the memory
            expected = build_simulator(**settings).state_dict()
    except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = first_line(error)
        raise ValueError(f"{path}: names a model that this version cannot build ({reason}); train it again") from error
    wrong = [
        name
        for name in {*expected, *tensors}
        if name not in tensors or name not in expected or tensors[name].shape != expected[name].shape
    ]
    if wrong:
        raise ValueError(f"{path}: weights do not fit the model in the file, first at {sorted(wrong)[0]!r}; it is damaged")
    simulator = build_simulator(**settings)
    simulator.load_state_dict({name: value.to(expected[name].dtype) for name, value in tensors.items()})
    simulator.trained_for = trained_for
    return simulator.eval()


def _settings(header: Mapping[str, str]) -> dict[str, Any]:
    """Arguments of :func:`build_simulator` in a header: plain values by name."""
    settings = json.loads(header["model"])
    if not isinstance(settings, dict) or any(isinstance(value, (dict, list)) for value in settings.values()):
        raise TypeError("its settings are no plain values by name")
    return settings


def _read_file(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError as error:
        raise ValueError(f"{path}: not a model file ({error}); give the model.safetensors of a run") from error
    if header.get("format") != _FORMAT:
        raise ValueError(f"{path}: not a hood model (format {header.get('format')!r}); give the model.safetensors of a run")
    return tensors, header

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

from hood import plugins
from hood.assets.files.atomic import write_atomically
from hood.assets.files.guarded import first_line
from hood.model.parts import plugins_of
from hood.steppers.network import NetworkStepper, build_simulator
from hood.steppers.ranges import Conditions

_FORMAT = "hood-1"
_RANGES = "ranges"
#: A sentence that users of the weights are told; most files have none.
CAUTION = "caution"
#: What the model takes from plugins, and the package of each; models without any have no such entry.
_PLUGINS = "plugins"
#: Characters of a name that is told.
_TOLD = 80
#: Characters of a caution.
_SENTENCE = 300


def save_simulator(
    path: Path, simulator: NetworkStepper, metadata: Mapping[str, str] | None = None, half: bool = False
) -> None:
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
    needed = plugins_of(simulator.config)
    known |= {_PLUGINS: json.dumps(needed)} if needed else {}
    known |= {CAUTION: simulator.caution} if simulator.caution else {}
    header = {"format": _FORMAT, "model": json.dumps(simulator.config), **known, **(metadata or {})}
    write_atomically(path, _in_order(save(tensors, header)))


def _in_order(content: bytes) -> bytes:
    """A safetensors file with the entries of its metadata in order: the library writes them in another one each time, and the
    same weights would have another digest."""
    header, tensors = _parts(content)
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    return _whole(header, tensors)


def _parts(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Header and tensors of a safetensors file."""
    begin = 8 + int.from_bytes(content[:8], "little")
    return json.loads(content[8:begin]), content[begin:]


def _whole(header: Mapping[str, Any], tensors: bytes) -> bytes:
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # the format's alignment
    return len(text).to_bytes(8, "little") + text + tensors


def record_ranges(path: Path, trained_for: Conditions) -> None:
    """Write into a model file what it was trained for; its tensors stay as they are, to the bit.

    Raises:
        ValueError: not a file written by :func:`save_simulator`.
    """
    _read_file(path)
    header, tensors = _parts(path.read_bytes())
    header["__metadata__"][_RANGES] = trained_for.to_json()
    write_atomically(path, _whole(header, tensors))


def read_header(path: Path) -> dict[str, str]:
    """What a model file says about itself beside its weights: ``model``, ``ranges``, and where it comes from.

    Raises:
        ValueError: not a file written by :func:`save_simulator`.
    """
    return _read_file(path)[1]


def load_simulator(path: Path) -> NetworkStepper:
    """Read a simulator written by :func:`save_simulator`.

    Raises:
        ValueError: not such a file, weights that do not fit the model it names, or a model that needs a package which is
            not installed; names the file and the package.
    """
    tensors, header = _read_file(path)
    try:
        trained_for = Conditions.from_json(header[_RANGES]) if _RANGES in header else None
    except ValueError as error:
        raise ValueError(f"{path}: {error}; the file is damaged") from error
    _require_plugins(path, header)
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
    simulator.trained_for, simulator.caution = trained_for, _sentence(header.get(CAUTION, ""))
    return simulator.eval()


def _sentence(text: str) -> str | None:
    """A line that a terminal can be given, whatever the file says; None for nothing."""
    shown = "".join(letter for letter in " ".join(text.split()) if letter.isprintable())
    return shown[:_SENTENCE] or None


def _settings(header: Mapping[str, str]) -> dict[str, Any]:
    """Arguments of :func:`build_simulator` in a header: plain values by name."""
    settings = json.loads(header["model"])
    plain = isinstance(settings, dict) and not any(
        isinstance(value, list) or (isinstance(value, dict) and key != "output_options") for key, value in settings.items()
    )
    if not plain or any(isinstance(value, (dict, list)) for value in (settings.get("output_options") or {}).values()):
        raise TypeError("its settings are no plain values by name")
    assert isinstance(settings, dict)
    return settings


def _require_plugins(path: Path, header: Mapping[str, str]) -> None:
    """Refuse a model whose plugins are not installed; nothing is imported for it.

    Raises:
        ValueError: names the file, the package and what it takes from it.
    """
    try:
        needed = json.loads(header.get(_PLUGINS, "{}"))
        pairs = [(*key.split("/", 1), str(package)) for key, package in needed.items()]
        wanted = [(kind, name, package) for kind, name, package in pairs if kind in plugins.KINDS]
    except (ValueError, AttributeError, TypeError) as error:
        raise ValueError(f"{path}: its list of plugins cannot be read; the file is damaged") from error
    for kind, name, package in wanted:
        owner = plugins.origin(kind, name) if name in plugins.names(kind) else None
        title = package.split(" ")[0][:_TOLD]
        if owner is None or owner.split(" ")[0] != title:
            here = "is not installed here" if owner is None else f"is another one here ({owner})"
            raise ValueError(
                f"{path}: the model takes {name[:_TOLD]!r} (hood.{kind}) from the package {package[:_TOLD]}, which {here}; "
                f"install {title}"
            )


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

"""Published HOOD weights as a :class:`hood.dynamics.simulator.Simulator`, with the conventions they were trained with.

Four files exist: ``postcvpr`` (the authors' later training), ``cvpr`` (the paper's), and the paper's single-level baselines
``fine15`` and ``fine48``. The function computed is that of the reference implementation: the same features in the same
units, the same networks, the same treatment of pinned vertices, velocities and the relaxing first step
(:class:`hood.dynamics.frames.Relaxing`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hood.assets.pickles.torch_file import load_torch
from hood.assets.pickles.unpickle import SIZE_LIMIT
from hood.dynamics.simulator import Simulator, build_simulator
from hood.nn.reference_keys import MODEL, Layout, Source, detect_layout, match, network_sources, neutral

#: Suffixes of files that :func:`load_reference_checkpoint` reads.
SUFFIXES = (".pth", ".pt", ".ckpt")
#: Units of the weights: velocities are displacements per frame of this length [s].
FRAME_DT = 1.0 / 30.0
#: Least divisor of the statistics.
STD_FLOOR = 1e-8

_NORMALIZERS = {
    "output.normalizer": "_output_normalizer",
    "features.node_normalizer": "_node_normalizer",
    "features.edge_normalizer": "_mesh_edge_normalizer",
    "features.body_edge_normalizer": "_world_edge_normalizer",
}
_SUMS = {"weight": "_acc_count", "num_updates": "_num_accumulations", "first": "_acc_sum", "second": "_acc_sum_squared"}
_EMBEDDINGS = {"features.node.1.table.weight": "nodetype_embedding", "features.node.2.table.weight": "vertexlevel_embedding"}


def load_reference_checkpoint(path: str | Path, size_limit: int = SIZE_LIMIT) -> Simulator:
    """The simulator in a published ``.pth`` checkpoint, in evaluation mode; nothing in the file is run.

    Args:
        path: a training checkpoint (entry ``training_module``) or its state dict alone.
        size_limit: bytes; larger files are refused.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not such a checkpoint; names the key that does not fit and the nearest expected one.

    Examples:
        >>> import hood
        >>> simulator = hood.load_reference_checkpoint("postcvpr.pth")
        >>> simulator.network.latent_dim
        128
    """
    return read_reference_checkpoint(path, size_limit)[0]


def read_reference_checkpoint(path: str | Path, size_limit: int = SIZE_LIMIT) -> tuple[Simulator, str]:
    """The same, and the name of the layout: ``postcvpr``, ``cvpr``, ``fine15`` or ``fine48``."""
    content = load_torch(path, size_limit)
    try:
        return import_reference_weights(_weights(content))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def import_reference_weights(state: Mapping[str, Tensor]) -> tuple[Simulator, str]:
    """Simulator and layout name of a state dict in one of the published layouts.

    Its trainable parameters are those of the file, a coarse encoder that no step uses included. Statistics are frozen.

    Raises:
        ValueError: a key or shape that does not fit.
    """
    layout = detect_layout(state)
    state = {key: value for key, value in state.items() if not _is_floor(key, value)}
    tensors = match(_sources(layout), state)
    with torch.random.fork_rng(devices=[]):  # the weights drawn here are replaced
        simulator = build_simulator(**_arguments(layout, tensors))
    expected = simulator.state_dict()
    tensors |= _statistics(tensors)
    keys = {ours: source.key for ours, source in _sources(layout).items()}
    for name, value in expected.items():
        if tensors[name].shape != value.shape:
            raise ValueError(
                f"key {keys[name]!r} has shape {tuple(tensors[name].shape)} where a {layout.name} model "
                f"of its width has {tuple(value.shape)}; the file is damaged or of another model"
            )
    simulator.load_state_dict({name: tensors[name].to(value.dtype) for name, value in expected.items()})
    return simulator.eval(), layout.name


def _weights(content: Any) -> dict[str, Tensor]:
    """The state dict in a file's content; a bare one is accepted."""
    if isinstance(content, dict) and "simulator" in content:
        raise ValueError("is the training state of a run; give the model.safetensors beside it")
    state = content.get("training_module", content) if isinstance(content, dict) else content
    if not isinstance(state, dict) or not state:
        found = f"found {sorted(map(str, content))[:6]}" if isinstance(content, dict) else f"found a {type(content).__name__}"
        raise ValueError(f"no state dict under 'training_module' ({found}); give a published HOOD checkpoint")
    foreign = [str(key) for key, value in state.items() if not isinstance(value, Tensor)]
    if foreign:
        raise ValueError(f"entry {foreign[0]!r} is not a tensor; give a published HOOD checkpoint or its state dict")
    return {str(key): value for key, value in state.items()}


def _sources(layout: Layout) -> dict[str, Source]:
    sources = {f"network.{name}": source for name, source in network_sources(layout).items()}
    for ours, theirs in _NORMALIZERS.items():
        sources |= {f"{ours}.{sum_}": Source(f"{MODEL}{theirs}.{key}") for sum_, key in _SUMS.items()}
    embeddings = list(_EMBEDDINGS.items())[: 1 if layout.nodes_last else 2]
    return sources | {ours: Source(f"{MODEL}{theirs}.weight") for ours, theirs in embeddings}


def _arguments(layout: Layout, tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """Arguments of build_simulator: the sizes of the file and the conventions of its layout."""
    later = layout.name == "postcvpr"
    arguments: dict[str, Any] = {
        "features": "paper",
        "output": "acceleration",
        "schedule": layout.schedule,
        "latent_dim": tensors["network.node_encoder.first.weight"].shape[0],
        "normalizer_decay": 1.0,
        "body_velocity": "previous" if later else "next",
        "divisor_floor": STD_FLOOR,
        "frame_dt": FRAME_DT,
        "pins_ahead": True,
        "velocity": "carried" if later else "displacement",
    }
    if not layout.nodes_last:
        # The level embedding counts a coarse level that no step works on.
        arguments["embedded_levels"] = len(tensors["features.node.2.table.weight"])
        arguments["coarse_encoders"] = 1 if layout.coarse_encoders is None else layout.coarse_encoders
    return arguments


def _statistics(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Buffers of our normalisers: sums over rows and their count, taken over as they are."""
    buffers = {}
    for name in _NORMALIZERS:
        first, second = tensors[f"{name}.first"].double().reshape(-1), tensors[f"{name}.second"].double().reshape(-1)
        count = tensors[f"{name}.weight"].double().reshape(-1)
        if count.numel() != 1 or not bool(torch.isfinite(torch.cat([first, second, count])).all()):
            raise ValueError(f"statistics {MODEL}{_NORMALIZERS[name]!s} are not finite sums; the file is damaged")
        buffers[f"{name}.first"], buffers[f"{name}.second"] = first, second
        buffers[f"{name}.weight"] = count[0].clamp_min(1.0)
        calls = tensors[f"{name}.num_updates"].reshape(-1)[0].double()
        buffers[f"{name}.num_updates"] = calls.clamp_min(1.0).long()
        buffers[f"{name}.frozen"] = torch.tensor(True)
    return buffers


def _is_floor(key: str, value: Tensor) -> bool:
    """Whether ``key`` is the floor of a normaliser, which some versions save beside the sums."""
    if not neutral(key).endswith("_normalizer._std_epsilon"):
        return False
    floor = float(value.reshape(-1)[0])
    if abs(floor - STD_FLOOR) > 1e-3 * STD_FLOOR:
        raise ValueError(f"key {key!r} is {floor:g}; only statistics with the floor {STD_FLOOR:g} are read")
    return True

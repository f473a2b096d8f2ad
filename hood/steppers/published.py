"""Published HOOD weights as a :class:`hood.steppers.network.NetworkStepper`, with the conventions they were trained with.

Four files exist: ``postcvpr`` (the authors' later training), ``cvpr`` (the paper's), and the paper's single-level baselines
``fine15`` and ``fine48``. The function computed is that of the reference implementation: the same features in the same
units, the same networks, the same treatment of pinned vertices, velocities and the relaxing first step
(:class:`hood.steppers.protocol.Relaxing`).

Names and layouts of the published HOOD weights, and where their tensors stand in our networks.

Four layouts exist. All keep a three-layer network as ``0.layers.{0,2,4}`` with its layer norm as ``1`` (the decoder, which
has none, as ``layers.{0,2,4}``); they differ in how processor steps are named, in the number of coarse encoders, and
in the order of the node network's input.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hood.assets.pickles.content import load_torch
from hood.assets.pickles.records import PICKLE_LIMIT
from hood.model.graph.builder import BODY, MESH, SCHEDULES, Step, edge_set_names, parse_schedule
from hood.steppers.network import NetworkStepper, build_simulator

MODEL = "model."
NETWORK = "model._learned_model."
_LAYERS = {"first": "layers.0", "second": "layers.2", "third": "layers.4"}
#: Prefixes that wrappers add and that older files lack.
_PREFIX = re.compile(r"^(?:(?:training_module|module|model|_learned_model)\.)*")
_STEP = re.compile(
    r"(levels\.\d+\.\d+|processor_steps\d+\.\d+|processor_steps\.\d+)\."
    r"(?:edge_processor_dict\.|node_processor_dict\.)?(node|mesh_edge|world_edge|coarse_edge\d+)(?:_processor)?\.(.+)"
)


@dataclass(frozen=True)
class _Layout:
    """One way of writing a model down.

    ``coarse_encoders`` is None where there is one network for all coarse levels.
    """

    name: str
    schedule: str
    coarse_encoders: int | None = 0

    @property
    def steps(self) -> tuple[Step, ...]:
        return parse_schedule(self.schedule)

    @property
    def nodes_last(self) -> bool:
        """Whether the node network's input is [mesh, world, node] instead of [node, coarse…, mesh, world]."""
        return self.name.startswith("fine")


@dataclass(frozen=True)
class Source:
    """A tensor of the file: its key, and the order of its column blocks in ours (None: as they are)."""

    key: str
    blocks: tuple[int, ...] | None = None

    def take(self, tensor: Tensor) -> Tensor:
        """The tensor as our network has it."""
        if self.blocks is None:
            return tensor
        parts = tensor.chunk(len(self.blocks), dim=1)
        return torch.cat([parts[i] for i in self.blocks], dim=1)


def neutral(key: str) -> str:
    """``key`` without prefixes and with processor names in one spelling: what two spellings of one tensor share."""
    key = _PREFIX.sub("", key)
    key = re.sub(r"^edgeset_encoders\.(mesh|world|coarse)_edge", r"edgeset_encoders.\1", key)
    step = _STEP.fullmatch(key)
    return key if step is None else ".".join(step.groups())


def detect_layout(keys: Iterable[str]) -> _Layout:
    """The layout that the names of a state dict belong to.

    Raises:
        ValueError: none; names the key that comes nearest to one.
    """
    keys = list(keys)
    names = [neutral(key) for key in keys]
    if any(name.startswith("levels.") for name in names):
        count = len({name.split(".")[1] for name in names if re.match(r"edgeset_encoders\.coarse\d+\.", name)})
        return _Layout("postcvpr", "ours", count)
    if any(re.match(r"processor_steps\d+\.", name) for name in names):
        return _Layout("cvpr", "ours", None)
    steps = {int(name.split(".")[1]) for name in names if re.match(r"processor_steps\.\d+\.", name)}
    if steps:
        name = f"fine{len(steps)}"
        return _Layout(name, name if name in SCHEDULES else f"{len(steps)}x(mesh)")
    anchors = [NETWORK + anchor for anchor in ("levels.0.0", "processor_steps1.0", "processor_steps.0", "node_encoder")]
    near = _nearest(anchors[0], keys)
    found = f"the nearest key is {near!r}" if near else f"found {len(keys)} keys, such as {keys[:2]}"
    raise ValueError(f"not HOOD weights: no processor steps ({' or '.join(a + '.…' for a in anchors[:3])}); {found}")


def network_sources(layout: _Layout) -> dict[str, Source]:
    """Where each tensor of our network comes from, by our name."""
    sources = {**_mlp("node_encoder", "node_encoder.0", "node_encoder.1"), **_mlp("decoder", "decoder", None)}
    for ours, theirs in _encoders(layout).items():
        sources |= _mlp(f"edge_encoders.{ours}", f"edgeset_encoders.{theirs}.0", f"edgeset_encoders.{theirs}.1")
    for index, sets in enumerate(layout.steps):
        for name in (*sets, BODY):
            theirs = _step_key(layout, index, _edge_name(name))
            sources |= _mlp(f"steps.{index}.edge_mlps.{name}", f"{theirs}.0", f"{theirs}.1")
        theirs = _step_key(layout, index, "node")
        node = _mlp(f"steps.{index}.node_mlp", f"{theirs}.0", f"{theirs}.1")
        if layout.nodes_last:
            weight = f"steps.{index}.node_mlp.first.weight"
            node[weight] = Source(node[weight].key, (2, 0, 1))
        sources |= node
    return {ours: Source(NETWORK + source.key, source.blocks) for ours, source in sources.items()}


def match(sources: Mapping[str, Source], state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors by our names; every key of ``state`` is used and every source found.

    Raises:
        ValueError: a key that has no place here or one that is missing; names it and the nearest one.
    """
    given: dict[str, str] = {}
    for key in state:
        if neutral(key) in given:
            raise ValueError(f"keys {given[neutral(key)]!r} and {key!r} name the same tensor; remove one")
        given[neutral(key)] = key
    expected = {neutral(source.key): source.key for source in sources.values()}
    for short, key in given.items():
        if short not in expected:
            free = [expected[name] for name in expected if name not in given]
            raise ValueError(f"key {key!r} does not fit{_hint(key, free or expected.values())}")
    for short, key in expected.items():
        if short not in given:
            raise ValueError(f"key {key!r} is missing{_hint(key, given.values())}")
    return {ours: source.take(state[given[neutral(source.key)]]) for ours, source in sources.items()}


def _nearest(key: str, known: Iterable[str]) -> str | None:
    """The most similar of ``known``."""
    # Keys share long prefixes: only the part behind them tells them apart.
    by_tail = {neutral(name): name for name in known}
    near = difflib.get_close_matches(neutral(key), by_tail, n=1, cutoff=0.3)
    return by_tail[near[0]] if near else None


def _hint(key: str, known: Iterable[str]) -> str:
    near = _nearest(key, known)
    return "" if near is None else f"; the nearest expected key is {near!r}"


def _encoders(layout: _Layout) -> dict[str, str]:
    """Our edge encoders and theirs."""
    names = {MESH: "mesh", BODY: "world"}
    if layout.coarse_encoders is None:
        return {**names, "coarse0": "coarse"}
    used = len(edge_set_names(layout.steps)) - 1
    return names | {f"coarse{k}": f"coarse{k}" for k in range(max(used, layout.coarse_encoders))}


def _edge_name(name: str) -> str:
    return {MESH: "mesh_edge", BODY: "world_edge"}.get(name, name.replace("coarse", "coarse_edge"))


def _step_key(layout: _Layout, index: int, name: str) -> str:
    if layout.nodes_last:
        return f"processor_steps.{index}.{name}_processor"
    block, step = divmod(index, 3)
    kind = "node_processor_dict" if name == "node" else "edge_processor_dict"
    prefix = f"levels.{block}" if layout.name == "postcvpr" else f"processor_steps{block + 1}"
    return f"{prefix}.{step}.{kind}.{name}"


def _mlp(ours: str, theirs: str, norm: str | None) -> dict[str, Source]:
    sources = {
        f"{ours}.{layer}.{kind}": Source(f"{theirs}.{key}.{kind}")
        for layer, key in _LAYERS.items()
        for kind in ("weight", "bias")
    }
    if norm is not None:
        sources |= {f"{ours}.norm.{kind}": Source(f"{norm}.{kind}") for kind in ("weight", "bias")}
    return sources


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


def load_reference_checkpoint(path: str | Path, size_limit: int = PICKLE_LIMIT) -> NetworkStepper:
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


def read_reference_checkpoint(path: str | Path, size_limit: int = PICKLE_LIMIT) -> tuple[NetworkStepper, str]:
    """The same, and the name of the layout: ``postcvpr``, ``cvpr``, ``fine15`` or ``fine48``."""
    content = load_torch(path, size_limit)
    try:
        return import_reference_weights(_weights(content))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def import_reference_weights(state: Mapping[str, Tensor]) -> tuple[NetworkStepper, str]:
    """NetworkStepper and layout name of a state dict in one of the published layouts.

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


def _sources(layout: _Layout) -> dict[str, Source]:
    sources = {f"network.{name}": source for name, source in network_sources(layout).items()}
    for ours, theirs in _NORMALIZERS.items():
        sources |= {f"{ours}.{sum_}": Source(f"{MODEL}{theirs}.{key}") for sum_, key in _SUMS.items()}
    embeddings = list(_EMBEDDINGS.items())[: 1 if layout.nodes_last else 2]
    return sources | {ours: Source(f"{MODEL}{theirs}.weight") for ours, theirs in embeddings}


def _arguments(layout: _Layout, tensors: Mapping[str, Tensor]) -> dict[str, Any]:
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

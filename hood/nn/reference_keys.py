"""Names and layouts of the published HOOD weights, and where their tensors stand in our networks.

Four layouts exist. All keep a three-layer network as ``0.layers.{0,2,4}`` with its layer norm as ``1`` (the decoder, which
has none, as ``layers.{0,2,4}``); they differ in how processor steps are named, in the number of coarse encoders, and
in the order of the node network's input.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from hood.graph.builder import BODY, MESH
from hood.nn.schedule import SCHEDULES, Step, edge_set_names, parse_schedule

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
class Layout:
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


def detect_layout(keys: Iterable[str]) -> Layout:
    """The layout that the names of a state dict belong to.

    Raises:
        ValueError: none; names the key that comes nearest to one.
    """
    keys = list(keys)
    names = [neutral(key) for key in keys]
    if any(name.startswith("levels.") for name in names):
        count = len({name.split(".")[1] for name in names if re.match(r"edgeset_encoders\.coarse\d+\.", name)})
        return Layout("postcvpr", "ours", count)
    if any(re.match(r"processor_steps\d+\.", name) for name in names):
        return Layout("cvpr", "ours", None)
    steps = {int(name.split(".")[1]) for name in names if re.match(r"processor_steps\.\d+\.", name)}
    if steps:
        name = f"fine{len(steps)}"
        return Layout(name, name if name in SCHEDULES else f"{len(steps)}x(mesh)")
    anchors = [NETWORK + anchor for anchor in ("levels.0.0", "processor_steps1.0", "processor_steps.0", "node_encoder")]
    near = nearest(anchors[0], keys)
    found = f"the nearest key is {near!r}" if near else f"found {len(keys)} keys, such as {keys[:2]}"
    raise ValueError(f"not HOOD weights: no processor steps ({' or '.join(a + '.…' for a in anchors[:3])}); {found}")


def network_sources(layout: Layout) -> dict[str, Source]:
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


def nearest(key: str, known: Iterable[str]) -> str | None:
    """The most similar of ``known``."""
    # Keys share long prefixes: only the part behind them tells them apart.
    by_tail = {neutral(name): name for name in known}
    near = difflib.get_close_matches(neutral(key), by_tail, n=1, cutoff=0.3)
    return by_tail[near[0]] if near else None


def _hint(key: str, known: Iterable[str]) -> str:
    near = nearest(key, known)
    return "" if near is None else f"; the nearest expected key is {near!r}"


def _encoders(layout: Layout) -> dict[str, str]:
    """Our edge encoders and theirs."""
    names = {MESH: "mesh", BODY: "world"}
    if layout.coarse_encoders is None:
        return {**names, "coarse0": "coarse"}
    used = len(edge_set_names(layout.steps)) - 1
    return names | {f"coarse{k}": f"coarse{k}" for k in range(max(used, layout.coarse_encoders))}


def _edge_name(name: str) -> str:
    return {MESH: "mesh_edge", BODY: "world_edge"}.get(name, name.replace("coarse", "coarse_edge"))


def _step_key(layout: Layout, index: int, name: str) -> str:
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

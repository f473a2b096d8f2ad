"""A network's inference by ``network.cpp``: every perceptron and every pass of processor steps in one call each.

The same function as :class:`hood.model.network.model.MeshGraphNet` by torch's operations, the reference and the way of
gradients. At a thousand vertices most of the time of those operations goes into their number; here a pass takes some ten calls.
"""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor, nn

from hood import native
from hood.model.graph.builder import EdgeSet, Graph, finest_level
from hood.native.arguments import COUNT, POINTER, fields
from hood.native.build import NATIVE_FLAGS, build

if TYPE_CHECKING:
    from hood.model.network.message_passing import ProcessorStep
    from hood.model.network.mlp import MLP
    from hood.model.network.model import MeshGraphNet

SOURCE = Path(native.__file__).with_name("network.cpp")


class _Perceptron(ctypes.Structure):
    """``Perceptron`` of ``network.cpp``."""

    _fields_ = [
        *fields("first second third bias_1 bias_2 bias_3 scale shift", POINTER),
        *fields("in_width width out", COUNT),
        ("eps", ctypes.c_double),
    ]


class _Edges(ctypes.Structure):
    """``Edges`` of ``network.cpp``."""

    _fields_ = [*fields("num_edges num_nodes", COUNT), *fields("senders receivers nodes rows offsets", POINTER)]


class _Part(ctypes.Structure):
    """``Part`` of ``network.cpp``."""

    _fields_ = [
        *fields("to_receiver to_sender to_edge to_node", POINTER),
        ("network", _Perceptron),
        *fields("edges latent", COUNT),
    ]


class _Step(ctypes.Structure):
    """``Step`` of ``network.cpp``."""

    _fields_ = [
        ("parts", POINTER),
        ("own", POINTER),
        ("network", _Perceptron),
        *fields("num_parts mean", COUNT),
    ]


class _Memory(ctypes.Structure):
    """``Memory`` of ``network.cpp``."""

    _fields_ = fields("receiver sender received hidden", POINTER)


@cache
def _library() -> ctypes.CDLL:
    """The compiled network.

    Raises:
        hood.native.build.BuildError: there is no compiler, or it fails.
    """
    lib = build(SOURCE, NATIVE_FLAGS)
    for name in ("network_most", "network_padded", "network_lanes"):
        getattr(lib, name).restype = COUNT
    lib.network_padded.argtypes = [COUNT]
    lib.network_pack.argtypes = [POINTER, COUNT, COUNT, COUNT, COUNT, POINTER]
    lib.network_rows.argtypes = [POINTER, POINTER, COUNT, POINTER, COUNT]
    lib.network_lift.argtypes = [POINTER, COUNT, COUNT, POINTER, POINTER, POINTER]
    lib.network_steps.argtypes = [POINTER, COUNT, POINTER, POINTER, POINTER, COUNT, POINTER]
    return lib


def check_width(width: int) -> None:
    """Raise ValueError unless latents of ``width`` columns can be computed here, which takes a compiler."""
    lib = _library()
    if width % lib.network_lanes() or width > lib.network_most():
        raise ValueError(
            f"kernels=fused need latents of a multiple of {lib.network_lanes()} columns, at most {lib.network_most()}, "
            f"not {width}; use kernels=torch"
        )


def weights_for(network: MeshGraphNet, nodes: Tensor) -> Packed | None:
    """The network's weights, packed, if outputs for node features ``nodes`` can be had this way: float32 on a CPU, without a
    gradient. The network is one that :func:`check_width` lets pass; one with parts of an own class has none."""
    if torch.is_grad_enabled() or torch.compiler.is_compiling():
        return None
    if type(nodes) is not Tensor or nodes.device.type != "cpu" or nodes.dtype != torch.float32:
        return None
    known = _PACKED.get(network)
    if known is None or any(table.get(name) is not child for table, name, child in known.children):
        known = None
        if network.own_part():
            return None
    parameters = _parameters(network) if known is None else [table[name] for table, name in known.slots]
    state = [(p.data_ptr(), p._version) for p in parameters if p.dtype == torch.float32 and not p.is_inference()]
    if len(state) < len(parameters):
        return None
    if known is None or known.state != state:
        known = _PACKED[network] = Packed(network, state)
    return known


def _parameters(network: nn.Module) -> list[Tensor]:
    return [table[name] for table, name in _slots(network)]


def _slots(network: nn.Module) -> list[tuple[dict[str, Any], str]]:
    """Where the parameters are found, without walking through the modules again: that takes longer than a frame may."""
    tables = [cast("dict[str, Any]", module._parameters) for module in network.modules()]
    return [(table, name) for table in tables for name, value in table.items() if value is not None]


class Packed:
    """A network's weights as the library reads them; valid as long as they do not change."""

    def __init__(self, network: MeshGraphNet, state: list[tuple[int, int]]) -> None:
        self._lib, self._kept = _library(), list[Any]()
        self.state, self.slots = state, _slots(network)  # what changes with the weights, and where they are
        tables = [module._modules for module in network.modules()]
        self.children = [(table, name, child) for table in tables for name, child in table.items()]
        self.node_encoder = self.perceptron(network.node_encoder)
        names = (*network.edge_set_names, *network.world_sets)
        self.edge_encoders = {name: self.perceptron(network.edge_encoder(name)) for name in names}
        self.decoders = [self.perceptron(cast("MLP", mlp)) for mlp in (network.decoder, *network.late_decoders)]
        self.node_looks = [self.perceptron(cast("MLP", mlp)) for mlp in network.node_looks]
        self.edge_looks = [self._linear_layers(cast(nn.ModuleDict, layers)) for layers in network.edge_looks]
        #: Places of edge latents in a list, and of subsets of edges: of a static set all, of the others those of a level.
        self.latents = {name: place for place, name in enumerate(names)}
        self.subsets: dict[tuple[str, int], int] = {}
        self.steps = (_Step * len(network.steps))()
        for step, sets, module in zip(self.steps, network.schedule, network.steps, strict=True):
            self._fill_step(step, sets, network.world_sets, cast("ProcessorStep", module))

    def perceptron(self, mlp: MLP, first: bool = True) -> _Perceptron:
        """A perceptron's layers; without the first one where that is evaluated in parts."""
        width, inputs, outputs = mlp.second.in_features, mlp.first.in_features, mlp.third.out_features
        norm = mlp.norm
        return _Perceptron(
            first=self.pack(mlp.first.weight) if first else None,
            second=self.pack(mlp.second.weight),
            third=self.pack(mlp.third.weight),
            bias_1=self.vector(mlp.first.bias),
            bias_2=self.vector(mlp.second.bias),
            bias_3=self.vector(mlp.third.bias),
            scale=None if norm is None else self.vector(norm.weight),
            shift=None if norm is None else self.vector(norm.bias),
            in_width=inputs,
            width=width,
            out=outputs,
            eps=0.0 if norm is None else norm.eps,
        )

    def pack(self, weight: Tensor, block: int | None = None) -> int:
        """The address of a weight (out, in) in panels; of its ``block``-th (out, out) block of columns alone if given."""
        weight = weight.detach().contiguous()
        columns, stride = weight.shape
        first, terms = (0, stride) if block is None else (block * columns, columns)
        out = torch.empty(self._lib.network_padded(columns) * terms)
        self._lib.network_pack(weight.data_ptr(), columns, stride, first, terms, out.data_ptr())
        self._kept.append(out)
        return out.data_ptr()

    def vector(self, values: Tensor) -> int:
        """The address of values (N,) with zeros behind, up to whole vectors."""
        out = torch.zeros(self._lib.network_padded(len(values)))
        out[: len(values)] = values.detach()
        self._kept.append(out)
        return out.data_ptr()

    def _linear_layers(self, layers: nn.ModuleDict) -> dict[str, tuple[int, int]]:
        """Addresses of weight and bias of layers of one input."""
        named = {name: cast(nn.Linear, layer) for name, layer in layers.items()}
        return {name: (self.vector(layer.weight[:, 0]), self.vector(layer.bias)) for name, layer in named.items()}

    def _fill_step(self, step: _Step, sets: Sequence[str], world: Sequence[str], module: ProcessorStep) -> None:
        parts = (_Part * len(module.sets))()
        for index, (part, name) in enumerate(zip(parts, module.sets, strict=True)):
            mlp = cast("MLP", module.edge_mlps[name])
            subset = (name, finest_level(tuple(sets)) if name in world else 0)
            part.edges = self.subsets.setdefault(subset, len(self.subsets))
            part.latent = self.latents[name]
            part.to_receiver, part.to_sender, part.to_edge = (self.pack(mlp.first.weight, block) for block in range(3))
            part.to_node = self.pack(module.node_mlp.first.weight, 1 + index)
            part.network = self.perceptron(mlp, first=False)
        self._kept.append(parts)
        step.parts, step.num_parts = ctypes.addressof(parts), len(parts)
        step.own = self.pack(module.node_mlp.first.weight, 0)
        step.network = self.perceptron(module.node_mlp, first=False)
        step.mean = module.aggregation == "mean"


_PACKED: weakref.WeakKeyDictionary[nn.Module, Packed] = weakref.WeakKeyDictionary()


class Inference:
    """One evaluation of a network on a graph, pass by pass."""

    def __init__(
        self, network: MeshGraphNet, weights: Packed, graph: Graph, nodes: Tensor, edges: Mapping[str, Tensor]
    ) -> None:
        self._lib, self._weights, self._width = _library(), weights, network.latent_dim
        self._num_cloth, self._passes, self._taken = graph.num_cloth, network.passes, 0
        self.nodes = self._rows(self._weights.node_encoder, nodes)
        encoders = self._weights.edge_encoders
        self.edges = {name: self._rows(encoders[name], edges[name]) for name in self._weights.latents}
        self._latents = (ctypes.c_void_p * len(self.edges))(*(self.edges[name].data_ptr() for name in self._weights.latents))
        chosen = [graph.subset(name, level) for name, level in self._weights.subsets]
        sets, rows = [part.edges for part in chosen], [part.rows for part in chosen]
        self._subsets = (_Edges * len(sets))(*(_pointers(*pair) for pair in zip(sets, rows, strict=True)))
        self._kept: list[Any] = [*sets, *rows]
        # A set of a fixed graph names its spare node once for every place that is not taken: it can have more rows than nodes.
        memory = torch.empty(4, max(len(self.nodes), *(len(part.nodes) for part in sets)), self._width)
        self._memory = _Memory(*(part.data_ptr() for part in memory))
        self._kept.append(memory)

    def see(self, node_look: Tensor, edge_look: Mapping[str, Tensor]) -> None:
        """Add what is seen before the next pass, see :class:`hood.model.network.model.MeshGraphNet`, to the latents."""
        index = self._taken - 1
        self._rows(self._weights.node_looks[index], node_look, onto=self.nodes)
        for name, (weight, bias) in self._weights.edge_looks[index].items():
            seen = edge_look[name].contiguous()
            self._lib.network_lift(seen.data_ptr(), len(seen), self._width, weight, bias, self.edges[name].data_ptr())

    def take(self) -> Tensor:
        """Raw output (V, out_width) at the end of the next pass."""
        index, weights = self._taken, self._weights
        self._taken += 1
        first = ctypes.addressof(weights.steps) + sum(self._passes[:index]) * ctypes.sizeof(_Step)
        self._lib.network_steps(
            first,
            self._passes[index],
            ctypes.addressof(self._subsets),
            ctypes.addressof(self._latents),
            self.nodes.data_ptr(),
            len(self.nodes),
            ctypes.addressof(self._memory),
        )
        return self._rows(weights.decoders[index], self.nodes[: self._num_cloth])

    def _rows(self, perceptron: _Perceptron, x: Tensor, onto: Tensor | None = None) -> Tensor:
        x = x.contiguous()
        out = x.new_empty(len(x), perceptron.out) if onto is None else onto
        self._lib.network_rows(ctypes.addressof(perceptron), x.data_ptr(), len(x), out.data_ptr(), int(onto is not None))
        return out


def _pointers(edges: EdgeSet, rows: Tensor | None) -> _Edges:
    tables = (edges.local_senders, edges.local_receivers, edges.nodes, rows, edges.offsets)
    for table in tables:
        assert table is None or table.is_contiguous(), "a table of edges has gaps"
    return _Edges(edges.num_edges, len(edges.nodes), *(None if table is None else table.data_ptr() for table in tables))


def infer(
    network: MeshGraphNet,
    weights: Packed,
    graph: Graph,
    nodes: Tensor,
    edges: Mapping[str, Tensor],
    look: Callable[[int, Tensor], tuple[Tensor, Mapping[str, Tensor]]] | None,
) -> tuple[Tensor, Tensor, Mapping[str, Tensor]]:
    """What :meth:`hood.model.network.model.MeshGraphNet.forward` returns, by the weights of :func:`weights_for`, and the
    latents of nodes and edges at the end."""
    inference = Inference(network, weights, graph, nodes, edges)
    raw = inference.take()
    for index in range(1, len(network.passes)):
        assert look is not None, "several passes need someone who looks at what they lead to"
        inference.see(*look(index - 1, raw))
        raw = inference.take()
    return raw, inference.nodes, inference.edges

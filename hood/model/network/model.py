"""The multi-level graph network: encoders, processor, decoder (paper, section 4.2).

Which parts of a network are somebody's own: kernels that take it as a whole know the functions of hood's classes alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from itertools import islice
from typing import cast

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from hood.model.graph.builder import (
    BODY,
    LAYERS,
    MESH,
    Graph,
    coarse_name,
    edge_set_names,
    finest_level,
    parse_passes,
    parse_schedule,
    set_level,
)
from hood.model.kernels import network
from hood.model.kernels.block import check_kernels
from hood.model.network.message_passing import EdgeDecoder, ProcessorStep
from hood.model.network.mlp import MLP
from hood.tensors.dense import PRECISIONS as PRECISIONS
from hood.tensors.dense import as_in_training, check_precision, pad_rows, products

#: By class what its parts are, alone or in lists and tables.
_CLASSES: Mapping[type[nn.Module], Mapping[str, type[nn.Module]]] = {
    ProcessorStep: {"edge_mlps": MLP, "node_mlp": MLP},
    EdgeDecoder: {"mlp": MLP},
    MLP: {"first": nn.Linear, "second": nn.Linear, "third": nn.Linear, "norm": nn.LayerNorm},
}


def own_part(module: nn.Module, kind: type[nn.Module], parts: Mapping[str, type[nn.Module]] | None = None) -> str:
    """The first part of ``module`` that may compute something else than hood's own would, in words; empty without any.

    Args:
        kind: the class that the module should have, itself and not by inheritance.
        parts: what a module of that class consists of, where it is not known here.
    """
    if _differs(module, kind):
        return _named(module)
    known = _CLASSES.get(kind, {}) if parts is None else parts
    for name, child in module.named_children():
        if name not in known:
            return f"{name}, {_named(child)}"
        found = _listed(child, known[name])
        if found:
            return f"{name}, {found}" if parts is not None else found
    return ""


def _listed(child: nn.Module, kind: type[nn.Module]) -> str:
    """The same of a part, and of all in a list or a table of parts."""
    if type(child) not in (nn.ModuleList, nn.ModuleDict):
        return own_part(child, kind)
    return next((found for part in child.children() if (found := _listed(part, kind))), "")


def _differs(module: nn.Module, kind: type[nn.Module]) -> bool:
    """Whether a module is of another class, has a hook, or a method put in the place of its class' one."""
    replaced = (name for name, value in vars(module).items() if callable(value) and callable(getattr(type(module), name, None)))
    return type(module) is not kind or bool(module._forward_hooks or module._forward_pre_hooks) or any(True for _ in replaced)


def _named(module: nn.Module) -> str:
    return f"{type(module).__module__}.{type(module).__qualname__}"


#: Between two passes: the index of the one that ended and its raw output (V, out_width) in, what its prediction looks like
#: out: columns of the cloth nodes, and of the edge sets that the next pass works on.
Look = Callable[[int, Tensor], tuple[Tensor, Mapping[str, Tensor]]]
#: What a network consists of.
_PARTS: Mapping[str, type[nn.Module]] = {
    **dict.fromkeys(("node_encoder", "edge_encoders", "decoder", "late_decoders", "node_looks"), MLP),
    "steps": ProcessorStep,
    "edge_looks": nn.Linear,
    "edge_decoder": EdgeDecoder,
}


def _again() -> tuple[AbstractContextManager[None], AbstractContextManager[None]]:
    """What latents are computed in, and computed in again where the way back is followed: by the same parts of arrays."""
    return nullcontext(), as_in_training()


class MeshGraphNet(nn.Module):
    """Raw decoder output per cloth node from node and edge features.

    One encoder for all nodes and one per edge set; processor steps as the schedule says, each with its own networks;
    body edges take part in every step, restricted to cloth nodes on the step's levels, and so do edges between layers of cloth
    where the model has them. Cloth and body nodes share the node networks; body nodes receive nothing from cloth edges. A step
    without edges between layers is, to the bit, that of a model which has none and otherwise the same weights.

    A schedule of several passes decodes an output at the end of each; what it leads to is looked at, and what is seen is
    added to the latents before the next pass.

    Args:
        node_width: width of the node features.
        edge_widths: width of the edge features: ``{"mesh": 12, "coarse": 12, "body": 9}``. A coarse set is looked up by
            its own name first and by ``coarse`` then; a missing ``coarse`` means the mesh's width. With ``layers`` the model
            has edges between layers of cloth.
        latent_dim: width of all latents (paper: 128).
        schedule: name or text for :func:`hood.model.graph.builder.parse_schedule`.
        out_width: width of the output.
        aggregation: ``sum`` or ``mean`` of the messages at a node.
        output_init: factor on the decoder's last layer at initialisation; small values start near zero output.
        coarse_encoders: number of encoders for coarse edges, ``coarse0`` first. Sets beyond them share the last one,
            encoders beyond the sets are never evaluated; None gives every set its own.
        look_widths: columns of nodes and of edges that are seen between passes; schedules of one pass need none.
        edge_out_width: width of the output of mesh edges, see :meth:`with_edges`; 0: none.

    ``precision`` says how the network computes and is no part of what it is: weights, input and output keep their own
    precision. Set it by :meth:`use_precision`.
    """

    precision: str  # of the computation, see :meth:`use_precision`
    kernels: str  # what computes it, see :meth:`use_kernels`
    checkpointing: bool  # whether latents are computed again backwards, which takes less memory

    def __init__(
        self,
        node_width: int,
        edge_widths: Mapping[str, int],
        latent_dim: int = 128,
        schedule: str = "ours",
        out_width: int = 3,
        aggregation: str = "sum",
        output_init: float = 1.0,
        coarse_encoders: int | None = None,
        look_widths: tuple[int, int] = (0, 0),
        edge_out_width: int = 0,
    ) -> None:
        super().__init__()
        self.schedule = parse_schedule(schedule)
        self.passes = parse_passes(schedule)
        self.edge_set_names = edge_set_names(self.schedule)
        encoded = self.edge_set_names if coarse_encoders is None else (MESH, *map(coarse_name, range(coarse_encoders)))
        #: Sets of edges that change every step, in the order of the node networks' input.
        self.world_sets = (BODY, LAYERS) if LAYERS in edge_widths else (BODY,)
        widths = {name: _edge_width(name, edge_widths) for name in (*encoded, *self.world_sets)}
        self.node_encoder = MLP(node_width, latent_dim, latent_dim)
        self.edge_encoders = nn.ModuleDict({n: MLP(w, latent_dim, latent_dim) for n, w in widths.items()})
        self.steps = nn.ModuleList(ProcessorStep((*sets, *self.world_sets), latent_dim, aggregation) for sets in self.schedule)
        self.decoder = MLP(latent_dim, latent_dim, out_width, norm=False)
        later = range(1, len(self.passes))
        self.late_decoders = nn.ModuleList(MLP(latent_dim, latent_dim, out_width, norm=False) for _ in later)
        self.node_looks = nn.ModuleList(MLP(look_widths[0], latent_dim, latent_dim) for _ in later)
        self.edge_looks = nn.ModuleList(
            nn.ModuleDict({name: nn.Linear(look_widths[1], latent_dim) for name in self.pass_sets(index)}) for index in later
        )
        if edge_out_width and MESH not in self.edge_set_names:
            raise ValueError("schedule has no step on the mesh, whose edges are to be predicted; add one, such as 1x(mesh)")
        # Last and only where it is asked for: models without it start from the weights they always had.
        self.edge_decoder = EdgeDecoder(latent_dim, edge_out_width) if edge_out_width else None
        with torch.no_grad():
            decoders = [self.decoder, *self.late_decoders, *([self.edge_decoder.mlp] if self.edge_decoder else [])]
            for decoder in cast("list[MLP]", decoders):
                decoder.third.weight.mul_(output_init)
                decoder.third.bias.mul_(output_init)
        self.latent_dim = latent_dim
        self.use_precision("fp32")
        self.use_kernels("torch")
        self.use_checkpointing(False)

    def use_precision(self, name: str) -> None:
        """``fp32`` computes in the precision of the weights, ``bf16`` the latents and products of the processor in bfloat16.

        With bf16 sums, statistics of layer norms, the first layers of the encoders (which see the features) and the decoder
        stay as they are; in training so do weights and their gradients. ``tf32`` is fp32 with products of factors rounded to
        10 bits behind the point: inference on a GPU.
        """
        check_precision(name)
        self.precision = name

    def use_kernels(self, name: str) -> None:
        """``torch`` computes by torch's operations, ``compiled`` by kernels that are compiled here, once per user: the same
        function, faster, on a CPU with AVX2 or AVX-512 and a C++ compiler. ``fused`` takes every pass of an inference in one
        call, on any CPU with a compiler; gradients go by torch's operations. Parts of an own class are computed by torch's
        operations and their own, with ``compiled`` beside the others; ``fused`` knows no such network.

        Raises:
            ValueError: no such choice, or it does not work here, or not for this network.
        """
        check_kernels(name, self.precision, self.latent_dim)
        part = self.own_part() if name == "fused" else ""
        if part:
            raise ValueError(f"kernels=fused compute hood's own network alone, not one with {part}; use kernels=torch")
        self.kernels = name
        for module in self.modules():
            if isinstance(module, MLP):
                module.compiled = name == "compiled" and type(module) is MLP

    def own_part(self) -> str:
        """The part, or the network, that is not of hood's own class, in words; empty where there is none."""
        return own_part(self, MeshGraphNet, _PARTS)

    def use_checkpointing(self, on: bool) -> None:
        """Whether training keeps only the latents between processor steps and computes a step again for its gradient.

        The results are the same to the last bit; one more forward pass buys the memory.
        """
        self.checkpointing = on

    def pass_sets(self, index: int) -> tuple[str, ...]:
        """Static edge sets that pass ``index`` works on."""
        first = sum(self.passes[:index])
        return edge_set_names(self.schedule[first : first + self.passes[index]])

    def forward(
        self, graph: Graph, node_features: Tensor, edge_features: Mapping[str, Tensor], look: Look | None = None
    ) -> Tensor:
        """(V, out_width) for the cloth nodes, of the last pass.

        Args:
            graph: needs every set of :attr:`edge_set_names` and :attr:`world_sets`.
            node_features: (V + W_active, node_width), cloth rows first.
            edge_features: by set, rows as in ``graph.edge_sets``.
            look: called between two passes; schedules of one pass need none.
        """
        return self._evaluate(graph, node_features, edge_features, look)[0]

    def with_edges(self, graph: Graph, node_features: Tensor, edge_features: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """The same and the output of the mesh's edges, (N, edge_out_width), rows as in ``graph.edge_sets``."""
        assert self.edge_decoder is not None, "the network was built without an output of edges"
        raw, nodes, edges = self._evaluate(graph, node_features, edge_features, None)
        dtype = node_features.dtype
        return raw, self.edge_decoder(nodes[: graph.num_cloth].to(dtype), edges[MESH].to(dtype), graph.edge_sets[MESH])

    def _evaluate(
        self, graph: Graph, node_features: Tensor, edge_features: Mapping[str, Tensor], look: Look | None
    ) -> tuple[Tensor, Tensor, Mapping[str, Tensor]]:
        """Output of the last pass, and the latents of nodes and edges that it is decoded from."""
        check_precision(self.precision, node_features.device)
        check_kernels(self.kernels, self.precision, self.latent_dim, node_features.device)
        weights = network.weights_for(self, node_features) if self.kernels == "fused" else None
        if weights is not None:
            return network.infer(self, weights, graph, node_features, edge_features, look)
        with products(self.precision):
            return self._forward(graph, node_features, edge_features, look)

    def _forward(
        self, graph: Graph, node_features: Tensor, edge_features: Mapping[str, Tensor], look: Look | None
    ) -> tuple[Tensor, Tensor, Mapping[str, Tensor]]:
        dtype = torch.bfloat16 if self.precision == "bf16" else None
        # Rows of padding are nodes without edges. A node's latent, a sum over all steps, stays in float32.
        nodes = self.node_encoder(pad_rows(node_features), dtype).to(node_features.dtype)
        names = (*self.edge_set_names, *self.world_sets)
        edges = {name: self.edge_encoder(name)(edge_features[name], dtype) for name in names}
        steps = iter(zip(self.schedule, self.steps, strict=True))
        self._sums: dict[tuple[str, ...], Tensor] = {}  # what steps write to; of this evaluation
        raw = nodes.new_empty(0)
        for index, length in enumerate(self.passes):
            if index > 0:
                assert look is not None, "several passes need someone who looks at what they lead to"
                nodes, edges = self._see(index, nodes, edges, *look(index - 1, raw))
            for sets, step in islice(steps, length):
                nodes, edges = self._take(cast(ProcessorStep, step), sets, graph, nodes, edges)
            decoder = self.decoder if index == 0 else self.late_decoders[index - 1]
            raw = decoder(nodes[: graph.num_cloth].to(node_features.dtype))
        self._sums = {}
        return raw, nodes, edges

    @as_in_training()
    def _take(
        self, step: ProcessorStep, sets: tuple[str, ...], graph: Graph, nodes: Tensor, edges: Mapping[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Latents after one processor step on the edge sets ``sets``."""
        inferring = not torch.is_grad_enabled()
        overwrite = inferring and type(self) is MeshGraphNet and type(step) is ProcessorStep  # others may read them again
        subsets = {name: graph.subset(name, finest_level(sets)) for name in (*sets, *self.world_sets)}
        if self.checkpointing and not inferring:
            taken: tuple[Tensor, dict[str, Tensor]] = checkpoint(
                step, nodes, edges, subsets, use_reentrant=False, preserve_rng_state=False, context_fn=_again
            )
            return taken
        taken = step(nodes, edges, subsets, overwrite, self._sums) if overwrite else step(nodes, edges, subsets)
        return taken

    def _see(
        self, index: int, nodes: Tensor, edges: Mapping[str, Tensor], node_look: Tensor, edge_look: Mapping[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Latents with what is seen before pass ``index`` added to them."""
        dtype = torch.bfloat16 if self.precision == "bf16" else None
        seen = self.node_looks[index - 1](pad_rows(node_look), dtype)[: len(node_look)].to(nodes.dtype)
        nodes = torch.cat([nodes[: len(seen)] + seen, nodes[len(seen) :]])
        encoders = cast(nn.ModuleDict, self.edge_looks[index - 1])
        added = {name: edges[name] + encoders[name](edge_look[name]).to(edges[name].dtype) for name in encoders}
        return nodes, {**edges, **added}

    def edge_encoder(self, name: str) -> MLP:
        """The encoder of edge set ``name``."""
        if name not in self.edge_encoders:
            name = max((n for n in self.edge_encoders if n.startswith("coarse")), key=set_level)
        return cast(MLP, self.edge_encoders[name])

    def num_parameters(self) -> int:
        """Trainable parameters; embeddings live in the feature set and count there."""
        return sum(p.numel() for p in self.parameters() if p.requires_grad)


def _edge_width(name: str, widths: Mapping[str, int]) -> int:
    for key in (name, "coarse" if name.startswith("coarse") else name, "mesh"):
        if key in widths and (key != "mesh" or name not in (BODY, LAYERS)):
            return widths[key]
    raise ValueError(f"edge_widths has no entry for {name!r} (given: {', '.join(widths)})")

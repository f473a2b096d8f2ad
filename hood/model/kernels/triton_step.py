"""A processor step on a GPU in two kernels for every edge set, one for the nodes and one product, in Triton. The networks
beside the steps take one product and one kernel.

Composed from single operations a step reads and writes every intermediate (N, d) array and takes about forty kernel
launches. Here a program takes a tile of consecutive edges, or of nodes, through all its layers and the layer norm on the
chip. The same function as :meth:`hood.model.network.message_passing.ProcessorStep.forward`, which stays the reference.

Sums are deterministic, without atomic additions. Edges are sorted by receiver, so a node's edges are consecutive rows: a
node whose edges lie in one tile is summed there, every tile keeps what it knows of the nodes it shares with its neighbours,
and a second small pass adds that up in order. Nothing waits for the host, and the launches depend on shapes alone. The
kernels stand behind operators of torch (``hood::step_edges``, ``hood::step_nodes``, ``hood::mlp_tail``), so that a traced or
a compiled frame holds them like any other, and a CUDA graph records them.

Backward a set takes two kernels, of its edges and of the sums at their ends, and a product that gives the gradients of three
weights. What the forward pass knew inside a step is computed again there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hood.model.graph.builder import EdgeSet, Subset
from hood.tensors.dense import has_triton, linear

if TYPE_CHECKING:
    from hood.model.network.message_passing import ProcessorStep
    from hood.model.network.mlp import MLP

#: Widest latents by precision. The weights of float32 beyond it leave a program no registers: at 128 each of its threads would
#: keep 16 to 28 KB in memory (tests/model/kernels/test_triton_compiled.py has the limit).
WIDEST = {torch.float32: 64, torch.bfloat16: 128}
#: Most programs of a backward pass: each keeps sums over its tiles, which are added afterwards.
PROGRAMS = 256
#: How float32 is multiplied: as it is; on tensor cores as three products of parts of 10 bits, which is as good; or rounded to
#: 10 bits.
INPUT_PRECISIONS = ("ieee", "tf32x3", "tf32")


def applies(width: int, dtype: torch.dtype, device: torch.device) -> bool:
    """Whether networks with latents (N, ``width``) of ``dtype`` go this way: on a CUDA device, float32 or bfloat16, a multiple
    of 16 up to :data:`WIDEST`, where :func:`hood.tensors.dense.has_triton` says so."""
    return width % 16 == 0 and width <= WIDEST.get(dtype, 0) and has_triton(device)


def input_precision() -> str:
    """As exact as torch was told to be in its own products of float32."""
    return "tf32" if torch.backends.cuda.matmul.fp32_precision == "tf32" else "tf32x3"


def take(
    step: ProcessorStep,
    nodes: Tensor,
    edges: Mapping[str, Tensor],
    subsets: Mapping[str, Subset],
    overwrite: bool = False,
    precision: str = "tf32x3",
    memory: dict[tuple[str, ...], Tensor] | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """New latents of the nodes (R, d) float32, and of the edges by set.

    Weights are rounded to the precision of the edges' latents; sums within a product, layer norm and residual are float32.

    Args:
        nodes: (R, d).
        edges: latents (N, d) by set, float32 or bfloat16.
        subsets: which rows of a set take part.
        overwrite: write new latents over the old ones.
        precision: of products of float32, one of :data:`INPUT_PRECISIONS`.
        memory: of the sums, by the sets of a step; steps with the same ``subsets`` and latents share it. Nodes that receive
            nothing have zeros there, which are written once.

    Raises:
        ValueError: another precision.
    """
    if precision not in INPUT_PRECISIONS:
        raise ValueError(f"precision is {precision!r}; choose {' or '.join(INPUT_PRECISIONS)}")
    names = [name for name in step.sets if subsets[name].edges.num_edges]
    if torch.is_grad_enabled():
        return _take_with_gradients(step, names, nodes, edges, subsets, precision)
    updated, width = dict(edges), step.latent_dim
    low = nodes.to(next(iter(edges.values())).dtype)
    received = None if memory is None else memory.get(step.sets)
    if received is None:
        received = low.new_zeros(len(step.sets), *nodes.shape)
    if memory is not None:
        memory[step.sets] = received
    if names:
        mlps = [cast("MLP", step.edge_mlps[name]) for name in names]
        tables = _first_at_ends([(mlp.first.weight, mlp.first.bias) for mlp in mlps], low, width)
        for place, name in enumerate(names):
            mlp, part = cast("MLP", step.edge_mlps[name]), subsets[name]
            updated[name] = edges[name] if overwrite else edges[name].clone()
            which = updated[name], tables, received[step.sets.index(name)], 2 * width * place
            assert mlp.norm is not None
            parameters = [mlp.first.weight[:, 2 * width :], *mlp.tail_parameters()]
            step_edges(*which, *_rows(part.edges), part.rows, parameters, mlp.norm.eps, precision)
    mlp = cast("MLP", step.node_mlp)
    assert mlp.norm is not None
    parameters = [mlp.first.weight, mlp.first.bias, *mlp.tail_parameters()]
    return step_nodes(nodes.contiguous(), received, parameters, mlp.norm.eps, precision), updated


def _first_at_ends(groups: Sequence[Sequence[Tensor]], nodes: Tensor, width: int) -> Tensor:
    """(R, 2 d S): for every set the parts of the edge network's first layer at the nodes, as receiver (bias included) and as
    sender; one product. ``groups``: weight and bias of that layer, and others."""
    weights = [half for weight, *_ in groups for half in weight.split(width, dim=1)[:2]]
    biases = [half for _, bias, *_ in groups for half in (bias, torch.zeros_like(bias))]
    return linear(nodes, torch.cat(weights), torch.cat(biases)) if groups else nodes.new_zeros(len(nodes), 0)


def _rows(edges: EdgeSet) -> tuple[Tensor, ...]:
    return edges.receivers, edges.senders, edges.local_receivers, edges.offsets


@torch.library.custom_op("hood::step_edges", mutates_args=("latent", "received"))
def step_edges(
    latent: Tensor,
    tables: Tensor,
    received: Tensor,
    column: int,
    receivers: Tensor,
    senders: Tensor,
    local_receivers: Tensor,
    offsets: Tensor,
    rows: Tensor | None,
    parameters: Sequence[Tensor],
    eps: float,
    precision: str,
) -> None:
    """e + m over the edge latents, and Σ m to the receivers, m = MLP([v_receiver, v_sender, e]).

    Args:
        latent: (L, d) of all edges of the set.
        tables: (R, …) first layer at the nodes, from ``column`` on: d as receiver, d as sender.
        received: (R, d), written at nodes that receive something.
        receivers, senders: (N,) graph nodes; ``local_receivers`` (N,) ascending, and ``offsets`` of their rows.
        rows: (N,) rows of ``latent`` that take part; None: all of them.
        parameters: the first layer's part for an edge (a view of d columns), then ``tail_parameters``.
    """
    count, width = receivers.shape[0], latent.shape[1]
    tile, options = tile_of(width, latent.dtype), options_of(width, latent, precision)
    tiles = -(-count // tile)
    borders = torch.empty(2, tiles, width, dtype=torch.float32, device=latent.device)
    first, *tail = parameters
    shape: dict[str, Any] = {"WIDTH": width, "PADDED": _power_of_two(width), "TILE": tile}
    where = (tables, tables.stride(0), column, receivers, senders, local_receivers, rows if rows is not None else receivers)
    edges_pass, border_pass = _kernels().edges_pass, _kernels().border_pass
    arguments = (latent, *where, first, first.stride(0), *tail, received, borders, count, tiles, eps)
    edges_pass[(tiles,)](*arguments, **options, **shape, SOME=rows is not None)
    if tiles > 1:
        border_pass[(tiles - 1,)](receivers, local_receivers, offsets, borders, received, tiles, **shape, CHUNK=32)


@torch.library.custom_op("hood::step_nodes", mutates_args=())
def step_nodes(nodes: Tensor, received: Tensor, parameters: Sequence[Tensor], eps: float, precision: str) -> Tensor:
    """v + MLP([v, Σ_s1, Σ_s2, …]) of all nodes (R, d); ``received`` (S, R, d) has the sums in the order of the columns."""
    (count, width), updated = nodes.shape, torch.empty_like(nodes)
    tile, options = tile_of(width, received.dtype), options_of(width, received, precision)
    shape: dict[str, Any] = {"WIDTH": width, "PADDED": _power_of_two(width), "TILE": tile, "SETS": received.shape[0]}
    first, *others = parameters
    _kernels().nodes_pass[(-(-count // tile),)](
        nodes, received, first, first.stride(0), *others, updated, count, eps, **options, **shape
    )
    return updated


@step_nodes.register_fake
def _(nodes: Tensor, received: Tensor, parameters: Sequence[Tensor], eps: float, precision: str) -> Tensor:
    return torch.empty_like(nodes)


@torch.library.custom_op("hood::mlp_tail", mutates_args=())
def mlp_tail(hidden: Tensor, residual: Tensor | None, parameters: Sequence[Tensor], eps: float, precision: str) -> Tensor:
    """A network behind its first layer, ``hidden`` (N, d) before the ReLU, with ``tail_parameters``; plus ``residual`` (N, d),
    in whose precision it then comes."""
    count, width = hidden.shape
    tile, options = tile_of(width, hidden.dtype), options_of(width, hidden, precision)
    out = torch.empty_like(hidden if residual is None else residual)
    if count == 0:
        return out
    shape: dict[str, Any] = {"WIDTH": width, "PADDED": _power_of_two(width), "TILE": tile, "ADD": residual is not None}
    hidden, added = hidden.contiguous(), hidden if residual is None else residual.contiguous()
    _kernels().tail_pass[(-(-count // tile),)](hidden, added, *parameters, out, count, eps, **options, **shape)
    return out


@mlp_tail.register_fake
def _(hidden: Tensor, residual: Tensor | None, parameters: Sequence[Tensor], eps: float, precision: str) -> Tensor:
    return torch.empty_like(hidden if residual is None else residual)


def tile_of(width: int, dtype: torch.dtype) -> int:
    """Rows of a tile: of the products, and of the sums within a tile. With twice as many the registers do not suffice."""
    return 16 if dtype == torch.float32 or width > 64 else 32


def options_of(width: int, like: Tensor, precision: str) -> dict[str, Any]:
    """How the kernels are compiled for latents such as ``like``."""
    warps = 8 if width <= 64 else 16
    return {"PRECISION": precision, "WIDEN": like.device.type == "cpu", "num_warps": warps, "num_stages": 1}


def _power_of_two(width: int) -> int:
    return max(16, 1 << (width - 1).bit_length())


@cache
def _kernels() -> Any:
    """The module of the kernels; imports Triton."""
    from hood.model.kernels import triton_kernels

    return triton_kernels


@cache
def _gradient_kernels() -> Any:
    from hood.model.kernels import triton_gradients

    return triton_gradients


class _Set(NamedTuple):
    """An edge set of a step that has edges."""

    place: int  # among the step's sets
    part: Subset
    eps: float


class _Setting(NamedTuple):
    """Of a step, what no gradient is of."""

    sets: tuple[_Set, ...]
    num_sets: int
    eps: float
    precision: str


#: Parameters of a network: weight and bias of its three layers, scale and shift.
_PARAMETERS = 8


def _take_with_gradients(
    step: ProcessorStep,
    names: Sequence[str],
    nodes: Tensor,
    edges: Mapping[str, Tensor],
    subsets: Mapping[str, Subset],
    precision: str,
) -> tuple[Tensor, dict[str, Tensor]]:
    mlps = [*(cast("MLP", step.edge_mlps[name]) for name in names), step.node_mlp]
    norms = [cast("torch.nn.LayerNorm", mlp.norm).eps for mlp in mlps]
    sets = tuple(_Set(step.sets.index(name), subsets[name], eps) for name, eps in zip(names, norms[:-1], strict=True))
    setting = _Setting(sets, len(step.sets), norms[-1], precision)
    parameters = [one for mlp in mlps for one in (mlp.first.weight, mlp.first.bias, *mlp.tail_parameters())]
    dtype = next(iter(edges.values())).dtype
    updated, *latents = _Step.apply(nodes.contiguous(), dtype, setting, *(edges[name] for name in names), *parameters)
    return updated, {**edges, **dict(zip(names, latents, strict=True))}


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, nodes: Tensor, dtype: torch.dtype, setting: _Setting, *given: Tensor) -> tuple[Tensor, ...]:
        count, width = len(setting.sets), nodes.shape[1]
        latents, groups = [one.contiguous() for one in given[:count]], _groups(given[count:])
        low = nodes.to(dtype)
        received = low.new_zeros(setting.num_sets, *nodes.shape)
        tables = _first_at_ends(groups[:-1], low, width)
        updated = [latent.clone() for latent in latents]
        for index, (one, (first, _, *tail)) in enumerate(zip(setting.sets, groups[:-1], strict=True)):
            where = updated[index], tables, received[one.place], 2 * width * index, *_rows(one.part.edges), one.part.rows
            step_edges(*where, [first[:, 2 * width :], *tail], one.eps, setting.precision)
        result = step_nodes(nodes, received, list(groups[-1]), setting.eps, setting.precision)
        ctx.save_for_backward(low, received, tables, *latents, *given[count:])
        ctx.setting = setting
        return result, *updated

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_nodes: Tensor, *grad_latents: Tensor) -> tuple[Tensor | None, ...]:
        setting: _Setting = ctx.setting
        (low, received, tables, *rest), count = ctx.saved_tensors, len(setting.sets)
        latents, groups, width = rest[:count], _groups(rest[count:]), low.shape[1]
        first, bias, *tail = groups[-1]
        seen = torch.cat([low.unsqueeze(1), received.transpose(0, 1)], dim=1).flatten(1)
        hidden = torch.nn.functional.linear(seen, first.to(low.dtype), bias.to(low.dtype))
        grad_hidden, of_bias, others = _tail_gradients(hidden, grad_nodes.contiguous(), tail, setting.eps, setting.precision)
        grad_seen = grad_hidden @ first.to(low.dtype)
        of_nodes = [(grad_hidden.t() @ seen).to(first.dtype), of_bias, *others]
        grad_low, back, of_edges = grad_seen[:, :width], list[Tensor](), list[Tensor]()
        if count:
            back, of_edges, at_nodes = _edge_gradients(setting, low, tables, latents, groups[:-1], grad_latents, grad_seen)
            grad_low = grad_low + at_nodes
        return (grad_nodes + grad_low, None, None, *back, *of_edges, *of_nodes)


def _edge_gradients(
    setting: _Setting,
    low: Tensor,
    tables: Tensor,
    latents: Sequence[Tensor],
    groups: Sequence[Sequence[Tensor]],
    grad_latents: Sequence[Tensor],
    grad_seen: Tensor,
) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """Of all sets the gradients of the latents, of the edge networks' parameters, and of the nodes (R, d).

    Args:
        low: (R, d) nodes, ``tables`` (R, 2 d S) the first layer there.
        grad_seen: (R, d (1 + sets)), behind its first d columns the gradients of the sums that nodes received.
    """
    count, width, like = len(setting.sets), low.shape[1], groups[0][0].dtype
    most = max(one.part.edges.num_edges for one in setting.sets)
    programs, grad_tables = min(PROGRAMS, -(-most // tile_of(width, low.dtype))), torch.zeros_like(tables)
    parts = torch.zeros(count, programs, 5 * width, dtype=torch.float32, device=low.device)
    back, squares = list[Tensor](), list[Tensor]()
    for index, (one, latent, group) in enumerate(zip(setting.sets, latents, groups, strict=True)):
        edges, rows, (first, _, *tail) = one.part.edges, one.part.rows, group
        grad = grad_latents[index].contiguous()
        found = torch.empty_like(latent) if rows is None else grad.clone()
        factors = latent.new_empty(6, edges.num_edges, width)
        where = [edges.receivers, edges.senders, edges.nodes, edges.offsets, edges.reverse]
        given = latent, tables, 2 * width * index, where, rows, [first[:, 2 * width :], *tail[:5]]
        at_node = grad_seen[:, (1 + one.place) * width :]
        edge_gradients(*given, grad, at_node, found, factors, grad_tables, parts[index], one.eps, setting.precision)
        before, behind = factors.split(3)
        back.append(found)
        squares.append((behind.transpose(1, 2) @ before).to(like))
    weights = torch.cat([half for weight, *_ in groups for half in weight.split(width, dim=1)[:2]]).to(low.dtype)
    at_ends = (grad_tables.t() @ low).view(count, 2, width, width).to(like)
    biases = grad_tables.sum(dim=0, dtype=like).view(count, 2, width)[:, 0]
    vectors, of_edges = parts.sum(dim=1).view(count, 5, width).to(like), list[Tensor]()
    for index, (own, second, third) in enumerate(squares):
        _, two, three, scale, shift = vectors[index]
        of_edges += [torch.cat([*at_ends[index], own], dim=1), biases[index], second, two, third, three, scale, shift]
    return back, of_edges, grad_tables @ weights


@torch.library.custom_op("hood::edge_gradients", mutates_args=("back", "factors", "grad_tables", "parts"))
def edge_gradients(
    latent: Tensor,
    tables: Tensor,
    column: int,
    index: Sequence[Tensor],
    rows: Tensor | None,
    parameters: Sequence[Tensor],
    grad_updated: Tensor,
    grad_received: Tensor,
    back: Tensor,
    factors: Tensor,
    grad_tables: Tensor,
    parts: Tensor,
    eps: float,
    precision: str,
) -> None:
    """Through :func:`step_edges`: writes ``back`` (L, d), ``factors`` (6, N, d), columns of ``grad_tables`` and ``parts``.

    Args:
        index: receivers, senders, nodes, offsets and reverse of the edge set.
        rows: (N,) rows of ``latent`` that take part, the others of ``back`` stay; None: all of them.
    """
    receivers, senders, nodes, offsets, reverse = index
    count, width = len(receivers), latent.shape[1]
    tiles, shape = -(-count // tile_of(width, latent.dtype)), _shape(width, latent.dtype)
    own, *tail = parameters
    which = (latent, tables, tables.stride(0), column, receivers, senders, receivers if rows is None else rows)
    given = (own, own.stride(0), *tail, grad_updated, grad_received, grad_received.stride(0))
    options = options_of(width, latent, precision)
    _gradient_kernels().edges_back[(min(len(parts), tiles),)](
        *which, *given, back, factors, parts, count, tiles, eps, **options, **shape, SOME=rows is not None
    )
    where = (nodes, offsets, reverse, grad_tables, grad_tables.stride(0), column, len(nodes))
    _gradient_kernels().ends_back[(-(-len(nodes) // shape["TILE"]),)](factors[3], *where, **shape)


class _TailStep(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, hidden: Tensor, residual: Tensor | None, eps: float, precision: str, *parameters: Tensor) -> Tensor:
        ctx.save_for_backward(hidden, *parameters)
        ctx.eps, ctx.precision = eps, precision
        return mlp_tail(hidden, residual, list(parameters), eps, precision)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        hidden, *parameters = ctx.saved_tensors
        back, _, others = _tail_gradients(hidden.contiguous(), grad.contiguous(), parameters, ctx.eps, ctx.precision)
        return back, grad if ctx.needs_input_grad[1] else None, None, None, *others


def tail_step(hidden: Tensor, residual: Tensor | None, parameters: Sequence[Tensor], eps: float, precision: str) -> Tensor:
    """:func:`mlp_tail`, with gradients where they are asked for."""
    if not torch.is_grad_enabled():
        return mlp_tail(hidden, residual, list(parameters), eps, precision)
    result: Tensor = _TailStep.apply(hidden, residual, eps, precision, *parameters)
    return result


def _tail_gradients(
    hidden: Tensor, grad: Tensor, parameters: Sequence[Tensor], eps: float, precision: str
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """The gradients of ``hidden`` (N, d), of a bias added to it, and of the parameters."""
    (count, width), dtype = hidden.shape, parameters[0].dtype
    tiles = -(-count // tile_of(width, hidden.dtype))
    programs, back, factors = min(PROGRAMS, max(tiles, 1)), torch.empty_like(hidden), hidden.new_empty(4, count, width)
    parts = torch.zeros(programs, 5 * width, dtype=torch.float32, device=hidden.device)
    if count:
        tail_gradients(hidden, grad, list(parameters[:5]), back, factors, parts, eps, precision)
    before, behind = factors.split(2)
    second, third = (behind.transpose(1, 2) @ before).to(dtype)
    one, two, three, scale, shift = parts.sum(dim=0).to(dtype).split(width)
    return back, one, [second, two, third, three, scale, shift]


@torch.library.custom_op("hood::tail_gradients", mutates_args=("back", "factors", "parts"))
def tail_gradients(
    hidden: Tensor,
    grad: Tensor,
    parameters: Sequence[Tensor],
    back: Tensor,
    factors: Tensor,
    parts: Tensor,
    eps: float,
    precision: str,
) -> None:
    """Through :func:`mlp_tail`: writes ``back`` (N, d), ``factors`` (4, N, d) and ``parts``."""
    count, width = hidden.shape
    given = (hidden, grad, *parameters, back, factors, parts, count, -(-count // tile_of(width, hidden.dtype)), eps)
    _gradient_kernels().tail_back[(len(parts),)](*given, **options_of(width, hidden, precision), **_shape(width, hidden.dtype))


for _writes in (step_edges, edge_gradients, tail_gradients):  # without values there is nothing to write
    _writes.register_fake(lambda *arguments: None)


def _groups(parameters: Sequence[Tensor]) -> list[Sequence[Tensor]]:
    return [parameters[i : i + _PARAMETERS] for i in range(0, len(parameters), _PARAMETERS)]


def _shape(width: int, dtype: torch.dtype) -> dict[str, Any]:
    return {"WIDTH": width, "PADDED": _power_of_two(width), "TILE": tile_of(width, dtype)}

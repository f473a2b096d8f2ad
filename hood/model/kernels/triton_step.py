"""A processor step on a GPU in two kernels for every edge set, one for the nodes and one product, in Triton; inference only.
The networks beside the steps take one product and one kernel.

Composed from single operations a step reads and writes every intermediate (N, d) array and takes about forty kernel
launches. Here a program takes a tile of consecutive edges, or of nodes, through all its layers and the layer norm on the
chip. The same function as :meth:`hood.model.network.message_passing.ProcessorStep.forward`, which stays the reference.

Sums are deterministic, without atomic additions. Edges are sorted by receiver, so a node's edges are consecutive rows: a
node whose edges lie in one tile is summed there, every tile keeps what it knows of the nodes it shares with its neighbours,
and a second small pass adds that up in order. Nothing waits for the host, and the launches depend on shapes alone. The
kernels stand behind operators of torch (``hood::step_edges``, ``hood::step_nodes``, ``hood::mlp_tail``), so that a traced or
a compiled frame holds them like any other, and a CUDA graph records them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from hood.model.graph.builder import EdgeSet, Subset
from hood.tensors.dense import linear
from hood.tensors.precision import has_triton

if TYPE_CHECKING:
    from hood.model.network.message_passing import ProcessorStep
    from hood.model.network.mlp import MLP

#: Widest latents by precision. The weights of float32 beyond it leave a program no registers: at 128 each of its threads would
#: keep 16 to 28 KB in memory (tests/model/kernels/test_triton_compiled.py has the limit).
WIDEST = {torch.float32: 64, torch.bfloat16: 128}
#: How float32 is multiplied: as it is; on tensor cores as three products of parts of 10 bits, which is as good; or rounded to
#: 10 bits.
INPUT_PRECISIONS = ("ieee", "tf32x3", "tf32")


def applies(width: int, dtype: torch.dtype, device: torch.device) -> bool:
    """Whether networks with latents (N, ``width``) of ``dtype`` go this way: on a CUDA device, without gradients, float32 or
    bfloat16, a multiple of 16 up to :data:`WIDEST`, where :func:`hood.tensors.precision.has_triton` says so."""
    return not torch.is_grad_enabled() and width % 16 == 0 and width <= WIDEST.get(dtype, 0) and has_triton(device)


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
    updated, width = dict(edges), step.latent_dim
    low = nodes.to(next(iter(edges.values())).dtype)
    received = None if memory is None else memory.get(step.sets)
    if received is None:
        received = low.new_zeros(len(step.sets), *nodes.shape)
    if memory is not None:
        memory[step.sets] = received
    if names:
        tables = _tables([cast("MLP", step.edge_mlps[name]) for name in names], low, width)
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


def _tables(mlps: Sequence[MLP], nodes: Tensor, width: int) -> Tensor:
    """(R, 2 d S): for every set the parts of the edge network's first layer at the nodes, as receiver (bias included) and as
    sender; one product."""
    weights = [half for mlp in mlps for half in mlp.first.weight.split(width, dim=1)[:2]]
    biases = [half for mlp in mlps for half in (mlp.first.bias, torch.zeros_like(mlp.first.bias))]
    return linear(nodes, torch.cat(weights), torch.cat(biases))


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


@step_edges.register_fake
def _(*arguments: Any) -> None:
    return None


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

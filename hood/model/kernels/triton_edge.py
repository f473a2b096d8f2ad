"""The edge update of one processor step on a GPU as one pass over the edges, in Triton; inference only.

Composed from single operations the update reads and writes every intermediate (N, d) array and takes about ten kernel
launches. Here a program takes a tile of consecutive edges through all three layers and the layer norm on the chip and
writes the new latents and the sums at the receivers. The same function as
:func:`hood.model.network.message_passing.update_edges`, which stays the reference.

Sums are deterministic, without atomic additions. Edges are sorted by receiver, so a node's edges are consecutive rows: a
node whose edges lie in one tile is summed there, every tile keeps what it knows of the nodes it shares with its neighbours,
and a second small pass adds that up in order. Nothing waits for the host, and the launches depend on shapes alone: both
passes can be captured in a CUDA graph.
"""

from __future__ import annotations

import os
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hood.model.graph.builder import EdgeSet

if TYPE_CHECKING:
    from hood.model.network.mlp import MLP

#: Edges of a tile: rows of the products, and the length of the sums within a tile. With twice as many the compiler runs out of
#: registers.
TILES = {torch.float32: 32, torch.bfloat16: 64}
#: Widest latent whose weights fit on the chip next to a tile.
MAX_WIDTH = 128
#: How float32 is multiplied: as it is; on tensor cores as three products of parts of 10 bits, which is as good; or rounded to
#: 10 bits.
INPUT_PRECISIONS = ("ieee", "tf32x3", "tf32")


def applies(latent: Tensor) -> bool:
    """Whether edge latents (N, d) go this way: on a CUDA device, without gradients, float32 or bfloat16, d a multiple of 16
    up to :data:`MAX_WIDTH`, where Triton is installed. ``HOOD_TRITON=off`` in the environment turns it off."""
    traced = type(latent) is not Tensor  # without values: a trace cannot look into these kernels
    if traced or not latent.is_cuda or torch.is_grad_enabled() or torch.compiler.is_compiling():
        return False
    fits = latent.shape[1] % 16 == 0 and latent.shape[1] <= MAX_WIDTH and latent.dtype in TILES
    return fits and os.environ.get("HOOD_TRITON", "on") != "off" and _supported(latent.device)


@cache
def _supported(device: torch.device) -> bool:
    """Whether Triton is here and the device an NVIDIA one with tensor cores for both precisions (Ampere or later)."""
    here = find_spec("triton") is not None and torch.version.hip is None
    return here and torch.cuda.get_device_capability(device) >= (8, 0)


def input_precision() -> str:
    """As exact as torch was told to be in its own products of float32."""
    return "tf32" if torch.backends.cuda.matmul.fp32_precision == "tf32" else "tf32x3"


def update_edges_fused(
    mlp: MLP, table: Tensor, latent: Tensor, edges: EdgeSet, overwrite: bool = False, precision: str = "tf32x3"
) -> tuple[Tensor, Tensor]:
    """New edge latents and the sums at the receivers.

    Args:
        mlp: edge network, 3d → d, with a layer norm. Its weights are rounded to the precision of ``latent``; sums within a
            product, layer norm and residual are float32.
        table: (R, 2d) parts of the first layer per node, as receiver (bias included) and as sender, for the nodes of
            ``edges`` in the first rows.
        latent: (N, d), float32 or bfloat16.
        overwrite: write the new latents over ``latent``.
        precision: one of :data:`INPUT_PRECISIONS`, for float32.

    Returns:
        (N, d) and (R, d), in the precision of ``latent``; sums at nodes without edges are zero.
    """
    if precision not in INPUT_PRECISIONS:
        raise ValueError(f"precision is {precision!r}; choose {' or '.join(INPUT_PRECISIONS)}")
    assert mlp.norm is not None, "edge networks end in a layer norm"
    count, width = latent.shape
    received = latent.new_zeros(table.shape[0], width)
    if count == 0:
        return latent, received
    latent, table = latent.contiguous(), table.contiguous()
    updated = latent if overwrite else torch.empty_like(latent)
    tile = TILES[latent.dtype]
    tiles = -(-count // tile)
    borders = torch.empty(2, tiles, width, dtype=torch.float32, device=latent.device)
    first, parameters = mlp.first.weight, mlp.tail_parameters()
    receivers, senders = edges.local_receivers, edges.local_senders
    arguments = (latent, table, receivers, senders, first[:, 2 * width :], first.stride(0), *parameters)
    shape = {"WIDTH": width, "PADDED": _power_of_two(width), "TILE": tile}
    options = {"PRECISION": precision, "WIDEN": latent.device.type == "cpu", "num_warps": 8, "num_stages": 1}
    tile_pass, border_pass = _kernels()
    tile_pass[(tiles,)](*arguments, updated, received, borders, count, tiles, mlp.norm.eps, **options, **shape)
    if tiles > 1:
        border_pass[(tiles - 1,)](receivers, edges.offsets, borders, received, count, tiles, **shape, CHUNK=32)
    return updated, received


def _power_of_two(width: int) -> int:
    return max(16, 1 << (width - 1).bit_length())


@cache
def _kernels() -> tuple[Any, Any]:
    """Both kernels; imports Triton."""
    from hood.model.kernels import triton_kernels

    return triton_kernels.tile_pass, triton_kernels.border_pass

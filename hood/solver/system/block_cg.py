"""Conjugate gradients of a number of iterations that is known before: on a GPU two kernels an iteration, in Triton.

Single operations take twenty, and the host would have to be asked when to stop. Here a scene that is done changes nothing any
more. Every sum over a scene is one over tiles of rows in their order, taken anew by whoever needs it: no two runs differ.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hood.solver.system.linear import by_blocks, conjugate_gradients
from hood.solver.system.sparsity import BlockPattern
from hood.tensors.triton_device import has_triton

#: Rows of a tile, partial sums that are read at once, and warps of a program.
TILE, CHUNK, WARPS = 64, 128, 2


class BlockRows(NamedTuple):
    """Which blocks there are, and the tiles of rows: no tile has rows of two scenes."""

    columns: Tensor  # (K,) int32 block columns, row by row
    starts: Tensor  # (N + 1,) int32 where rows begin
    scene: Tensor  # (N,)
    tile_rows: Tensor  # (T,) int32 first row
    tile_ends: Tensor  # (T,) int32 end of the rows of its scene
    tile_scene: Tensor  # (T,) int32
    scene_tiles: Tensor  # (B + 1,) int32 where a scene's tiles begin


def block_rows(pattern: BlockPattern, scene: Tensor, num_scenes: int) -> BlockRows:
    """The tables of a pattern whose rows (N,) are of ``scene``, ascending."""
    ends = np.cumsum(np.bincount(scene.cpu().numpy(), minlength=num_scenes))
    begins = np.concatenate([[0], ends[:-1]])
    tiles = [np.arange(begin, end, TILE) for begin, end in zip(begins, ends, strict=True)]
    counts = [len(rows) for rows in tiles]
    tables = (
        pattern.cols,
        pattern.starts,
        np.concatenate(tiles),
        np.repeat(ends, counts),
        np.repeat(np.arange(num_scenes), counts),
        np.concatenate([[0], np.cumsum(counts)]),
    )
    columns, starts, *others = (torch.as_tensor(table.astype(np.int32), device=scene.device) for table in tables)
    return BlockRows(columns, starts, scene, *others)


@torch.library.custom_op("hood::block_cg", mutates_args=())
def block_cg(
    triples: Tensor, inverse: Tensor, right: Tensor, tolerance: Tensor, rows: list[Tensor], iterations: int
) -> tuple[Tensor, Tensor]:
    """x (N, 3) with A x ≈ ``right`` (N, 3) scene by scene, and 1 for the scenes (B,) int32 in which A turned out indefinite.

    As :func:`hood.solver.system.linear.conjugate_gradients`, which does it where there are no such kernels.

    Args:
        triples: (R, 3) of A, in the pattern's layout.
        inverse: (N, 3, 3) of its diagonal blocks, symmetric: the preconditioner.
        tolerance: (B,) residual, relative to the right-hand side, both measured by the preconditioner.
        rows: the fields of :class:`BlockRows`.
    """
    if not has_triton(right.device):
        return _in_torch(BlockRows(*rows), triples, inverse, right, tolerance, iterations)
    columns, starts, _, *tables, scene_tiles = rows
    tiles, scenes = len(tables[0]), len(tolerance)
    x, r, z, q, even, odd = (torch.empty_like(right) for _ in range(6))
    rz, pq = right.new_empty(iterations + 1, tiles), right.new_empty(max(iterations, 1), tiles)
    stopped = torch.empty(iterations + 1, scenes, dtype=torch.int32, device=right.device)
    indefinite = torch.empty(scenes, dtype=torch.int32, device=right.device)
    kernels, options = _kernels(), {"TILE": TILE, "num_warps": WARPS}
    kernels.begin_pass[(tiles,)](right, inverse, x, r, z, odd, rz, stopped, indefinite, *tables, **options)
    for index in range(iterations):
        before, p = (odd, even) if index % 2 == 0 else (even, odd)
        where = stopped, *tables, scene_tiles, index, tiles, scenes
        kernels.product_pass[(tiles,)](triples, columns, starts, z, before, p, q, rz, pq, *where, CHUNK=CHUNK, **options)
        kernels.update_pass[(tiles,)](inverse, p, q, x, r, z, rz, pq, tolerance, indefinite, *where, CHUNK=CHUNK, **options)
    return x, indefinite


@block_cg.register_fake
def _(
    triples: Tensor, inverse: Tensor, right: Tensor, tolerance: Tensor, rows: list[Tensor], iterations: int
) -> tuple[Tensor, Tensor]:
    return torch.empty_like(right), torch.empty_like(tolerance, dtype=torch.int32)


def _in_torch(
    rows: BlockRows, triples: Tensor, inverse: Tensor, right: Tensor, tolerance: Tensor, iterations: int
) -> tuple[Tensor, Tensor]:
    starts, columns, axes = rows.starts.long(), rows.columns.long(), torch.arange(3, device=right.device)
    degree = starts.diff()
    row = torch.repeat_interleave(torch.arange(len(degree), device=right.device), degree)
    place = torch.arange(len(columns), device=right.device) + 2 * starts[row]
    blocks = triples[place[:, None] + axes * degree[row, None]]  # (K, 3, 3)

    def apply(x: Tensor) -> Tensor:
        return torch.zeros_like(x).index_add(0, row, torch.bmm(blocks, x[columns].unsqueeze(2)).squeeze(2))

    scenes = len(tolerance)
    x, _, indefinite = conjugate_gradients(apply, by_blocks(inverse), right, rows.scene, scenes, tolerance, iterations)
    return x, indefinite.to(torch.int32)


@cache
def _kernels() -> Any:
    """The module of the kernels; imports Triton."""
    from hood.solver.system import cg_kernels

    return cg_kernels

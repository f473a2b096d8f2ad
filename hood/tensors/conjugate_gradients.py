"""Conjugate gradients whose number of steps the sizes of the scenes alone decide.

No shape and no branch depends on a value, so that a CUDA graph can hold them. The scenes of a batch run side by side, each with
its own step lengths and as many steps as alone.

The same for a matrix of blocks, which ends by itself where it is done.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hood.tensors.dense import has_triton, sum_scenes

#: Rows of a tile, partial sums that are read at once, and warps of a program.
TILE, CHUNK, WARPS = 64, 128, 2


@dataclass(frozen=True)
class Steps:
    """How many steps a scene takes: their number grows with its width in edges."""

    rate: float  # per square root of its vertices
    least: int

    def __call__(self, num_vertices: int) -> int:
        return max(math.ceil(self.rate * math.sqrt(num_vertices)), self.least)


@dataclass(frozen=True)
class Scenes:
    """Vertices by the scene that they are of."""

    scene: Tensor  # (V,)
    sizes: tuple[int, ...]  # vertices of every scene

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """Products of two (V, 3) scene by scene, spread to the vertices: (V, 1), or (1, 1) where there is one scene."""
        if len(self.sizes) == 1:
            return (a * b).sum().view(1, 1)
        sums = sum_scenes((a * b).sum(dim=1), self.scene, len(self.sizes))
        return sums[self.scene].unsqueeze(1)

    def limits(self, steps: Steps) -> Tensor | None:
        """Steps of the scene of every vertex, (V, 1); None where there is one scene. Made on the device: a copy from the host
        could not be captured."""
        count = len(self.sizes)
        if count == 1:
            return None
        sizes = torch.zeros(count, dtype=torch.float64, device=self.scene.device)
        sizes = sizes.index_add(0, self.scene, torch.ones_like(self.scene, dtype=torch.float64))
        return (steps.rate * sizes.sqrt()).ceil().clamp_min(steps.least)[self.scene].unsqueeze(1)


def solve(
    apply: Callable[[Tensor], Tensor], precondition: Callable[[Tensor], Tensor], right: Tensor, scenes: Scenes, steps: Steps
) -> Tensor:
    """Approximate u (V, 3) with A u = ``right`` (V, 3), from u = 0.

    Args:
        apply: x → A x, symmetric positive definite; vertices that do not move are left at 0.
        precondition: r → P r, the same.
    """
    u, r = torch.zeros_like(right), right
    z = precondition(r)
    p, rz = z, scenes.dot(r, z)
    limit = scenes.limits(steps)
    for step in range(max(map(steps, scenes.sizes))):
        q = apply(p)
        length = _ratio(rz, scenes.dot(p, q))
        if limit is not None:
            length = torch.where(step < limit, length, 0.0)
        u = u + length * p
        r = r - length * q
        z = precondition(r)
        before, rz = rz, scenes.dot(r, z)
        p = z + _ratio(rz, before) * p
    return u


def _ratio(above: Tensor, below: Tensor) -> Tensor:
    """above / below; 0 where nothing is left to do."""
    some = below > 0
    return torch.where(some, above / torch.where(some, below, 1.0), 0.0)


class BlockRows(NamedTuple):
    """Which blocks there are, and the tiles of rows: no tile has rows of two scenes."""

    columns: Tensor  # (K,) int32 block columns, row by row
    starts: Tensor  # (N + 1,) int32 where rows begin
    scene: Tensor  # (N,)
    tile_rows: Tensor  # (T,) int32 first row
    tile_ends: Tensor  # (T,) int32 end of the rows of its scene
    tile_scene: Tensor  # (T,) int32
    scene_tiles: Tensor  # (B + 1,) int32 where a scene's tiles begin


def block_rows(columns: np.ndarray, starts: np.ndarray, scene: Tensor, num_scenes: int) -> BlockRows:
    """The tables of a matrix whose rows (N,) are of ``scene``, ascending, from the block columns (K,) row by row and where rows
    begin (N + 1,)."""
    ends = np.cumsum(np.bincount(scene.cpu().numpy(), minlength=num_scenes))
    begins = np.concatenate([[0], ends[:-1]])
    tiles = [np.arange(begin, end, TILE) for begin, end in zip(begins, ends, strict=True)]
    counts = [len(rows) for rows in tiles]
    tables = (
        columns,
        starts,
        np.concatenate(tiles),
        np.repeat(ends, counts),
        np.repeat(np.arange(num_scenes), counts),
        np.concatenate([[0], np.cumsum(counts)]),
    )
    made = (torch.as_tensor(table.astype(np.int32), device=scene.device) for table in tables)
    return BlockRows(next(made), next(made), scene, *made)


@torch.library.custom_op("hood::block_cg", mutates_args=())
def block_cg(
    triples: Tensor, inverse: Tensor, right: Tensor, tolerance: Tensor, rows: list[Tensor], iterations: int
) -> tuple[Tensor, Tensor]:
    """x (N, 3) with A x ≈ ``right`` (N, 3) scene by scene, and 1 for the scenes (B,) int32 in which A turned out indefinite.

    On a GPU two kernels an iteration, in Triton, where single operations take twenty and the host would have to be asked when
    to stop: a scene that is done changes nothing any more. Every sum over a scene is one over tiles of rows in their order,
    taken anew by whoever needs it, so no two runs differ. Elsewhere in torch, until all scenes are done.

    Args:
        triples: (R, 3) of A in any precision, as :class:`hood.solver.system.sparsity.BlockPattern` lays them out.
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
    degree, scenes = starts.diff(), len(tolerance)
    row = torch.repeat_interleave(torch.arange(len(degree), device=right.device), degree)
    place = torch.arange(len(columns), device=right.device) + 2 * starts[row]
    blocks = triples[place[:, None] + axes * degree[row, None]].to(right.dtype)  # (K, 3, 3)

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return sum_scenes((a * b).sum(dim=1), rows.scene, scenes)

    def spread(values: Tensor) -> Tensor:
        return values[rows.scene].unsqueeze(1)

    x, r = torch.zeros_like(right), right
    z = torch.bmm(inverse, r.unsqueeze(2)).squeeze(2)
    p, rz = z, dot(r, z)
    limit = tolerance**2 * rz
    indefinite, going = torch.zeros_like(rz, dtype=torch.bool), rz > limit
    for _ in range(iterations):
        if not bool(going.any()):
            break
        pulled = torch.bmm(blocks, p[columns].unsqueeze(2)).squeeze(2)
        q = torch.zeros_like(p).index_add(0, row, pulled)
        curvature = dot(p, q)
        indefinite |= going & ~(curvature > 0)
        going = going & (curvature > 0)
        length = torch.where(going, rz / torch.where(going, curvature, 1.0), 0.0)
        x, r = torch.where(spread(going), x + spread(length) * p, x), torch.where(spread(going), r - spread(length) * q, r)
        z = torch.bmm(inverse, r.unsqueeze(2)).squeeze(2)
        before, rz = rz, torch.where(going, dot(r, z), rz)
        p = torch.where(spread(going), z + spread(rz / torch.where(going, before, 1.0)) * p, p)
        going = going & (rz > limit)
    return x, indefinite.to(torch.int32)


@cache
def _kernels() -> Any:
    """The module of the kernels; imports Triton."""
    from hood.tensors import cg_kernels

    return cg_kernels

"""Which of many axis-aligned boxes overlap: sorted cells of a uniform grid, in numpy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

#: Edge of a cell in units of the typical box.
_CELL = 1.5
#: A box that covers more cells than this is compared with every other box instead.
_MANY_CELLS = 512
#: Pairs that are looked at together: a bound on memory, whatever overlaps.
_BLOCK = 1 << 20


def overlapping_boxes(low: np.ndarray, high: np.ndarray, other_low: np.ndarray, other_high: np.ndarray) -> Iterator[np.ndarray]:
    """Pairs (N, 2) of boxes and other boxes that overlap or touch, each once, in blocks of bounded size.

    Corners are (A, 3) and (B, 3), finite, in one unit. The order of the pairs is fixed by the input.
    """
    if len(low) == 0 or len(other_low) == 0:
        return
    near = np.flatnonzero(((other_low <= high.max(axis=0)) & (other_high >= low.min(axis=0))).all(axis=1))
    if len(near) == 0:
        return
    other_low, other_high = other_low[near], other_high[near]
    grid = _grid(low, high, other_low, other_high)
    axes = [np.ascontiguousarray(corner.T) for corner in (low, high, other_low, other_high)]
    own, other = grid.cells(low, high), grid.cells(other_low, other_high)
    small, large = own.split()
    other_small, other_large = other.split()
    for rows, columns in ((large, np.arange(len(near))), (small, other_large)):
        for pairs in _all_pairs(rows, columns):
            i, j = _overlap(pairs, axes)
            yield np.column_stack([i, near[j]])
    for pairs in _sharing(grid.entries(own, small), grid.entries(other, other_small)):
        i, j = _overlap(pairs, axes)
        key = np.sort(i * len(near) + j)
        key = key[np.r_[True, key[1:] != key[:-1]][: len(key)]]  # boxes that share several cells
        yield np.column_stack([key // len(near), near[key % len(near)]])


class _Cells(NamedTuple):
    """First cell and number of cells of boxes along each axis, both (N, 3)."""

    first: np.ndarray
    number: np.ndarray

    def split(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the boxes that cover few cells, and of those that cover many."""
        many = self.number.prod(axis=1) > _MANY_CELLS
        return np.flatnonzero(~many), np.flatnonzero(many)


class _Grid(NamedTuple):
    """Cubic cells from ``origin`` on; what lies outside belongs to the outermost cells."""

    origin: np.ndarray  # (3,)
    cell: float
    shape: np.ndarray  # (3,) int64

    def cells(self, low: np.ndarray, high: np.ndarray) -> _Cells:
        """The cells of boxes."""
        first, last = (np.clip((x - self.origin) / self.cell, 0, self.shape - 1).astype(np.int64) for x in (low, high))
        return _Cells(first, last - first + 1)

    def entries(self, cells: _Cells, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Every cell of every one of ``boxes``: the box and the number of the cell, box after box."""
        first, count = cells.first[boxes], cells.number[boxes]
        total = count.prod(axis=1)
        row = np.repeat(np.arange(len(boxes)), total)
        place = _within(total)
        x, place = place % count[row, 0], place // count[row, 0]
        y, z = place % count[row, 1], place // count[row, 1]
        number = ((first[row, 2] + z) * self.shape[1] + first[row, 1] + y) * self.shape[0] + first[row, 0] + x
        return boxes[row], number


def _grid(low: np.ndarray, high: np.ndarray, other_low: np.ndarray, other_high: np.ndarray) -> _Grid:
    """Cells around the first boxes, wide enough for a typical box of both sets."""
    origin, extent = low.min(axis=0), high.max(axis=0) - low.min(axis=0)
    typical = max(float(np.median((top - bottom).max(axis=1))) for bottom, top in ((low, high), (other_low, other_high)))
    # Points have no size at all; and products of numbers of cells must fit into 64 bits.
    cell = max(_CELL * typical, 1e-5 * float(extent.max()), np.finfo(float).tiny)
    return _Grid(origin, cell, (extent / cell).astype(np.int64) + 1)


def _sharing(
    entries: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of boxes with a cell in common, as often as they have one."""
    owner, cell = entries
    order = np.argsort(other[1], kind="stable")
    other_owner, other_cell = other[0][order], other[1][order]
    start = np.searchsorted(other_cell, cell)
    count = np.searchsorted(other_cell, cell, side="right") - start
    for part in _parts(owner, count):
        place = np.repeat(start[part], count[part]) + _within(count[part])
        yield np.repeat(owner[part], count[part]), other_owner[place]


def _overlap(pairs: tuple[np.ndarray, np.ndarray], boxes: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Those of the ``pairs`` whose boxes overlap; axis by axis, as each axis leaves fewer."""
    i, j = pairs
    for low, high, other_low, other_high in zip(*boxes, strict=True):
        kept = np.flatnonzero((low[i] <= other_high[j]) & (high[i] >= other_low[j]))
        i, j = i[kept], j[kept]
    return i, j


def _all_pairs(rows: np.ndarray, columns: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Every row with every column."""
    if len(columns) == 0:
        return
    step = max(_BLOCK // len(columns), 1)
    for begin in range(0, len(rows), step):
        part = rows[begin : begin + step]
        yield np.repeat(part, len(columns)), np.tile(columns, len(part))


def _parts(owner: np.ndarray, count: np.ndarray) -> Iterator[slice]:
    """Slices of entries with at most about :data:`_BLOCK` pairs each; all entries of a box are in one slice."""
    if len(owner) == 0:
        return
    borders = np.concatenate([np.flatnonzero(np.r_[True, owner[1:] != owner[:-1]]), [len(owner)]])
    before = np.r_[0, np.cumsum(count)][borders]
    begin = 0
    while begin < len(borders) - 1:
        end = max(int(np.searchsorted(before, before[begin] + _BLOCK, side="right")) - 1, begin + 1)
        yield slice(int(borders[begin]), int(borders[end]))
        begin = end


def _within(counts: np.ndarray) -> np.ndarray:
    """0, 1, … of every group, groups one after another."""
    return np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)

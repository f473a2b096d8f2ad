"""Tables that the compiled solver reads: one scene's cloth with its vertices, blocks and elements numbered anew.

The free vertices come first, in an order that keeps neighbours near each other (reverse Cuthill-McKee) and lets sweeps take
several at once, then the fixed ones. Elements are sorted by the first of their vertices in that order, and padded to a multiple
of eight by elements that weigh nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from hood.cloth.cloth import Cloth
from hood.cloth.state import Attachments

#: Elements that the compiled solver takes at a time.
_LANES = 8


@dataclass(frozen=True)
class Elements:
    """Faces or hinges of one scene, and where each row of blocks finds those at its vertex."""

    order: np.ndarray  # (N,) elements of the cloth, in the new order
    corners: np.ndarray  # (C, P) int32 vertices of the padded elements
    starts: np.ndarray  # (R C + 1,) int32, where the uses of a row with C, ..., 1 blocks there begin
    uses: (
        np.ndarray
    )  # (U, 1 + C) int32: 4 element + corner, then 4 place in the row + corner of every block, the diagonal first

    def padded(self, values: np.ndarray, padding: float = 0.0) -> np.ndarray:
        """Numbers (..., elements of the cloth) in the new order (..., P), float64."""
        missing = self.corners.shape[1] - len(self.order)
        widths = [(0, 0)] * (values.ndim - 1) + [(0, missing)]
        return np.ascontiguousarray(np.pad(values[..., self.order].astype(np.float64), widths, constant_values=padding))


@dataclass(frozen=True)
class Pairs:
    """Rows as sweeps take them, two at a time: consecutive ones that are no neighbours, or one alone. Each has a slot for its
    numbers: twice the pair, and one more in its second half. Blocks of a pair lie beside each other as (3, 2, 4) numbers."""

    slot: np.ndarray  # (R,) int32
    row: np.ndarray  # (2 P,) int32 by slot, -1 where a half is empty
    starts: np.ndarray  # (P + 1,) int32
    cols: np.ndarray  # (L, 2) int32 slots of the columns, the diagonal first; where a row is shorter, its own

    @property
    def reach(self) -> int:
        """How many pairs a column is behind its row at most."""
        return int((self.cols // 2 - np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))[:, None]).max(initial=0))


@dataclass(frozen=True)
class Tables:
    """Topology of one scene for the compiled solver; valid as long as its plan."""

    vertex: np.ndarray  # (V,) int64 vertices of the cloth, the R free ones first
    num_rows: int
    row_starts: np.ndarray  # (R + 1,) int32
    cols: np.ndarray  # (K,) int32, that of the diagonal first in every row, then later ones
    pairs: Pairs
    faces: Elements
    hinges: Elements
    springs: Elements  # attachments of the step

    @property
    def most_blocks(self) -> int:
        """Blocks of the longest row."""
        return int(np.diff(self.row_starts).max(initial=0))

    @cached_property
    def place(self) -> np.ndarray:
        """(K,) int32: which number of the compiled solver's matrix is the first of each block."""
        first = np.repeat(self.pairs.starts[self.pairs.slot // 2] - self.row_starts[:-1], np.diff(self.row_starts))
        half = np.repeat(self.pairs.slot % 2, np.diff(self.row_starts))
        return np.asarray(24 * (np.arange(len(self.cols)) + first) + 4 * half, np.int32)

    def blocks(self, matrix: np.ndarray) -> np.ndarray:
        """Blocks (K, 3, 3) of the compiled solver's ``matrix``, in the order of :attr:`cols`."""
        return matrix.reshape(-1)[self.place[:, None, None] + np.array([[0], [8], [16]]) + np.arange(3)]

    def border(self, parts: int, kind: type) -> dict[str, np.ndarray]:
        """Where rows in so many parts have neighbours in other parts: these rows, ``border`` (K,) int32, which share of their
        neighbours is ``outside`` (K,), and room for ``border_blocks`` (24 K,) of a ``kind``. The blocks between parts,
        ``outer_blocks`` (N, 3) int32: slots of a row and of the other one, and :attr:`place`; of every part those that act
        transposed, then those that act as they are, beginning at ``outer_starts`` (2 parts + 1,) int32. Parts are those of
        ``range_of`` in ``hood/native/threads.h``."""
        size, pairs, slot = self.num_rows, len(self.pairs.starts) - 1, self.pairs.slot
        rows, cols = np.repeat(np.arange(size), np.diff(self.row_starts)), self.cols
        part = np.searchsorted(pairs * np.arange(1, parts) // parts, slot // 2, side="right")
        both, other = np.concatenate([rows, cols]), np.tile(part[rows] != part[cols], 2)
        outside = np.bincount(both, other, size) / np.maximum(np.bincount(both, minlength=size) - 2, 1)  # but the diagonal
        border, outer = np.flatnonzero(outside), np.flatnonzero(part[rows] != part[cols])
        ends, place = slot[np.stack([cols[outer], rows[outer]])], self.place[outer]
        blocks = np.concatenate([np.column_stack([*ends, place]), np.column_stack([*ends[::-1], place])])
        group = np.concatenate([2 * part[cols[outer]], 2 * part[rows[outer]] + 1])
        return {
            "border": border.astype(np.int32),
            "outside": outside[border],
            "border_blocks": np.zeros(24 * len(border), kind),
            "outer_blocks": blocks[np.argsort(group, kind="stable")].astype(np.int32),
            "outer_starts": np.searchsorted(np.sort(group), np.arange(2 * parts + 1)).astype(np.int32),
        }


def build_tables(cloth: Cloth, attachments: Attachments | None, scene: int) -> Tables:
    """Tables of one ``scene`` of a cloth and the attachments of its steps."""
    members = (cloth.vertex_scene == scene).cpu().numpy()
    free = cloth.free.cpu().numpy() & members
    tables = [cloth.faces.cpu().numpy(), cloth.hinges.cpu().numpy()]
    tables.append(np.zeros((0, 2), np.int64) if attachments is None else attachments.edges.cpu().numpy())
    chosen = [np.flatnonzero(members[table[:, 0]]) for table in tables]
    unknown, vertices = _order(free, [table[rows] for table, rows in zip(tables, chosen, strict=True)])
    number = np.full(len(members), -1, np.int64)
    vertex = np.concatenate([vertices, np.flatnonzero(members & ~free)])
    number[vertex] = np.arange(len(vertex))
    size = len(vertices)
    corners = [number[table[rows]] for table, rows in zip(tables, chosen, strict=True)]
    keys = _block_keys(corners, size)
    rows, cols = keys // max(size, 1), keys % max(size, 1)
    starts = np.searchsorted(rows, np.arange(size + 1))
    return Tables(
        vertex=vertex,
        num_rows=size,
        row_starts=starts.astype(np.int32),
        cols=cols.astype(np.int32),
        pairs=_pairs(starts, cols),
        faces=_elements(chosen[0], corners[0], keys, starts),
        hinges=_elements(chosen[1], corners[1], keys, starts),
        springs=_elements(chosen[2], corners[2], keys, starts, lanes=1),
    )


def point_uses(tables: Tables, corners: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the points at the vertex of a row begin, (R + 1,), and what is known of each, (U, 5); both int32.

    Known are the point, the corner that is the row's vertex, and the places in the row of the blocks with the point's three
    corners, 0 where another row keeps the block or there is none.

    Args:
        corners: (N, 3) vertices of the points in the new numbering.
        weights: (N, 3), 0 where there is no corner.
    """
    size = tables.num_rows
    point, corner = np.nonzero((corners < size) & (weights > 0))
    row = corners[point, corner]
    order = np.argsort(row, kind="stable")
    point, corner, row = point[order], corner[order], row[order]
    cols = corners[point]
    keys = np.repeat(np.arange(size), np.diff(tables.row_starts)) * size + tables.cols
    places = np.searchsorted(keys, row[:, None] * size + cols) - tables.row_starts[row][:, None]
    places = np.where((cols > row[:, None]) & (cols < size) & (weights[point] > 0), places, 0)
    uses = np.concatenate([point[:, None], corner[:, None], places], axis=1)
    return np.searchsorted(row, np.arange(size + 1)).astype(np.int32), np.ascontiguousarray(uses, np.int32)


def _order(free: np.ndarray, tables: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (V,) of free vertices in their own order, and the free vertices in an order of small bandwidth."""
    unknown = np.where(free, np.cumsum(free) - 1, -1)
    size = int(free.sum())
    keys = _block_keys([unknown[table] for table in tables], size)
    rows, cols = keys // max(size, 1), keys % max(size, 1)
    upper = sparse.csr_matrix((np.ones(len(keys), np.int8), (rows, cols)), shape=(size, size))
    graph = (upper + upper.T).tocsr()
    order = csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True) if size else np.zeros(0, np.int64)
    return unknown, np.flatnonzero(free)[order[_by_levels(graph, order)]]


def _by_levels(graph: sparse.csr_matrix, order: np.ndarray) -> np.ndarray:
    """The places (N,) of an order in another one that leads to the same triangles of the matrix, and to shorter sweeps.

    A row waits for those of its later columns. Its level is the longest chain of rows that wait for one another from there, and
    rows of one level wait for none of their own: the processor takes several at once. Within a level they have more and more
    blocks, in the next one fewer and fewer, so that it foresees where a row ends.
    """
    size = len(order)
    later = sparse.triu(graph[order][:, order], k=1, format="csr")
    starts, cols = later.indptr.tolist(), later.indices.tolist()
    level = [0] * size
    for row in range(size - 1, -1, -1):
        level[row] = 1 + max((level[col] for col in cols[starts[row] : starts[row + 1]]), default=-1)
    levels, count = np.array(level, np.int64), np.diff(later.indptr)
    return np.lexsort((np.where(levels % 2, count, -count), -levels))


def _pairs(starts: np.ndarray, cols: np.ndarray) -> Pairs:
    """Pairs of the rows with the columns ``cols`` (K,), those of a row ascending from ``starts`` (R + 1,) on."""
    size = len(starts) - 1
    beside = np.append(cols, size)[np.minimum(starts[:-1] + 1, len(cols))]
    alone = (beside == np.arange(1, size + 1)) & (np.diff(starts) > 1)  # the next row is a neighbour
    slot, place = np.empty(size, np.int32), 0
    for row, single in enumerate(alone.tolist()):
        slot[row] = place
        place += 2 if single and place % 2 == 0 else 1
    num = (place + 1) // 2
    row_of = np.full(2 * num, -1, np.int32)
    row_of[slot] = np.arange(size)
    length = np.zeros(2 * num, np.int64)
    length[slot] = np.diff(starts)
    pair_starts = np.append(0, np.cumsum(length.reshape(-1, 2).max(axis=1, initial=0)))
    pair = np.repeat(np.arange(num), np.diff(pair_starts))
    both = np.stack([2 * pair, 2 * pair + 1], axis=1).astype(np.int32)
    blocks = np.arange(len(cols)) + np.repeat(pair_starts[slot // 2] - starts[:-1], np.diff(starts))
    both[blocks, np.repeat(slot % 2, np.diff(starts))] = slot[cols]
    return Pairs(slot, row_of, pair_starts.astype(np.int32), both)


def _block_keys(tables: list[np.ndarray], size: int) -> np.ndarray:
    """Sorted keys row × ``size`` + column of the blocks of the upper triangle between the unknowns of elements (N, C)."""
    keys = [np.arange(size, dtype=np.int64) * (size + 1)]
    for table in tables:
        for a, b in combinations(range(table.shape[1]), 2):
            row, col = np.minimum(table[:, a], table[:, b]), np.maximum(table[:, a], table[:, b])
            inside = (row >= 0) & (col < size)
            keys.append(row[inside] * size + col[inside])
    return np.unique(np.concatenate(keys))


def _elements(chosen: np.ndarray, corners: np.ndarray, keys: np.ndarray, starts: np.ndarray, lanes: int = _LANES) -> Elements:
    size, width = len(starts) - 1, corners.shape[1]
    order = np.lexsort(np.sort(corners, axis=1).T[::-1]) if len(corners) else np.zeros(0, np.int64)
    corners = corners[order]
    padding = -len(corners) % lanes
    padded = np.concatenate([corners, np.repeat(corners[-1:], padding, axis=0)]) if padding else corners
    table = np.concatenate([_uses(corners, corner, keys, starts) for corner in range(width)])
    table = table[np.lexsort((-table[:, 1], table[:, 0]))]
    groups = table[:, 0] * width + width - table[:, 1]
    return Elements(
        order=chosen[order],
        corners=np.ascontiguousarray(padded.T, dtype=np.int32),
        starts=np.searchsorted(groups, np.arange(size * width + 1)).astype(np.int32),
        uses=np.ascontiguousarray(table[:, 2:], dtype=np.int32),
    )


def _uses(corners: np.ndarray, corner: int, keys: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Row, number of blocks and use (U, 2 + 1 + C) of the elements whose ``corner`` is free, one for each."""
    size = len(starts) - 1
    element = np.flatnonzero(corners[:, corner] < size)
    row, cols = corners[element, corner], corners[element]
    # Blocks of earlier columns are kept by their rows, fixed corners have none; they come last and are not read.
    upper = (cols >= row[:, None]) & (cols < size)
    others = np.argsort(np.where(upper, cols, size), axis=1, kind="stable")
    cols = np.take_along_axis(np.where(upper, cols, row[:, None]), others, axis=1)
    places = np.searchsorted(keys, row[:, None] * size + cols) - starts[row][:, None]
    return np.concatenate([np.stack([row, upper.sum(axis=1), 4 * element + corner], axis=1), 4 * places + others], axis=1)

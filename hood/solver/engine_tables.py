"""Tables that the compiled solver reads: one scene's cloth with its vertices, blocks and elements numbered anew.

The free vertices come first, in an order that keeps neighbours near each other (reverse Cuthill-McKee), then the fixed ones.
Elements are sorted by their first vertex and padded to a multiple of eight by elements that weigh nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from hood.scene.cloth import Cloth
from hood.scene.state import Attachments

#: Elements that the compiled solver takes at a time.
LANES = 8


@dataclass(frozen=True)
class Elements:
    """Faces or hinges of one scene, and where each row of blocks finds those at its vertex."""

    order: np.ndarray  # (N,) elements of the cloth, in the new order
    corners: np.ndarray  # (C, P) int32 vertices of the padded elements
    starts: np.ndarray  # (R + 1,) int32, where the uses of a row begin
    uses: np.ndarray  # (U, 2 + C) int32: element, corner, the places of its corners in the row

    def padded(self, values: np.ndarray, padding: float = 0.0) -> np.ndarray:
        """Numbers (..., elements of the cloth) in the new order (..., P), float64."""
        missing = self.corners.shape[1] - len(self.order)
        widths = [(0, 0)] * (values.ndim - 1) + [(0, missing)]
        return np.ascontiguousarray(np.pad(values[..., self.order].astype(np.float64), widths, constant_values=padding))


@dataclass(frozen=True)
class Tables:
    """Topology of one scene for the compiled solver; valid as long as its plan."""

    vertex: np.ndarray  # (V,) int64 vertices of the cloth, the R free ones first
    num_rows: int
    row_starts: np.ndarray  # (R + 1,) int32
    cols: np.ndarray  # (K,) int32
    diagonal: np.ndarray  # (R,) int32
    faces: Elements
    hinges: Elements
    springs: np.ndarray  # (A,) attachments of the step that are in this scene
    spring_ends: np.ndarray  # (A, 2) int32
    spring_blocks: np.ndarray  # (A, 4) int32

    @property
    def most_blocks(self) -> int:
        """Blocks of the longest row."""
        return int(np.diff(self.row_starts).max(initial=0))


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
    springs = corners[2]
    ends = [(springs[:, a], springs[:, b]) for a, b in ((0, 0), (1, 1), (0, 1), (1, 0))]
    return Tables(
        vertex=vertex,
        num_rows=size,
        row_starts=starts.astype(np.int32),
        cols=cols.astype(np.int32),
        diagonal=_blocks(keys, np.arange(size), np.arange(size), size).astype(np.int32),
        faces=_elements(chosen[0], corners[0], keys, starts),
        hinges=_elements(chosen[1], corners[1], keys, starts),
        springs=chosen[2],
        spring_ends=springs.astype(np.int32),
        spring_blocks=np.stack([_blocks(keys, a, b, size) for a, b in ends], axis=1).astype(np.int32),
    )


def _order(free: np.ndarray, tables: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (V,) of free vertices in their own order, and the free vertices in an order of small bandwidth."""
    unknown = np.where(free, np.cumsum(free) - 1, -1)
    size = int(free.sum())
    keys = _block_keys([unknown[table] for table in tables], size)
    rows, cols = keys // max(size, 1), keys % max(size, 1)
    graph = sparse.csr_matrix((np.ones(len(keys), np.int8), (rows, cols)), shape=(size, size))
    order = csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True) if size else np.zeros(0, np.int64)
    return unknown, np.flatnonzero(free)[order]


def _block_keys(tables: list[np.ndarray], size: int) -> np.ndarray:
    """Sorted keys row × ``size`` + column of all blocks between the unknowns of elements (N, C), and of the diagonal."""
    keys = [np.arange(size, dtype=np.int64) * (size + 1)]
    for table in tables:
        for a in range(table.shape[1]):
            for b in range(table.shape[1]):
                row, col = table[:, a], table[:, b]
                inside = (row >= 0) & (row < size) & (col >= 0) & (col < size)
                keys.append(row[inside] * size + col[inside])
    return np.unique(np.concatenate(keys))


def _blocks(keys: np.ndarray, rows: np.ndarray, cols: np.ndarray, size: int) -> np.ndarray:
    """Numbers of the blocks at ``rows``, ``cols``; -1 where either is fixed."""
    inside = (rows < size) & (cols < size)
    return np.where(inside, np.searchsorted(keys, np.where(inside, rows * size + cols, 0)), -1)


def _elements(chosen: np.ndarray, corners: np.ndarray, keys: np.ndarray, starts: np.ndarray) -> Elements:
    size, width = len(starts) - 1, corners.shape[1]
    order = np.lexsort(corners.T[::-1]) if len(corners) else np.zeros(0, np.int64)
    corners = corners[order]
    padding = -len(corners) % LANES
    padded = np.concatenate([corners, np.repeat(corners[-1:], padding, axis=0)]) if padding else corners
    uses = []
    for c in range(width):
        element = np.flatnonzero(corners[:, c] < size)
        row = corners[element, c]
        places = [_blocks(keys, row, corners[element, d], size) for d in range(width)]
        # Fixed corners have the place behind the row's last block.
        inside = [np.where(place >= 0, place, starts[row + 1]) - starts[row] for place in places]
        uses.append(np.stack([row, element, np.full(len(row), c), *inside], axis=1))
    table = np.concatenate(uses)
    table = table[np.argsort(table[:, 0], kind="stable")]
    first = np.searchsorted(table[:, 0], np.arange(size + 1))
    return Elements(
        order=chosen[order],
        corners=np.ascontiguousarray(padded.T, dtype=np.int32),
        starts=first.astype(np.int32),
        uses=np.ascontiguousarray(table[:, 1:], dtype=np.int32),
    )

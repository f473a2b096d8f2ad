"""Where the entries of the Hessian go: fixed sparsity of a cloth, sums from elements into it."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from hood.tensors.dense import at_once, sum_rows


def row_product(data: Tensor, cols: np.ndarray, starts: np.ndarray, width: int) -> Callable[[Tensor], Tensor]:
    """x (``width``,) → A x on the CPU, A given row by row: numbers, their columns, where rows start (both int32)."""
    shape = (len(starts) - 1, width)
    if not torch.backends.mkl.is_available() or not len(data):
        matrix = sparse.csr_matrix((data.numpy(), cols, starts), shape=shape)
        return lambda x: torch.from_numpy(matrix @ x.numpy())
    with warnings.catch_warnings():  # torch calls this storage a beta; its product takes two thirds of scipy's time
        warnings.simplefilter("ignore", UserWarning)
        indices = torch.from_numpy(starts), torch.from_numpy(cols)
        table = torch.sparse_csr_tensor(*indices, data, size=shape, check_invariants=False)
    return lambda x: torch.mv(table, x)


class Scatter:
    """Sums entries of a vector (N,) into another (M,): entry ``source[k]`` is added to entry ``target[k]``.

    A sparse matrix product on the CPU: several times faster there than ``index_add``. Sums have a fixed order on any device.

    Args:
        target, source: (K,) each, of any shape with K entries; pairs with a negative target are left out.
        size: M.
        num_values: N.
    """

    def __init__(self, target: np.ndarray, source: np.ndarray, size: int, num_values: int) -> None:
        target, source = np.asarray(target, np.int64).reshape(-1), np.asarray(source, np.int64).reshape(-1)
        kept = np.flatnonzero(target >= 0)
        order = kept[np.argsort(target[kept], kind="stable")]
        self.size, self.num_values = size, num_values
        starts = np.concatenate([[0], np.cumsum(np.bincount(target[order], minlength=size))])
        self._structure = (source[order].astype(np.int32), starts.astype(np.int32), num_values)
        self._source, self._starts = (torch.from_numpy(table) for table in self._structure[:2])
        self._products: dict[torch.dtype, Callable[[Tensor], Tensor]] = {}

    def __call__(self, values: Tensor) -> Tensor:
        """(M,) sums of ``values``, any shape with N entries."""
        if self.by_index_alone(values):
            return self.by_index(values)
        if values.dtype not in self._products:
            ones = torch.ones(len(self._source), dtype=values.dtype)
            self._products[values.dtype] = row_product(ones, *self._structure)
        return self._products[values.dtype](values.reshape(-1))

    @staticmethod
    def by_index_alone(values: Tensor) -> bool:
        """Whether entries like these are summed by :meth:`by_index`, where writing them part by part does not pay either."""
        return at_once(values)

    def by_index(self, values: Tensor) -> Tensor:
        """The same in torch operations, on any device."""
        self._source, self._starts = self._source.to(values.device), self._starts.to(values.device)
        return sum_rows(values.reshape(-1, 1), self._source, self._starts).view(-1)


def to_vertices(corners: np.ndarray, size: int) -> Scatter:
    """From vectors (C, 3, N) at the corners (N, C) of elements to vertices, (3 ``size``,)."""
    count, width = corners.shape
    target = 3 * corners.T[:, None, :] + np.arange(3)[:, None]
    target = np.where(corners.T[:, None, :] >= 0, target, -1)
    return Scatter(target, np.arange(3 * width * count), 3 * size, 3 * width * count)


class BlockPattern:
    """Symmetric sparse matrix of 3 × 3 blocks with a fixed set of non-zero blocks, stored row by row (CSR).

    Its numbers are *triples* (R, 3), the three entries of one row of one block, ordered by scalar row, then block column.

    Args:
        size: N, number of block rows.
        pairs: (K, 2) rows and columns of blocks off the diagonal; repeats, their mirror images and the diagonal
            are dealt with here.
    """

    def __init__(self, size: int, pairs: np.ndarray) -> None:
        pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
        diagonal = np.arange(size, dtype=np.int64)
        rows = np.concatenate([pairs[:, 0], pairs[:, 1], diagonal])
        cols = np.concatenate([pairs[:, 1], pairs[:, 0], diagonal])
        self.size = size
        self._keys = np.unique(rows * size + cols)
        self.rows, self.cols = self._keys // max(size, 1), self._keys % max(size, 1)
        degree = np.bincount(self.rows, minlength=size)
        self.starts = np.concatenate([[0], np.cumsum(degree)])
        self._degree = degree
        self.num_triples = 3 * len(self._keys)
        self.diagonal = torch.as_tensor(self.triples(diagonal, diagonal))  # (N, 3)
        place = self.triples(self.rows, self.cols)
        self.triple_rows = np.empty(self.num_triples, dtype=np.int64)  # scalar rows
        self.triple_cols = np.empty(self.num_triples, dtype=np.int64)  # block columns
        self.triple_rows[place] = 3 * self.rows[:, None] + np.arange(3)
        self.triple_cols[place] = self.cols[:, None]
        self.indptr = np.concatenate([[0], np.cumsum(np.repeat(3 * degree, 3))]).astype(np.int32)
        self.indices = (3 * self.triple_cols[:, None] + np.arange(3)).reshape(-1).astype(np.int32)

    def triples(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """Indices (..., 3) of the triples of the blocks at ``rows``, ``cols`` (...); -1 where either is negative."""
        if self.size == 0:
            return np.full((*rows.shape, 3), -1, dtype=np.int64)
        inside = (rows >= 0) & (cols >= 0)
        row = np.where(inside, rows, 0)
        slot = np.searchsorted(self._keys, row * self.size + np.where(inside, cols, 0))
        first = 2 * self.starts[row] + slot
        return np.where(inside[..., None], first[..., None] + np.arange(3) * self._degree[row][..., None], -1)

    def band_order(self) -> tuple[np.ndarray, int]:
        """A numbering of the block rows that keeps the matrix near its diagonal (reverse Cuthill-McKee), as ranks
        (N,), and the number of scalar diagonals below the main one that it needs."""
        if self.size == 0:
            return np.zeros(0, dtype=np.int64), 0
        graph = sparse.csr_matrix((np.ones(len(self._keys), np.int8), self.cols, self.starts), shape=(self.size, self.size))
        order = csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True)
        rank = np.empty(self.size, dtype=np.int64)
        rank[order] = np.arange(self.size)
        reach = int(np.abs(rank[self.rows] - rank[self.cols]).max())
        return rank, 3 * reach + 2


def upper_pairs(size: int) -> list[tuple[int, int]]:
    """Rows and columns of the upper triangle of a symmetric matrix, row by row: the order of element matrices."""
    return [(row, col) for row in range(size) for col in range(row, size)]


def matrix_targets(pattern: BlockPattern, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the upper triangles (K, N) of element matrices (N, 3C, 3C), rows by corner then axis, go.

    Targets among the pattern's 3 R numbers, -1 for fixed corners, and their sources; off the diagonal both mirror images.
    """
    count, width = corners.shape
    targets, sources = [], []
    for place, (row, col) in enumerate(upper_pairs(3 * width)):
        source = place * count + np.arange(count)
        for p, q in {(row, col), (col, row)}:
            triple = pattern.triples(corners[:, p // 3], corners[:, q // 3])[:, p % 3]
            targets.append(np.where(triple >= 0, 3 * triple + q % 3, -1))
            sources.append(source)
    return np.concatenate(targets), np.concatenate(sources)


def axial_targets(pattern: BlockPattern, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same for upper triangles (K, N) of matrices (N, C, C) that act on the three axes alike."""
    count, width = corners.shape
    targets, sources = [], []
    for place, (row, col) in enumerate(upper_pairs(width)):
        source = place * count + np.arange(count)
        for p, q in {(row, col), (col, row)}:
            triple = pattern.triples(corners[:, p], corners[:, q])
            targets.append(np.where(triple >= 0, 3 * triple + np.arange(3), -1))
            sources.append(np.repeat(source, 3))
    return np.concatenate([t.reshape(-1) for t in targets]), np.concatenate(sources)

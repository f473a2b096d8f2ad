"""Where the entries of the Hessian go: fixed sparsity of a cloth, sums from elements into it."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor


class RowSum:
    """Sums rows of a table (N, 3) into another (M, 3): row *i* goes to row ``target[i]``, or nowhere where that is -1.

    A sparse matrix product on the CPU: several times faster there than ``index_add`` of rows.
    """

    def __init__(self, target: np.ndarray, size: int) -> None:
        target = np.asarray(target, dtype=np.int64).reshape(-1)
        self.size = size
        self._target = torch.as_tensor(np.where(target < 0, size, target))
        kept = np.flatnonzero(target >= 0)
        order = kept[np.argsort(target[kept], kind="stable")]
        indptr = np.concatenate([[0], np.cumsum(np.bincount(target[kept], minlength=size))])
        self._structure = (order.astype(np.int32), indptr.astype(np.int32), (size, len(target)))
        self._matrices: dict[torch.dtype, sparse.csr_matrix] = {}

    def __call__(self, values: Tensor) -> Tensor:
        """(M, 3) sums of ``values`` (N, 3)."""
        if values.device.type != "cpu":
            return self.by_index(values)
        if values.dtype not in self._matrices:
            order, indptr, shape = self._structure
            ones = np.ones(len(order), dtype=values.numpy().dtype)
            self._matrices[values.dtype] = sparse.csr_matrix((ones, order, indptr), shape=shape)
        return torch.from_numpy(self._matrices[values.dtype] @ values.numpy())

    def by_index(self, values: Tensor) -> Tensor:
        """The same in torch operations, on any device."""
        self._target = self._target.to(values.device)
        return values.new_zeros(self.size + 1, 3).index_add(0, self._target, values)[:-1]


class BlockPattern:
    """Symmetric sparse matrix of 3 × 3 blocks with a fixed set of non-zero blocks.

    Its numbers are kept as *triples* (R, 3), the three entries of one row of one block, block after block: element
    matrices are summed into them as they come, without reordering.

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
        self.starts = np.concatenate([[0], np.cumsum(np.bincount(self.rows, minlength=size))])
        self.num_triples = 3 * len(self._keys)
        self.diagonal = torch.as_tensor(self.triples(diagonal, diagonal))

    def triples(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """Indices (..., 3) of the triples of the blocks at ``rows``, ``cols`` (...); -1 where either is negative."""
        if self.size == 0:
            return np.full((*rows.shape, 3), -1, dtype=np.int64)
        inside = (rows >= 0) & (cols >= 0)
        row = np.where(inside, rows, 0)
        slot = np.searchsorted(self._keys, row * self.size + np.where(inside, cols, 0))
        return np.where(inside[..., None], 3 * slot[..., None] + np.arange(3), -1)

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

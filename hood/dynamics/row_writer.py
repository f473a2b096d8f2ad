"""Rows of a table in an open HDF5 file, written one by one."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np


class RowWriter:
    """Writes rows of a table: what h5py does for ``table[row] = value``, with the table, its type and its selection kept.

    A rollout writes some forty tables a frame. To look each up and to make its selection again takes longer than to write it.

    Args:
        table: (T, …) of real or whole numbers, in a file that is open for writing.
    """

    def __init__(self, table: h5py.Dataset) -> None:
        self._table, self._kind, self._shape = table.id, table.dtype, table.shape[1:]
        self._selected = table.id.get_space()
        self._one = h5py.h5s.create_simple((1, *self._shape))

    def write(self, row: int, value: Any) -> None:
        """Write the row ``row`` from a number, or numbers of the shape of a row.

        Raises:
            ValueError: numbers of another shape.
            OSError: the file system refuses.
        """
        numbers = np.ascontiguousarray(value, self._kind).reshape(self._shape)
        self._selected.select_hyperslab((row, *(0 for _ in self._shape)), (1, *self._shape))
        self._table.write(self._one, self._selected, numbers)

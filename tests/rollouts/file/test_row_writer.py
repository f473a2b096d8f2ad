"""Rows written one by one are what h5py would have written."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from hood.rollouts.file.step_table import RowWriter

ROWS = 5


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int8, np.int32])
@pytest.mark.parametrize("shape", [(), (4,), (3, 2), (0, 3)])
def test_rows_are_those_of_h5py(tmp_path: Path, kind: type, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        ours, theirs = (file.create_dataset(name, (ROWS, *shape), dtype=kind, fillvalue=-1) for name in ("ours", "theirs"))
        writer = RowWriter(ours)
        for row in (0, 3, 4, 3):
            values = 10.0 * rng.standard_normal(shape)
            writer.write(row, values)
            theirs[row] = values
    with h5py.File(tmp_path / "rows.h5") as file:
        np.testing.assert_array_equal(file["ours"][:], file["theirs"][:])
        assert (file["ours"][1:3] == -1).all()


def test_numbers_of_another_type_and_layout(tmp_path: Path) -> None:
    values = np.arange(12).reshape(4, 3).T  # not contiguous
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        writer = RowWriter(file.create_dataset("table", (ROWS, 3, 4), dtype=np.float32))
        writer.write(2, values)
        flags = RowWriter(file.create_dataset("flag", (ROWS,), dtype=np.int8))
        flags.write(0, True)
        flags.write(1, np.bool_(False))
        np.testing.assert_array_equal(file["table"][2], values)
        assert file["flag"][:2].tolist() == [1, 0]


@pytest.mark.parametrize("shape", [(), (2,), (4,), (3, 2)])
def test_another_shape_is_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        writer = RowWriter(file.create_dataset("table", (ROWS, 3), dtype=np.float32, fillvalue=7.0))
        with pytest.raises(ValueError, match="reshape"):
            writer.write(1, np.zeros(shape))
        assert (file["table"][:] == 7.0).all()


def test_a_row_beyond_the_table_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        writer = RowWriter(file.create_dataset("table", (ROWS,), dtype=np.float32, fillvalue=7.0))
        with pytest.raises((ValueError, OSError)):
            writer.write(ROWS, 1.0)
        assert (file["table"][:] == 7.0).all()

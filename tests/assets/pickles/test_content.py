"""Pickles with arrays of numpy, torch and joblib come out as they were; nothing they name is run."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import os
import pickle
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from motion_kinds.writers import joblib_bytes

from hood.assets.pickles.content import load_content


def content() -> dict[str, Any]:
    objects = np.empty(3, dtype=object)
    objects[:] = ["a", None, np.arange(2.0)]
    return {
        "floats": np.arange(6.0).reshape(2, 3), "halves": np.ones(3, np.float16), "big": np.arange(3, dtype=">i4"),
        "scalar": np.array(4.0), "empty": np.zeros((0, 3)), "objects": objects, "text": "walk", "list": [np.zeros(2), 3],
    }  # fmt: skip


def same(found: Any, wanted: Any) -> None:
    assert type(found) is type(wanted)
    if isinstance(wanted, dict):
        assert list(found) == list(wanted)
        found, wanted = list(found.values()), list(wanted.values())
    if isinstance(wanted, list) or (isinstance(wanted, np.ndarray) and wanted.dtype == object):
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted, strict=True):
            same(one, other)
    elif isinstance(wanted, np.ndarray):
        assert found.dtype == wanted.dtype.newbyteorder("=")
        np.testing.assert_array_equal(found, wanted)
    else:
        assert found == wanted


def alone(raw: bytes) -> bytes:
    return lzma.compress(raw, format=lzma.FORMAT_ALONE)


@pytest.mark.parametrize("pack", [bytes, zlib.compress, gzip.compress, bz2.compress, lzma.compress, alone])
def test_files_of_joblib(pack: Callable[[bytes], bytes], tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(pack(joblib_bytes(content())))
    same(load_content(path), content())


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_tensors_in_plain_pickles(protocol: int, tmp_path: Path) -> None:
    table = torch.arange(12.0).reshape(3, 4)
    tensors = {"table": table, "part": table[1:, ::2], "whole": torch.arange(3), "parameter": torch.nn.Parameter(torch.ones(2))}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(tensors, protocol))
    found = load_content(tmp_path / "a.pkl")
    for key, value in tensors.items():
        assert torch.equal(found[key], value), key


def test_nothing_is_run(tmp_path: Path) -> None:
    class Harmful:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.system, ("false",)

    path = tmp_path / "a.pkl"
    for raw in (pickle.dumps({"a": Harmful()}), zlib.compress(pickle.dumps(Harmful()))):
        path.write_bytes(raw)
        with pytest.raises(ValueError, match=r"names (posix|nt)\.system, which is not read"):
            load_content(path)


@pytest.mark.parametrize("cut", [3, 40, 200, -1])
def test_files_that_are_cut_off(cut: int, tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    for raw in (joblib_bytes(content()), zlib.compress(joblib_bytes(content()))):
        path.write_bytes(raw[:cut])
        with pytest.raises(ValueError, match=r"a\.pkl: (not a readable pickle|is cut off)"):
            load_content(path)


def test_what_unpacks_to_more_than_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    buffer = io.BytesIO()
    pickle.dump({"a": np.zeros(100_000)}, buffer)
    path.write_bytes(zlib.compress(buffer.getvalue()))
    with pytest.raises(ValueError, match="unpacks to more than 50000 bytes"):
        load_content(path, 50_000)

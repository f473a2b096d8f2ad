"""Contents written as files: numpy's, torch's, pickles of both protocols, and joblib's without joblib."""

from __future__ import annotations

import io
import pickle
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch


def write(path: Path, content: Any) -> Path:
    """``content`` in the format that the file's name says; ``.jl.pkl`` and ``.jlz.pkl`` are joblib's, plain and compressed."""
    if path.name.endswith(".npz"):
        np.savez(path, **content)
    elif path.name.endswith(".npy"):
        np.save(path, content, allow_pickle=True)
    elif path.name.endswith(".pt"):
        torch.save(content, path)
    elif path.name.endswith((".jl.pkl", ".jlz.pkl")):
        raw = joblib_bytes(content)
        path.write_bytes(zlib.compress(raw) if ".jlz" in path.name else raw)
    else:
        path.write_bytes(pickle.dumps(content, 2 if path.name.endswith(".py2.pkl") else 4))
    return path


class NumpyArrayWrapper:
    """Joblib's: an array whose bytes stand behind it in the file."""

    def __init__(self, array: np.ndarray) -> None:
        self.subclass, self.shape, self.dtype = np.ndarray, array.shape, array.dtype
        self.order, self.allow_mmap, self.numpy_array_alignment_bytes = "C", True, 16


NumpyArrayWrapper.__module__ = "joblib.numpy_pickle"


class _JoblibPickler(pickle._Pickler):  # type: ignore[name-defined,misc]
    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=4)
        self.file = file

    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if type(obj) is not np.ndarray:
            super().save(obj, save_persistent_id)
            return
        super().save(NumpyArrayWrapper(obj))
        self.framer.commit_frame(force=True)
        if obj.dtype.hasobject:
            self.file.write(pickle.dumps(obj, 4))
            return
        padding = 16 - (self.file.tell() + 1) % 16
        self.file.write(bytes([padding]) + b"\xff" * padding + np.ascontiguousarray(obj).tobytes())

    def save_global(self, obj: Any, name: str | None = None) -> None:
        if obj is NumpyArrayWrapper:  # joblib is not installed here: its name is written without a look
            self.write(pickle.GLOBAL + b"joblib.numpy_pickle\nNumpyArrayWrapper\n")
            self.memoize(obj)
        else:
            super().save_global(obj, name)

    dispatch = {**pickle._Pickler.dispatch, type: save_global}  # type: ignore[attr-defined]


def joblib_bytes(content: Any) -> bytes:
    """What ``joblib.dump`` writes."""
    buffer = io.BytesIO()
    _JoblibPickler(buffer).dump(content)
    return buffer.getvalue()

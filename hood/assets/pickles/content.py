"""The content of pickles that hold arrays in any of the usual ways: numpy's, torch's inside a plain pickle, joblib's.

Like every pickle here they are read by :class:`hood.assets.pickles.unpickle.RestrictedUnpickler`: nothing they name is run.
"""

from __future__ import annotations

import bz2
import io
import lzma
import pickle
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

from hood.assets.files.guarded import Refused, check_size, guarded
from hood.assets.pickles.records import Function, Record, read_raw_array, resolve
from hood.assets.pickles.torch_file import TorchUnpickler, read_torch_stream
from hood.assets.pickles.unpickle import PICKLE_LIMIT, Bounded

#: Packages whose objects lie beside the arrays as settings; their content is not kept.
_BESIDES = ("omegaconf", "pathlib", "typing", "datetime", "easydict", "yacs", "munch")
#: First bytes of files that are compressed as a whole, as joblib writes them with ``compress``, and what unpacks them.
_COMPRESSED: dict[bytes, Callable[[], Any]] = {
    b"\x78": lambda: zlib.decompressobj(wbits=15),
    b"\x1f\x8b": lambda: zlib.decompressobj(wbits=31),
    b"BZh": bz2.BZ2Decompressor,
    b"\xfd7zXZ": lzma.LZMADecompressor,
    b"]\x00\x00": lzma.LZMADecompressor,
}


def load_content(path: str | Path, size_limit: int = PICKLE_LIMIT) -> Any:
    """The content of a pickle file: containers, numbers, text, arrays of numpy, tensors of torch; also as joblib writes it.

    Raises:
        FileNotFoundError: no such file.
        ValueError: larger than ``size_limit`` [bytes], damaged, or naming a class; the message holds ``module.name``.
    """
    path = check_size(path, size_limit)
    with open(path, "rb") as file:
        return guarded(path, "pickle", lambda: unpickle(_unpacked(file, size_limit)))


def unpickle(file: BinaryIO | io.BytesIO | Bounded) -> Any:
    """What the next pickle in ``file`` holds.

    Raises:
        Refused, pickle.UnpicklingError and what broken bytes raise.
    """
    return resolve(_ContentUnpickler(file).load())


class _JoblibArray(Record):
    """``joblib.numpy_pickle.NumpyArrayWrapper``: the bytes of the array stand behind it in the file."""

    path = "joblib.numpy_pickle.NumpyArrayWrapper"
    array: Any = None

    def value(self, seen: dict[int, Any]) -> Any:
        return self.array


def _load_build(unpickler: Any) -> None:
    pickle._Unpickler.load_build(unpickler)  # type: ignore[attr-defined]
    if isinstance(unpickler.stack[-1], _JoblibArray):
        unpickler.read_behind(unpickler.stack[-1])


class _ContentUnpickler(TorchUnpickler):
    inert = _BESIDES
    dispatch: ClassVar[dict[int, Any]] = {**TorchUnpickler.dispatch, pickle.BUILD[0]: _load_build}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("torch.storage", "_load_from_bytes"):
            return Function(_tensor_bytes)
        if (module, name) == ("joblib.numpy_pickle", "NumpyArrayWrapper"):
            return _JoblibArray
        return super().find_class(module, name)

    def read_behind(self, record: _JoblibArray) -> None:
        """Give ``record`` the array that stands behind it."""
        state = record.state
        if not isinstance(state, dict) or not {"shape", "order", "dtype"} <= set(state):
            raise Refused("an array of joblib without its shape; the file is damaged")
        dtype = resolve(state["dtype"])
        if dtype.hasobject:
            record.array = unpickle(self.bounded)
        else:
            if state.get("numpy_array_alignment_bytes") is not None:
                self.bounded.read(self.bounded.read(1)[0])
            record.array = read_raw_array(self.bounded.read, dtype, state["shape"], str(state["order"]))


def _tensor_bytes(content: Any) -> Any:
    """A storage of torch that a plain pickle holds as the bytes of a file of its own."""
    if not isinstance(content, (bytes, bytearray)):
        raise Refused("a tensor without its bytes; the file is damaged")
    return read_torch_stream(io.BytesIO(content), len(content))


def _unpacked(file: BinaryIO, size_limit: int) -> BinaryIO | io.BytesIO:
    """The file, unpacked where it is compressed as a whole."""
    head = file.read(5)
    file.seek(0)
    make = next((make for start, make in _COMPRESSED.items() if head.startswith(start)), None)
    if make is None:
        return file
    unpacker = make()
    content = unpacker.decompress(file.read(), size_limit)
    if not unpacker.eof:
        raise Refused(f"is cut off, or unpacks to more than {size_limit} bytes")
    return io.BytesIO(content)

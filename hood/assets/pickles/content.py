"""The content of pickles that hold arrays in any of the usual ways: numpy's, torch's, joblib's, and files of ``torch.save``.

Like every pickle here they are read by :class:`hood.assets.pickles.records.RestrictedUnpickler`: nothing they name is run.
``torch.load(weights_only=True)`` refuses a whole file for one configuration object in it; here such objects become
opaque records and the weights beside them can be read.
"""

from __future__ import annotations

import bz2
import io
import lzma
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import torch
from torch import Tensor

from hood.assets.files.guarded import Refused, check_size, guarded
from hood.assets.pickles.records import PICKLE_LIMIT, Bounded, Function, Record, RestrictedUnpickler, read_raw_array, resolve

#: Packages whose objects checkpoints carry beside the weights: configurations, and the classes they describe. Only their
#: names are kept; none of them is imported.
_INERT = ("omegaconf", "hydra", "typing", "pathlib", "runners", "models", "datasets", "criterions", "utils")
_MAGIC = 0x1950A86A20F9469CFC6C  # first pickle of a file in the older format
_DTYPES = {
    "FloatStorage": torch.float32, "DoubleStorage": torch.float64, "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16, "LongStorage": torch.int64, "IntStorage": torch.int32,
    "ShortStorage": torch.int16, "CharStorage": torch.int8, "ByteStorage": torch.uint8, "BoolStorage": torch.bool,
    "UntypedStorage": torch.uint8,
}  # fmt: skip
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


def load_torch(path: str | Path, size_limit: int = PICKLE_LIMIT) -> Any:
    """The content of a torch file (zip archive, or the older stream of pickles), tensors on the CPU.

    Raises:
        FileNotFoundError: no such file.
        ValueError: larger than ``size_limit`` [bytes], damaged, a TorchScript archive, or naming a class outside the
            list; the message holds ``module.name``.
    """
    path = check_size(path, size_limit)
    with open(path, "rb") as file:
        return guarded(path, "torch file", lambda: resolve(_read(file, size_limit)))


class _StorageType:
    """Stands for ``torch.FloatStorage`` and its like."""

    __slots__ = ("dtype",)

    def __init__(self, dtype: torch.dtype) -> None:
        self.dtype = dtype

    def __setstate__(self, state: Any) -> None:
        raise Refused("sets the state of a storage type; the file is damaged or harmful")


class TorchUnpickler(RestrictedUnpickler):
    """Unpickler of tensors; ``storage`` gives the flat tensor of a storage that the pickle refers to."""

    inert: tuple[str, ...] = _INERT

    def __init__(self, file: BinaryIO | io.BytesIO | Bounded, storage: Callable[..., Tensor] | None = None) -> None:
        super().__init__(file)
        self._storage = storage

    def find_class(self, module: str, name: str) -> Any:
        if module in ("torch", "torch.storage", "torch.cuda") and name in _DTYPES:
            return _StorageType(_DTYPES[name])
        if module == "torch" and isinstance(getattr(torch, name, None), torch.dtype):
            return getattr(torch, name)
        return _FUNCTIONS.get((module, name)) or super().find_class(module, name)

    def persistent_load(self, saved: Any) -> Tensor:
        """A storage as a flat tensor."""
        known = isinstance(saved, tuple) and len(saved) >= 5 and saved[0] == "storage" and isinstance(saved[1], _StorageType)
        if self._storage is None or not known:
            raise Refused(f"refers to {str(saved)[:60]!r}, which is not a tensor storage; the file is damaged")
        return self._storage(saved[1].dtype, *saved[2:])


def _rebuild(storage: Tensor, offset: int, size: tuple, stride: tuple, *rest: Any) -> Tensor:
    """A view of a storage; torch checks that it stays inside. ``rest``: flags for autograd, hooks."""
    return storage.as_strided(tuple(size), tuple(stride), int(offset))


def _rebuild_untyped(storage: Tensor, offset: int, size: tuple, stride: tuple, *rest: Any) -> Tensor:
    dtype = next(item for item in rest if isinstance(item, torch.dtype))
    return _rebuild(storage.view(dtype), offset, size, stride)


def _first(value: Any, *rest: Any) -> Any:
    return value


_FUNCTIONS: dict[tuple[str, str], Any] = {
    ("torch._utils", "_rebuild_tensor"): Function(_rebuild),
    ("torch._utils", "_rebuild_tensor_v2"): Function(_rebuild),
    ("torch._utils", "_rebuild_tensor_v3"): Function(_rebuild_untyped),
    ("torch._utils", "_rebuild_parameter"): Function(_first),
    ("torch", "Size"): tuple,
    ("torch", "device"): Function(_first),
}


def _read(file: BinaryIO, size_limit: int) -> Any:
    read = _read_zip if zipfile.is_zipfile(file) else read_torch_stream
    file.seek(0)
    return read(file, size_limit)


def _read_zip(file: BinaryIO, size_limit: int) -> Any:
    with zipfile.ZipFile(file) as archive:
        sizes = {info.filename: info.file_size for info in archive.infolist()}
        if sum(sizes.values()) > size_limit:
            raise Refused(f"unpacks to {sum(sizes.values())} bytes, the limit is {size_limit}")
        root = next((name.removesuffix("data.pkl") for name in sizes if name.split("/")[-1] == "data.pkl"), None)
        if root is None or root + "constants.pkl" in sizes:
            raise Refused("a zip archive without a state dict; give a file written by torch.save")
        if root + "byteorder" in sizes and archive.read(root + "byteorder") != b"little":
            raise Refused("tensors in big-endian order; save the file again on this machine")
        loaded: dict[str, Tensor] = {}

        def storage(dtype: torch.dtype, key: Any, location: Any, count: int) -> Tensor:
            if key not in loaded:
                loaded[key] = _flat(bytearray(archive.read(f"{root}data/{key}")), dtype, count)
            return loaded[key]

        return TorchUnpickler(io.BytesIO(archive.read(root + "data.pkl")), storage).load()


def read_torch_stream(file: BinaryIO | io.BytesIO, size_limit: int) -> Any:
    """The older format, of at most ``size_limit`` bytes: magic number, version, platform, object, storage keys, storages;
    contents come last."""
    if TorchUnpickler(file).load() != _MAGIC:
        raise Refused("not written by torch.save")
    TorchUnpickler(file).load()
    if not TorchUnpickler(file).load().get("little_endian", True):
        raise Refused("tensors in big-endian order; save the file again on this machine")
    buffers: dict[str, tuple[bytearray, Tensor]] = {}
    total = 0
    place = file.tell()
    size_limit = min(size_limit, file.seek(0, os.SEEK_END))  # no storage is larger than the file it is in
    file.seek(place)

    def storage(dtype: torch.dtype, key: Any, location: Any, count: int, view: Any = None) -> Tensor:
        nonlocal total
        if key not in buffers:
            total += count * dtype.itemsize
            if not 0 <= total <= size_limit:
                raise Refused(f"asks for {total} bytes, the limit is {size_limit}")
            buffer = bytearray(count * dtype.itemsize)
            buffers[key] = (buffer, _flat(buffer, dtype, count))
        flat = buffers[key][1]
        return flat if view is None else flat[view[1] : view[1] + view[2]]

    content = TorchUnpickler(file, storage).load()
    for key in TorchUnpickler(file).load():
        buffer, flat = buffers[key]
        (count,) = struct.unpack("<q", file.read(8))
        if count != len(flat) or file.readinto(buffer) != len(buffer):  # type: ignore[union-attr]
            raise Refused(f"storage {key} is cut off; copy the file again")
    return content


def _flat(buffer: bytearray, dtype: torch.dtype, count: int) -> Tensor:
    if len(buffer) != count * dtype.itemsize:
        raise Refused(f"a storage of {count} {dtype} values has {len(buffer)} bytes; the file is damaged")
    return torch.frombuffer(buffer, dtype=dtype) if count else torch.empty(0, dtype=dtype)


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

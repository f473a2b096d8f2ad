"""Pickles from elsewhere, read without running anything they name.

A pickle may name any importable function and have it called. Here nothing is imported: every name is looked up in a list of
inert stand-ins that record what they are given; numpy arrays, sparse matrices or nothing are made from the records afterwards.
Names outside the list are refused.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import re
import struct
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np
from scipy import sparse

from hood.assets.files.guarded import Refused, check_size, guarded

_ENCODINGS = ("latin1", "latin-1", "ascii", "utf-8", "utf8")


def stand_in(module: str, name: str) -> Any:
    """What stands for ``module.name`` of plain Python, numpy, scipy.sparse and chumpy; None where nothing does."""
    found = _NAMES.get((module.replace("numpy._core", "numpy.core"), name))
    if found is not None:
        return found
    if module.split(".")[0] == "chumpy" and name in ("Ch", "Select"):
        return type("_Chumpy", (_Chumpy,), {"path": name})
    if re.fullmatch(r"scipy\.sparse(\.\w+)?", module) and re.fullmatch(r"(csc|csr|coo|bsr)_(matrix|array)", name):
        return type("_Sparse", (_Sparse,), {"path": name})
    return None


class Record:
    """Stand-in for a foreign object: keeps what the pickle gives it, runs nothing."""

    path = ""

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def value(self, seen: dict[int, Any]) -> Any:
        """What the record stands for; ``seen`` as in :func:`resolve`."""
        raise NotImplementedError


class Opaque(Record):
    """An object of which only the class name is known, such as the configuration inside a checkpoint."""

    def value(self, seen: dict[int, Any]) -> Any:
        return self

    def append(self, item: Any) -> None:
        """Items of foreign lists are passed over."""

    def extend(self, items: Any) -> None:
        """Items of foreign lists are passed over."""

    def __setitem__(self, key: Any, item: Any) -> None:
        """Items of foreign mappings are passed over."""

    def __repr__(self) -> str:
        return f"<{self.path}>"


def opaque(path: str) -> type[Opaque]:
    """A new class of records named ``path``."""
    return type("Opaque", (Opaque,), {"path": path})


class Function:
    """A function that a pickle may call and cannot change."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        self._call = call

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise Refused("sets the state of a function; the file is damaged or harmful")


def resolve(item: Any, seen: dict[int, Any] | None = None) -> Any:
    """``item`` with records inside plain containers replaced by their values."""
    seen = {} if seen is None else seen
    if id(item) in seen:
        return seen[id(item)][1]
    # The pair keeps the original alive, so that its id is not given away while the walk goes on.
    if isinstance(item, dict):
        seen[id(item)] = (item, item)
        for key in list(item):
            item[key] = resolve(item[key], seen)
        return item
    if isinstance(item, list):
        seen[id(item)] = (item, item)
        item[:] = [resolve(entry, seen) for entry in item]
        return item
    if isinstance(item, tuple):
        result: Any = tuple(resolve(entry, seen) for entry in item)
    elif isinstance(item, Record):
        result = item.value(seen)
    else:
        return item
    seen[id(item)] = (item, result)
    return result


# ---- numpy -----------------------------------------------------------------------------------------------------------


class _Dtype(Record):
    def value(self, seen: dict[int, Any]) -> np.dtype:
        text = self.arguments[0] if self.arguments else None
        if not isinstance(text, str) or not re.fullmatch(r"[|<>=]?([biufcSUO]\d*|\?)", text):
            raise Refused(f"numpy dtype {text!r} is not read: only numbers, text and objects are")
        order = self.state[1] if isinstance(self.state, tuple) and len(self.state) > 1 else "="
        dtype = np.dtype(text)
        return dtype.newbyteorder(">") if order in (">", b">") else dtype


class _Array(Record):
    """``numpy.ndarray``; its state is (version, shape, dtype, column-major, content)."""

    def value(self, seen: dict[int, Any]) -> np.ndarray:
        if self.state is None:
            raise Refused("numpy.ndarray without content; the file is damaged")
        _, shape, dtype, column_major, content = self.state
        return _array(content, dtype, shape, "F" if column_major else "C", seen)


def _array(content: Any, dtype: Any, shape: Any, order: str = "C", seen: dict[int, Any] | None = None) -> np.ndarray:
    seen = {} if seen is None else seen
    kind = dtype.value(seen)
    count = math.prod(int(n) for n in shape)
    if kind.hasobject:
        if not isinstance(content, list) or len(content) != count:
            raise Refused("numpy.ndarray of objects without its list; the file is damaged")
        flat = np.empty(count, dtype=object)
        for index, entry in enumerate(content):
            flat[index] = resolve(entry, seen)
    else:
        raw = content.encode("latin1") if isinstance(content, str) else bytes(content)
        if len(raw) != count * kind.itemsize:
            raise Refused(f"numpy.ndarray of {count} {kind} values with {len(raw)} bytes; the file is damaged")
        flat = np.frombuffer(raw, dtype=kind).astype(kind.newbyteorder("="), copy=True)
    return flat.reshape(tuple(int(n) for n in shape), order="F" if order == "F" else "C")


def read_raw_array(read: Callable[[int], bytes], dtype: np.dtype, shape: Any, order: str) -> np.ndarray:
    """The array of ``shape`` whose numbers ``read`` gives next, column by column where ``order`` is "F"."""
    sizes = tuple(int(n) for n in shape)
    if any(n < 0 for n in sizes):
        raise Refused(f"an array of shape {sizes}; the file is damaged")
    raw = np.frombuffer(read(math.prod(sizes) * dtype.itemsize), dtype=dtype)
    flat = raw.astype(dtype.newbyteorder("="), copy=True)
    return flat.reshape(sizes, order="F" if order == "F" else "C")


def _scalar(dtype: Any, content: Any = b"") -> Any:
    return _array(content, dtype, ())[()]


def _frombuffer(content: Any, dtype: Any, shape: Any, order: str) -> np.ndarray:
    return _array(content, dtype, shape, order)


# ---- scipy and chumpy ------------------------------------------------------------------------------------------------


def _fields(record: Record) -> dict[str, Any]:
    if not isinstance(record.state, dict):
        raise Refused(f"{record.path} without fields; the file is damaged")
    return record.state


class _Sparse(Record):
    def value(self, seen: dict[int, Any]) -> Any:
        fields = {key: resolve(value, seen) for key, value in _fields(self).items()}
        shape = fields.get("_shape", fields.get("shape"))
        kind = self.path[:3]
        make = getattr(sparse, f"{kind}_matrix")
        if kind == "coo":
            row, col = fields["coords"] if "coords" in fields else (fields["row"], fields["col"])
            return make((fields["data"], (row, col)), shape=shape)
        matrix = make((fields["data"], fields["indices"], fields["indptr"]), shape=shape)
        matrix.check_format(full_check=True)  # compiled code trusts the indices
        return matrix


class _Chumpy(Record):
    """``Ch`` holds its array as ``x``; ``Select`` holds entries ``idxs`` of another, as ``preferred_shape``."""

    def value(self, seen: dict[int, Any]) -> np.ndarray:
        fields = _fields(self)
        if self.path == "Ch":
            return np.asarray(resolve(fields["x"], seen))
        chosen = np.asarray(resolve(fields["a"], seen)).ravel()[np.asarray(resolve(fields["idxs"], seen))]
        shape = resolve(fields.get("preferred_shape"), seen)
        return chosen if shape is None else chosen.reshape(tuple(int(n) for n in shape))


# ---- plain Python ----------------------------------------------------------------------------------------------------


def _bytes(kind: type) -> Callable[..., Any]:
    def make(content: Any = b"", encoding: str = "latin1") -> Any:
        if isinstance(content, str):
            return kind(_encode(content, encoding))
        if not isinstance(content, (bytes, bytearray, list)):  # a number would ask for that much memory
            raise Refused(f"builtins.{kind.__name__} of {type(content).__name__} is not read")
        return kind(content)

    return make


def _encode(text: str, encoding: str = "latin1") -> bytes:
    if encoding not in _ENCODINGS:
        raise Refused(f"_codecs.encode to {encoding!r} is not read")
    return text.encode(encoding)


def _reconstructor(kind: Any, base: Any, state: Any) -> Any:
    if not (isinstance(kind, type) and issubclass(kind, Record)):
        raise Refused("copyreg._reconstructor of a plain class is not read")
    return kind()


def _new_array(*arguments: Any) -> _Array:
    return _Array()


def _plain_dict(*arguments: Any) -> dict:
    return dict(arguments[-1]) if arguments and isinstance(arguments[-1], dict) else {}


#: Stand-ins by name.
_NAMES: dict[tuple[str, str], Any] = {
    **{("builtins", kind.__name__): kind for kind in (dict, list, set, frozenset, tuple, str, int, float, bool, complex)},
    ("builtins", "object"): object,
    ("builtins", "unicode"): str,
    ("builtins", "long"): int,
    ("builtins", "bytes"): Function(_bytes(bytes)),
    ("builtins", "bytearray"): Function(_bytes(bytearray)),
    ("_codecs", "encode"): Function(_encode),
    ("copyreg", "_reconstructor"): Function(_reconstructor),
    ("collections", "OrderedDict"): OrderedDict,
    ("collections", "defaultdict"): Function(_plain_dict),
    ("collections", "Counter"): Function(_plain_dict),
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("numpy.core.multiarray", "_reconstruct"): Function(_new_array),
    ("numpy.core.multiarray", "scalar"): Function(_scalar),
    ("numpy.core.numeric", "_frombuffer"): Function(_frombuffer),
}


#: Files beyond this size [bytes] are not opened.
PICKLE_LIMIT = 4 << 30
#: Modules that had another name in Python 2.
_RENAMED = {"__builtin__": "builtins", "copy_reg": "copyreg"}


def load_pickle(path: str | Path, size_limit: int = PICKLE_LIMIT) -> Any:
    """The content of a pickle file: containers, numbers, text, numpy arrays, scipy.sparse matrices; arrays of the
    abandoned package chumpy become numpy arrays. Text of Python 2 is read as latin-1.

    Raises:
        FileNotFoundError: no such file.
        ValueError: larger than ``size_limit`` [bytes], damaged, or naming anything else; the message holds
            ``module.name``.
    """
    path = check_size(path, size_limit)
    with open(path, "rb") as file:
        return guarded(path, "pickle", lambda: resolve(RestrictedUnpickler(file).load()))


def _load_bytearray(unpickler: Any) -> None:
    """Bytes that can be written into. Python's own makes room for as many as are announced before it looks for them."""
    (count,) = struct.unpack("<Q", unpickler.read(8))
    unpickler.append(bytearray(unpickler.read(count)))


class RestrictedUnpickler(pickle._Unpickler):  # type: ignore[name-defined,misc]
    """Unpickler whose names lead to stand-ins. ``inert`` lists packages whose classes become :class:`Opaque`.

    Python's own, not the one in C: that one makes room for as many bytes or notes as a damaged length claims, before it
    reads them. Arrays are single entries of a pickle, so that little time is lost.
    """

    inert: tuple[str, ...] = ()
    #: What is done for each code of a pickle.
    dispatch: ClassVar[dict[int, Any]] = {
        **pickle._Unpickler.dispatch,  # type: ignore[attr-defined]
        pickle.BYTEARRAY8[0]: _load_bytearray,
    }

    def __init__(self, file: BinaryIO | io.BytesIO | Bounded) -> None:
        #: The file, from where it is now; what stands behind the pickle can be read from it.
        self.bounded = file if isinstance(file, Bounded) else Bounded(file)
        super().__init__(self.bounded, encoding="latin1")

    def find_class(self, module: str, name: str) -> Any:
        """The stand-in for ``module.name``.

        Raises:
            Refused: there is none.
        """
        module = _RENAMED.get(module, module)
        found = stand_in(module, name)
        if found is not None:
            return found
        if module.split(".")[0] in self.inert:
            return opaque(f"{module}.{name}")
        shown = "".join(letter if letter.isprintable() else "?" for letter in f"{module}.{name}"[:200])
        raise Refused(
            f"names {shown}, which is not read: only numbers, text, containers, arrays and sparse matrices are "
            "(a file that needs it may be harmful; convert it where it was made)"
        )


class Bounded:
    """A file that is never asked for more than it holds."""

    def __init__(self, file: BinaryIO | io.BytesIO) -> None:
        place = file.tell()
        self._left = file.seek(0, os.SEEK_END) - place
        file.seek(place)
        self._file = file

    def read(self, count: int) -> bytes:
        """``count`` bytes.

        Raises:
            EOFError: there are fewer.
        """
        if not 0 <= count <= self._left:
            raise EOFError(f"it announces {count} more bytes and {self._left} are left")
        self._left -= count
        return self._file.read(count)

    def readline(self) -> bytes:
        """Bytes up to the next line end."""
        line = self._file.readline()
        self._left -= len(line)
        return line

    def readinto(self, buffer: bytearray) -> int:
        """Fill ``buffer``."""
        content = self.read(len(buffer))
        buffer[:] = content
        return len(content)

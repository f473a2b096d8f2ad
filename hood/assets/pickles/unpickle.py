"""Pickles from elsewhere, read without running anything they name.

A pickle may name any importable function and have it called. Here nothing is imported: every name is looked up in a
list of inert stand-ins that record what they are given, and arrays are made from the records afterwards. Names outside
the list are refused.
"""

from __future__ import annotations

import io
import os
import pickle
import struct
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

from hood.assets.files.guarded import Refused, check_size, guarded
from hood.assets.pickles.records import opaque, resolve, stand_in

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

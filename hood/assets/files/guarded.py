"""Size limits for files, and one kind of error for files that cannot be read.

HDF5 datasets that lie in their own file; links to other files of the machine are refused.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import h5py


class Refused(pickle.UnpicklingError):
    """A name or a value that is not read; the message starts with it."""


#: Characters of another library's message that are passed on; some quote the file.
_REASON = 300
#: And of a name that a file holds.
_NAME = 40


def first_line(error: Exception) -> str:
    """What an error says, in one line that is not too long."""
    said = str(error).splitlines()[0] if str(error) else type(error).__name__
    return said if len(said) <= _REASON else f"{said[:_REASON]} …"


def listed(names: Iterable[str], most: int = 8) -> str:
    """Names out of a file in one line that can be printed, whatever a damaged file holds: at most so many, each cut off."""
    every = list(names)
    shown = ["".join(c if c.isprintable() else "?" for c in name[: _NAME + 1]) for name in every[:most]]
    cut = [name if len(name) <= _NAME else f"{name[:_NAME]}…" for name in shown]
    return (", ".join(cut) + (" …" if len(every) > most else "")) or "(none)"


def check_size(path: str | Path, size_limit: int) -> Path:
    """The path of an existing file that is not larger than ``size_limit`` [bytes]."""
    path = Path(path).expanduser()
    size = os.stat(path).st_size
    if size > size_limit:
        raise ValueError(f"{path}: {size} bytes, the limit is {size_limit}; raise size_limit if you trust the file")
    return path


def guarded(path: Path, what: str, read: Callable[[], Any]) -> Any:
    """``read()`` with everything that broken bytes can raise turned into one ValueError that names the file."""
    try:
        return read()
    except Refused as error:
        raise ValueError(f"{path}: {error}") from error
    except (MemoryError, RecursionError) as error:
        raise ValueError(unreadable(path, what, f"{type(error).__name__} while reading it")) from error
    except Exception as error:
        raise ValueError(unreadable(path, what, first_line(error))) from error


def unreadable(path: str | Path, what: str, reason: str) -> str:
    """The sentence for a file that is not, or no longer, a ``what``; an empty file is called so."""
    empty = Path(path).is_file() and not os.stat(path).st_size
    return f"{path}: not a readable {what} ({'it is empty' if empty else reason}); write or download the file again"


def own_group(file: h5py.File, key: str) -> h5py.Group | None:
    """The group ``key`` that lies in this file; None where there is none.

    Raises:
        ValueError: it lies elsewhere.
    """
    if file.get(key, getlink=True) is None:
        return None
    place = _follow(file, key)
    if not isinstance(place, h5py.Group):
        raise ValueError(f"{key} is no group of tables")
    return place


def own_dataset(file: h5py.File, key: str) -> h5py.Dataset:
    """The table ``key`` that lies in this file.

    Raises:
        ValueError: it lies elsewhere.
        KeyError: there is none.
    """
    place = _follow(file, key)
    if not isinstance(place, h5py.Dataset) or place.external or place.is_virtual:
        raise ValueError(f"{key} is not a dataset of its own; store the data itself")
    return place


def _follow(file: h5py.File, key: str) -> Any:
    place: Any = file
    for name in key.split("/"):
        link = place.get(name, getlink=True) if isinstance(place, h5py.Group) else None
        if link is None:
            raise KeyError(f"{key} is missing")
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"{key} is a link to another place; store the data itself")
        place = place[name]
    return place

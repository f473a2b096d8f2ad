"""Size limits for files, and one kind of error for files that cannot be read."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any


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

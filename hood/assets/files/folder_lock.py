"""Locks on output folders: one run at a time writes into a folder."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: Seconds in which a folder is tried to be held, and between two attempts: somebody may just be looking whether it is held.
_PATIENCE, _PAUSE = 0.1, 0.02


class OccupiedError(ValueError):
    """Another process writes into the folder."""


@contextmanager
def occupy(folder: Path, patience: float = _PATIENCE) -> Iterator[None]:
    """Hold an existing folder for this process. The system gives it back when the process ends, however it ends.

    Where the file system knows no locks of folders (many network disks), nothing is held and nothing refused. Another process
    is waited for, for ``patience`` seconds.

    Raises:
        OccupiedError: another process holds it.
    """
    descriptor = _open(folder)
    try:
        if descriptor is not None and not _hold(descriptor, patience):
            raise OccupiedError(f"{folder}: another run is writing there; wait for its end or choose another output")
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def is_occupied(folder: Path) -> bool:
    """Whether a process holds the folder at this moment; False where that cannot be known."""
    descriptor = _open(folder)
    if descriptor is None:
        return False
    try:
        return not _lock(descriptor, shared=True)
    finally:
        os.close(descriptor)


def _open(folder: Path) -> int | None:
    """The folder itself is locked: a lock file would have to be made, kept and cleaned away."""
    if sys.platform == "win32":
        return None
    try:
        return os.open(folder, os.O_RDONLY)
    except OSError:
        return None


def _hold(descriptor: int, patience: float) -> bool:
    end = time.monotonic() + patience
    while not _lock(descriptor, shared=False):
        if time.monotonic() > end:
            return False
        time.sleep(_PAUSE)
    return True


def _lock(descriptor: int, shared: bool) -> bool:
    """Lock what is open here, which closing it gives back; False: somebody else has it."""
    if sys.platform == "win32":
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True

"""Atomic file writes: a reader finds the old file or the whole new one.

Locks on output folders: one run at a time writes into a folder.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def write_atomically(path: Path, content: bytes, keep: Path | None = None) -> None:
    """Replace ``path`` by ``content``, which is complete on disk before it takes the name.

    A kill or a full disk at any moment leaves the old file; ``keep`` names a place where the old one stays afterwards too.

    Raises:
        OSError: it cannot be written; the error names ``path``.
    """
    temporary = path.with_name(path.name + ".partial")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if keep is not None and path.exists():
            _keep(path, keep)
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def _keep(path: Path, keep: Path) -> None:
    """Give the file at ``path`` the second name ``keep``, so that no moment is without a file at ``path``."""
    link = keep.with_name(keep.name + ".partial")
    link.unlink(missing_ok=True)
    try:
        os.link(path, link)
    except OSError:
        os.replace(path, keep)  # a file system without hard links
        return
    os.replace(link, keep)
    link.unlink(missing_ok=True)  # renaming one name of a file onto another of its names does nothing


def _sync_folder(folder: Path) -> None:
    """Make the new name itself durable, where folders can be synchronised."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        pass
    finally:
        os.close(descriptor)


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

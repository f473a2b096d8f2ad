"""Atomic file writes: a reader finds the old file or the whole new one."""

from __future__ import annotations

import os
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

"""What a plan was made for: its words and the content of the files that they name, as one number."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from hood.assets.files.library import locate
from hood.config import load_config

#: Words of these keys name files whose content decides.
_FILES = ("garment", "sequence", "body", "checkpoint", "pins", "refine_table")
#: Of larger files [bytes] the size alone is looked at.
_LARGE = 1 << 26


def content_digest(words: Sequence[str]) -> str:
    """Of the words of a rollout, and of the files in them.

    Raises:
        ConfigError: words that are none.
    """
    said = hashlib.sha256("\0".join(sorted(words)).encode())
    config = load_config("rollout", words)
    for key in _FILES:
        for name in config[key] if isinstance(config[key], Sequence) and not isinstance(config[key], str) else [config[key]]:
            said.update(f"\0{key}".encode())
            for part in _content_of(key, str(name)):
                said.update(part)
    return said.hexdigest()


def _content_of(key: str, name: str) -> Iterator[bytes]:
    """Of the files that a value names; nothing where it is something else."""
    path = Path(name).expanduser()
    if path.is_dir():
        for file in sorted(Path(folder) / name for folder, _, files in os.walk(path) for name in files):
            yield str(file.relative_to(path)).encode()
            yield _content(file)
        return
    kind = {"garment": "garments", "sequence": "motions", "body": "body", "checkpoint": "weights"}.get(key)
    try:
        found = path if path.is_file() else None if kind is None else locate(kind, name)
    except (ValueError, FileNotFoundError):
        return
    if found is not None:
        yield _content(found)


def _content(path: Path) -> bytes:
    size = path.stat().st_size
    return path.read_bytes() if size <= _LARGE else str(size).encode()

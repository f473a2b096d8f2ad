"""PC2 point caches: their header, samples of a file that still grows, and a file that grows sample by sample."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

#: Signature, version, points, first frame, frames from one sample to the next, samples.
HEADER = struct.Struct("<12siiffi")
_MAGIC = b"POINTCACHE2\0"
#: Where the number of samples stands.
_SAMPLES_AT = 28


class Header(NamedTuple):
    """What a cache holds."""

    points: int
    samples: int


def read_header(path: Path) -> Header | None:
    """Points and whole samples of a cache; None where the file is not there yet.

    A file that grows may name a sample more than it holds, or hold more than it names: whole samples that both agree on count.

    Raises:
        ValueError: it is no PC2 file.
    """
    try:
        with open(path, "rb") as file:
            head, size = file.read(HEADER.size), path.stat().st_size - HEADER.size
    except FileNotFoundError:
        return None
    if len(head) < HEADER.size:
        return None
    magic, _, points, _, _, samples = HEADER.unpack(head)
    if magic != _MAGIC or points < 1:
        raise ValueError(f"{path}: not a PC2 point cache; delete it and bake again")
    return Header(points, max(0, min(samples, size // (12 * points))))


def read_samples(path: Path, first: int, last: int) -> np.ndarray:
    """(last − first, V, 3) float32 of the samples from ``first`` up to ``last``."""
    with open(path, "rb") as file:
        points = HEADER.unpack(file.read(HEADER.size))[2]
        file.seek(HEADER.size + 12 * points * first)
        content = file.read(12 * points * (last - first))
    return np.frombuffer(content, "<f4").reshape(last - first, points, 3)


class GrowingCache:
    """A cache that is written sample by sample; readers see whole samples only, because the header is written last.

    Args:
        kept: samples that are there from the same run and stay readable until they are written again.
    """

    def __init__(self, path: Path, points: int, kept: int = 0) -> None:
        self.path, self.points, self.samples, self._kept = path, points, 0, 0
        there = read_header(path) if kept else None
        if there is not None and there.points == points:
            self._kept = min(kept, there.samples)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            draft = path.with_suffix(".partial")
            draft.write_bytes(HEADER.pack(_MAGIC, 1, points, 0.0, 1.0, 0))
            draft.replace(path)

    def add(self, pos: np.ndarray) -> None:
        """Append ``pos`` (V, 3)."""
        with open(self.path, "r+b") as file:
            file.seek(HEADER.size + 12 * self.points * self.samples)
            file.write(np.ascontiguousarray(pos, "<f4").tobytes())
            file.flush()
            self.samples += 1
            self._count(file, max(self.samples, self._kept))

    def _count(self, file: BinaryIO, samples: int) -> None:
        file.seek(_SAMPLES_AT)
        file.write(struct.pack("<i", samples))

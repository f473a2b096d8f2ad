"""Libraries that a wheel carries: compiled when it was made, one for each generation of processors. Checkouts have none."""

from __future__ import annotations

import ctypes
import hashlib
import platform
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

#: Where an installed wheel has them.
FOLDER = Path(__file__).with_name("prebuilt")


@dataclass(frozen=True)
class Level:
    """A generation of processors.

    Args:
        name: its name for a compiler (``-march=``).
        needs: what its processors can do, in the words of ``/proc/cpuinfo``.
    """

    name: str
    needs: frozenset[str] = frozenset()


_V3 = frozenset("avx avx2 bmi1 bmi2 f16c fma abm movbe".split())
#: Of an architecture, the widest vectors first; the last one runs everywhere.
LEVELS = {
    "x86_64": (
        Level("x86-64-v4", _V3 | frozenset("avx512f avx512bw avx512cd avx512dq avx512vl".split())),
        Level("x86-64-v3", _V3),
        Level("x86-64"),
    ),
    "aarch64": (Level("armv8-a"),),
    "arm64": (Level("armv8-a"),),
}


def levels() -> tuple[Level, ...]:
    """Generations that this architecture has."""
    return LEVELS.get(platform.machine(), ())


def source_text(source: Path) -> str:
    """Of the source and of the headers beside it, which it may include: what a library depends on."""
    return "\0".join(path.read_text(encoding="utf-8") for path in (source, *sorted(source.parent.glob("*.h"))))


def file_name(source: Path, flags: Sequence[str], level: Level) -> str:
    """Of the library: a source that changed, or other flags, have another name, so a stale library is never taken."""
    parts = [*(flag for flag in flags if flag != "-march=native"), source_text(source)]
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    return f"{source.stem}-{level.name}-{digest[:16]}.so"


def flags_for(flags: Sequence[str], level: Level) -> list[str]:
    """``flags`` for processors of ``level`` instead of the one at hand."""
    return [f"-march={level.name}" if flag == "-march=native" else flag for flag in flags]


def load(path: Path) -> ctypes.CDLL:
    """A library that is whole: the system maps a file that was cut off as well, and ends the process when it reads on.

    Raises:
        OSError: it is cut off, or no library for this machine.
    """
    with open(path, "rb") as file:
        head = file.read(64)
    if head[:5] == b"\x7fELF\x02":  # of 64 bits; its table of sections stands at the end
        order = "<" if head[5] == 1 else ">"
        (table,), (size, count) = struct.unpack_from(order + "Q", head, 40), struct.unpack_from(order + "HH", head, 58)
        if path.stat().st_size < table + size * count:
            raise OSError(f"{path}: the library is cut off")
    return ctypes.CDLL(str(path))


def prebuilt(folder: Path, source: Path, flags: Sequence[str], abilities: frozenset[str] | None = None) -> ctypes.CDLL | None:
    """The library in ``folder`` with the widest vectors that this processor has; None where there is none.

    Args:
        abilities: of the processor; None: of this one.
    """
    if not folder.is_dir():
        return None
    able = _abilities() if abilities is None else abilities
    for level in levels():
        path = folder / file_name(source, flags, level)
        if level.needs <= able and path.exists():
            try:
                return load(path)
            except OSError:  # of another system, or damaged: compiled anew
                continue
    return None


def _abilities() -> frozenset[str]:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    return frozenset(next((line for line in lines if line.startswith(("flags", "Features"))), "").split())

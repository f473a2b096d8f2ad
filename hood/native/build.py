"""C++ sources as libraries: compiled at their first use and kept in the user's cache folder."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from hood.native.cache import cache_folder

#: For sources that use what the processor has; arithmetic as IEEE has it.
NATIVE_FLAGS = ("-O3", "-std=c++17", "-shared", "-fPIC", "-fno-math-errno", "-Wno-psabi", "-march=native")


class BuildError(ValueError):
    """There is no compiler, or it fails."""


def build(source: Path, flags: Sequence[str]) -> ctypes.CDLL:
    """The library that a compiler makes of ``source`` with ``flags``.

    What is kept is known by the source, the compiler, the flags and the processor; a kept file that does not load is made anew.
    Several processes may build the same at once.

    Raises:
        BuildError: there is no compiler, or it fails.
    """
    compiler = find_compiler()
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
    parts = [compiler, version, processor(), *flags, source.read_text(encoding="utf-8")]
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    folder = cache_folder()
    if folder is not None:
        path = folder / "kernels" / f"{digest}.so"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            return _kept(path) or _compile(compiler, flags, source, path)
        except OSError:  # a folder that cannot be written to: done without
            pass
    with tempfile.TemporaryDirectory() as temporary:
        return _compile(compiler, flags, source, Path(temporary) / "library.so")


def find_compiler() -> str:
    """The C++ compiler: ``CXX`` of the environment, else g++ or clang++.

    Raises:
        BuildError: there is none.
    """
    for name in [os.environ["CXX"]] if os.environ.get("CXX") else ["g++", "clang++"]:
        found = shutil.which(name)
        if found is not None:
            return found
    raise BuildError("no C++ compiler: install g++ or clang++ (or name one in CXX)")


@cache
def processor() -> str:
    """What tells processors apart that need different code: the architecture and what it can do."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    abilities = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    return f"{platform.system()} {platform.machine()} {abilities}"


def _kept(path: Path) -> ctypes.CDLL | None:
    """The library at ``path``; None where there is none, or where it is damaged."""
    try:
        return ctypes.CDLL(str(path)) if path.exists() else None
    except OSError:
        return None


def _compile(compiler: str, flags: Sequence[str], source: Path, path: Path) -> ctypes.CDLL:
    """Compile under another name and rename: other processes may be doing the same."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        made = Path(folder) / path.name
        run = subprocess.run([compiler, *flags, str(source), "-o", str(made)], capture_output=True, text=True, check=False)
        if run.returncode:
            lines = run.stderr.strip().splitlines() or [f"exit code {run.returncode}"]
            first = next((line for line in lines if "error" in line), lines[0])
            raise BuildError(f"{compiler} fails ({first.strip()}); name another in CXX")
        os.replace(made, path)
    return ctypes.CDLL(str(path))

"""C++ sources as libraries: those that came with the installation, else compiled at their first use and kept.

The folder for files that can be made again, such as compiled libraries.

What a wheel carries compiled: the C++ sources of the libraries and their flags. Standard library only, for the build.

Libraries compiled in the background at the start of a program, while it does other things.
"""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import os
import platform
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path


def cache_folder() -> Path | None:
    """The user's cache folder as the platform has it, or ``HOOD_CACHE``; None where that turns caching off."""
    chosen = os.environ.get("HOOD_CACHE")
    if chosen is not None:
        return None if chosen.strip().lower() in ("", "off") else Path(chosen).expanduser()
    try:
        home = Path.home()
    except RuntimeError:  # a user without a home
        return None
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local")) / "hood" / "Cache"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "hood"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "hood"


#: For sources that use what the processor has; arithmetic as IEEE has it.
NATIVE_FLAGS = ("-O3", "-std=c++17", "-shared", "-fPIC", "-pthread", "-fno-math-errno", "-Wno-psabi", "-march=native")
#: What ``-march=native`` asks of a compiler that does not know the processor it runs on, or not the option.
_UNKNOWN_PROCESSOR = ("unknown architecture", "unknown value", "unsupported argument", "unsupported option", "bad value")

#: Threads of a program do not make the same library twice.
_LOCKS: defaultdict[Path, threading.Lock] = defaultdict(threading.Lock)
#: Compilers that are at work, and the threads that wait for them.
_RUNS: dict[subprocess.Popen[str], threading.Thread] = {}

#: Called with one sentence when a compiler starts, which takes some seconds; commands print it.
announce: Callable[[str], None] = lambda sentence: None  # noqa: E731


class BuildError(ValueError):
    """There is no compiler, it fails, or what it made cannot be loaded."""


def build(source: Path, flags: Sequence[str]) -> ctypes.CDLL:
    """The library of ``source`` with ``flags``: prebuilt if the installation has it for this processor, else compiled.

    What is compiled is kept, known by the source, the compiler, the flags and the processor; a kept file that does not load is
    made anew. Several processes may build the same at once.

    Raises:
        BuildError: there is no compiler, it fails, or what it made cannot be loaded.
    """
    library = prebuilt(FOLDER, source, flags)
    if library is not None:
        return library
    compiler = find_compiler()
    folder = cache_folder()
    if folder is not None:
        path = _place(folder, compiler, source, flags)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with _LOCKS[path]:
                return _kept(path) or _compile(compiler, flags, source, path)
        except OSError:  # a folder that cannot be written to, or whose files may not be run: done without
            pass
    try:
        with tempfile.TemporaryDirectory() as temporary:
            return _compile(compiler, flags, source, Path(temporary) / "library.so")
    except OSError as error:
        raise BuildError(f"a compiled library cannot be loaded ({error}); name a folder for it in HOOD_CACHE") from error


def keep(source: Path, flags: Sequence[str]) -> None:
    """Make what :func:`build` would load, unless it is carried or kept already, and keep it; it is not loaded. Nothing where
    nothing is kept.

    Raises:
        BuildError: there is no compiler, or it fails.
        OSError: the folder cannot be written to.
    """
    folder = cache_folder()
    if folder is None or prebuilt(FOLDER, source, flags) is not None:
        return
    compiler = find_compiler()
    path = _place(folder, compiler, source, flags)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _LOCKS[path]:
        if not path.exists():
            _make(compiler, flags, source, path)


def stop_compilers(thread: threading.Thread) -> None:
    """End the compilers that ``thread`` waits for; their output is not kept."""
    for run, owner in list(_RUNS.items()):
        if owner is thread:
            run.terminate()


def optional(source: Path) -> ctypes.CDLL | None:
    """The library of ``source`` with :data:`NATIVE_FLAGS`; None where it cannot be built."""
    try:
        return build(source, NATIVE_FLAGS)
    except BuildError:
        return None


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
    abilities = next((line for line in lines if line.startswith(("flags", "Features"))), None)
    return f"{platform.system()} {platform.machine()} {platform.processor() if abilities is None else abilities}"


def compile_library(compiler: str, flags: Sequence[str], source: Path, path: Path) -> None:
    """Write the library to ``path``; under another name first, since other processes may be doing the same.

    Raises:
        BuildError: the compiler fails.
    """
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        made = Path(folder) / path.name
        lines = _run(compiler, flags, source, made)
        if lines and "-march=native" in flags and any(word in line for line in lines for word in _UNKNOWN_PROCESSOR):
            lines = _run(compiler, [flag for flag in flags if flag != "-march=native"], source, made)
        if lines:
            first = next((line for line in lines if "error" in line), lines[0])
            raise BuildError(f"{compiler} fails ({first.strip()}); name another in CXX")
        os.replace(made, path)


def _run(compiler: str, flags: Sequence[str], source: Path, made: Path) -> list[str]:
    """What the compiler complains about; nothing where it succeeds."""
    command = [compiler, *flags, str(source), "-o", str(made)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        _RUNS[run] = threading.current_thread()
        try:
            _, said = run.communicate()
        finally:
            del _RUNS[run]
    return (said.strip().splitlines() or [f"exit code {run.returncode}"]) if run.returncode else []


def _place(folder: Path, compiler: str, source: Path, flags: Sequence[str]) -> Path:
    return folder / "kernels" / f"{_digest(compiler, source, flags)}.so"


def _digest(compiler: str, source: Path, flags: Sequence[str]) -> str:
    parts = [compiler, _version(compiler), processor(), *flags, source_text(source)]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


@cache
def _version(compiler: str) -> str:
    """What the compiler says it is; asked once, since every library asks for it."""
    return subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout


def _kept(path: Path) -> ctypes.CDLL | None:
    """The library at ``path``; None where there is none, or where it is damaged."""
    try:
        return load(path) if path.exists() else None
    except OSError:
        return None


def _compile(compiler: str, flags: Sequence[str], source: Path, path: Path) -> ctypes.CDLL:
    """Compile and load."""
    _make(compiler, flags, source, path)
    return ctypes.CDLL(str(path))


def _make(compiler: str, flags: Sequence[str], source: Path, path: Path) -> None:
    announce(f"compiling {source.name} for this processor; this happens once and takes some seconds")
    compile_library(compiler, flags, source, path)


_HERE = Path(__file__).parent
#: Faces that share an edge must compute the same signs for it, to the last bit: no product is contracted with a sum.
CROSSING_FLAGS = (*NATIVE_FLAGS, "-ffp-contract=off")
#: Compiled in two thirds of the time, and no slower: what counts is written in vectors.
LAYER_FLAGS = (*NATIVE_FLAGS, "-O2")
#: The solver with its matrix in float64.
WIDE_FLAGS = (*NATIVE_FLAGS, "-DWIDE")
#: Source and flags of each library, as the modules ask :func:`hood.native.build.build` for them.
LIBRARIES: tuple[tuple[Path, tuple[str, ...]], ...] = (
    (_HERE / "newton.cpp", NATIVE_FLAGS),
    (_HERE / "surface.cpp", NATIVE_FLAGS),
    (_HERE / "crossing.cpp", CROSSING_FLAGS),
    (_HERE / "elements.cpp", NATIVE_FLAGS),
    (_HERE / "picture.cpp", NATIVE_FLAGS),
    (_HERE / "features.cpp", NATIVE_FLAGS),
    (_HERE / "layers.cpp", LAYER_FLAGS),
    (_HERE / "network.cpp", NATIVE_FLAGS),
)


#: What few scenes need: compiled when one does.
SELDOM: tuple[tuple[Path, tuple[str, ...]], ...] = ((_HERE / "newton.cpp", WIDE_FLAGS),)


def make(folder: Path) -> tuple[list[Path], list[str]]:
    """Compile all of them into ``folder``, for each generation of processors of this architecture.

    Returns:
        The files, and a sentence for each that is left out.
    """
    try:
        compiler = find_compiler()
    except BuildError as error:
        return [], [f"the wheel carries no compiled parts: {error}"]
    made, left_out = [], []
    for source, flags in (*LIBRARIES, *SELDOM):
        for level in levels():
            path = folder / file_name(source, flags, level)
            try:
                compile_library(compiler, flags_for(flags, level), source, path)
            except BuildError as error:
                left_out.append(f"the wheel is without {path.name}: {error}")
                continue
            made.append(path)
    return made, left_out


def start() -> None:
    """Begin to make those of :data:`hood.native.build.LIBRARIES` that are neither carried nor kept, one after the other.

    Who needs one that is being made waits for it (:func:`hood.native.build.build`), and makes itself what has not been begun.
    What is left when the program ends is stopped and leaves nothing behind. Nothing happens without a compiler, or where
    nothing is kept between runs.
    """
    stop = threading.Event()
    worker = threading.Thread(target=_make_all, args=(stop,), name="compile ahead", daemon=True)
    worker.start()

    def end() -> None:
        stop.set()
        for _ in range(100):  # one may just be starting
            stop_compilers(worker)
            worker.join(timeout=0.05)
            if not worker.is_alive():
                return

    atexit.register(end)


def _make_all(stop: threading.Event) -> None:
    for source, flags in LIBRARIES:
        if stop.is_set():
            return
        try:
            keep(source, flags)
        except (BuildError, OSError):  # who needs it is told why
            return


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

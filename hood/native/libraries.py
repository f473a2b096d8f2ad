"""What a wheel carries compiled: the C++ sources of the library and their flags. Standard library only, for the build.

Libraries compiled in the background at the start of a program, while it does other things; standard library only.
"""

from __future__ import annotations

import atexit
import threading
from pathlib import Path

from hood.native import build
from hood.native.build import NATIVE_FLAGS, BuildError, compile_library, find_compiler
from hood.native.prebuilt import file_name, flags_for, levels

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
    """Begin to make those of :data:`hood.native.libraries.LIBRARIES` that are neither carried nor kept, one after the other.

    Who needs one that is being made waits for it (:func:`hood.native.build.build`), and makes itself what has not been begun.
    What is left when the program ends is stopped and leaves nothing behind. Nothing happens without a compiler, or where
    nothing is kept between runs.
    """
    stop = threading.Event()
    worker = threading.Thread(target=_make, args=(stop,), name="compile ahead", daemon=True)
    worker.start()

    def end() -> None:
        stop.set()
        for _ in range(100):  # one may just be starting
            build.stop_compilers(worker)
            worker.join(timeout=0.05)
            if not worker.is_alive():
                return

    atexit.register(end)


def _make(stop: threading.Event) -> None:
    for source, flags in LIBRARIES:
        if stop.is_set():
            return
        try:
            build.keep(source, flags)
        except (build.BuildError, OSError):  # who needs it is told why
            return

"""Libraries compiled in the background at the start of a program, while it does other things; standard library only."""

from __future__ import annotations

import atexit
import threading

from hood.native import build
from hood.native.libraries import LIBRARIES


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

"""Where a frame's time goes: search, features, network, rest."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch


class Stopwatch:
    """Accumulates wall-clock milliseconds by part; ``lap`` hands them out and starts the next frame."""

    def __init__(self) -> None:
        self._parts: dict[str, float] = {}
        self._start = time.perf_counter()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time of the block as ``name``. On CUDA the block is waited for."""
        begin = time.perf_counter()
        yield
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        self._parts[name] = self._parts.get(name, 0.0) + 1e3 * (time.perf_counter() - begin)

    def lap(self) -> dict[str, float]:
        """Milliseconds since the last lap: each part, ``rest`` and ``total``."""
        now = time.perf_counter()
        total = 1e3 * (now - self._start)
        parts, self._parts, self._start = self._parts, {}, now
        return {**parts, "rest": max(total - sum(parts.values()), 0.0), "total": total}

    def restart(self) -> None:
        """Forget what was counted since the last lap."""
        self._parts, self._start = {}, time.perf_counter()


def timed(watch: Stopwatch | None, name: str) -> AbstractContextManager[None]:
    """``watch.part(name)``, or nothing without a watch."""
    return nullcontext() if watch is None else watch.part(name)

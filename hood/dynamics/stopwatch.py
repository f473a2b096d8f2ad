"""Where a frame's time goes: search, features, network, rest."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch


class Stopwatch:
    """Accumulates milliseconds by part; ``lap`` hands them out and starts the next frame.

    ``clock`` tells the seconds; by default those on the wall.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._parts: dict[str, float] = {}
        self._asides: dict[str, float] = {}
        self._start = clock()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time of the block as ``name``. On CUDA the block, and what was begun before it, is waited for."""
        with self._counted(self._parts, name):
            yield

    @contextmanager
    def aside(self, name: str) -> Iterator[None]:
        """The block is no part of the frame: its time is kept apart, for :meth:`spent_aside`."""
        with self._counted(self._asides, name):
            yield

    def spent_aside(self, name: str) -> float:
        """Milliseconds since the last lap in blocks set aside as ``name``."""
        return self._asides.get(name, 0.0)

    def elapsed(self) -> float:
        """Milliseconds since the last lap, without what was set aside. On CUDA, what was begun is waited for."""
        _wait()
        return 1e3 * (self._clock() - self._start) - sum(self._asides.values())

    def lap(self) -> dict[str, float]:
        """Milliseconds since the last lap: each part, ``rest`` and ``total``, which leaves out what was set aside."""
        _wait()
        now = self._clock()
        total = 1e3 * (now - self._start) - sum(self._asides.values())
        parts, self._start = dict(self._parts), now
        self._parts.clear()
        self._asides.clear()
        return {**parts, "rest": max(total - sum(parts.values()), 0.0), "total": total}

    @contextmanager
    def _counted(self, times: dict[str, float], name: str) -> Iterator[None]:
        _wait()
        begin = self._clock()
        yield
        _wait()
        times[name] = times.get(name, 0.0) + 1e3 * (self._clock() - begin)


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def timed(watch: Stopwatch | None, name: str) -> AbstractContextManager[None]:
    """``watch.part(name)``, or nothing without a watch."""
    return nullcontext() if watch is None else watch.part(name)

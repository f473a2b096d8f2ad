"""Iterations per second of training alone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """Runs while training does; what is :meth:`paused` does not count."""

    def __init__(self, iteration: int) -> None:
        self._first, self._begun, self._away = iteration, time.monotonic(), 0.0

    def rate(self, iteration: int) -> float:
        return (iteration - self._first) / max(time.monotonic() - self._begun - self._away, 1e-9)

    @contextmanager
    def paused(self) -> Iterator[None]:
        left = time.monotonic()
        yield
        self._away += time.monotonic() - left

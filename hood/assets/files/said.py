"""Doubts: what a command goes on with although it may be wrong, as a warning that a script can read.

Sentences for the user: told to whoever listens, the command line or a program; nobody here prints.

What pip calls this package and its extras: one place for every message that says what to install.

Lines about work that takes long: none in its first seconds, then one now and then.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

#: What a doubt can be about; these words stand in ``summary.json`` and stay.
KINDS = (
    "frame_rate",  # assumed, no file gives it
    "units",  # guessed from the size
    "layout",  # how the numbers of a motion are arranged was guessed
    "orientation",  # the body is head down, or which way is up is not sure
    "floor",  # the body is far below or above its own floor
    "speed",  # the body moves faster than people do
    "jump",  # the body jumps from one frame to the next
    "body_overlap",  # parts of the body lie in each other
    "shape",  # the body is no person's
    "fabric",  # no cloth is like that
    "garment",  # what the garment's file holds was guessed
    "worn",  # it cannot be told whether the garment stays on
    "guard",  # the guard of a rollout saw something that was not mended
)


class Doubt(UserWarning):
    """A warning of one sentence, ``what is so; the way out``, that is also told in ``doubts`` of ``summary.json``.

    Args:
        kind: one of :data:`KINDS`.
        sentence: what may be wrong, with its numbers, and after a semicolon what settles it: a key, a command.
        frames: of the rollout or file that it is about; empty for all.
        value: the number behind it, in ``unit``.
    """

    def __init__(
        self, kind: str, sentence: str, frames: tuple[int, ...] = (), value: float | None = None, unit: str = ""
    ) -> None:
        assert kind in KINDS, kind
        super().__init__(sentence)
        self.kind, self.frames, self.value, self.unit = kind, frames, value, unit

    def as_dict(self) -> dict[str, Any]:
        """For JSON: ``kind``, ``sentence``, ``frames``, ``value``, ``unit``."""
        frames = [int(frame) for frame in self.frames]
        return {"kind": self.kind, "sentence": str(self), "frames": frames, "value": self.value, "unit": self.unit}


#: The package that pip installs; ``hood`` on the public index is somebody else's.
DISTRIBUTION = "hood-cloth"


def install(extra: str) -> str:
    """The command that adds an extra of ``pyproject.toml`` to this installation."""
    return f'pip install "{DISTRIBUTION}[{extra}]"'


#: What hears a sentence, whether it belongs on the error stream, and whether it tells how far a piece of work is.
Listener = Callable[[str, bool, bool], None]
_LISTENERS: list[Listener] = []


def listen(listener: Listener) -> None:
    """From now on ``listener`` hears every sentence, as the others do that listen already."""
    _LISTENERS.append(listener)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """The same inside alone."""
    listen(listener)
    try:
        yield
    finally:
        _LISTENERS.remove(listener)


@contextmanager
def unheard() -> Iterator[None]:
    """Nobody hears what is said inside."""
    listeners, _LISTENERS[:] = [*_LISTENERS], []
    try:
        yield
    finally:
        _LISTENERS[:] = listeners


def say(sentence: object, error: bool = False, passing: bool = False) -> None:
    """Tell all listeners a sentence; nobody hears it where nobody listens.

    Args:
        error: the command line prints it on the error stream.
        passing: it tells how far a piece of work is, and is of no interest later.
    """
    for listener in tuple(_LISTENERS):
        listener(str(sentence), error, passing)


#: Seconds before the first line, and between two.
_FIRST, _BETWEEN = 5.0, 10.0


class ProgressLines:
    """Tells how far a piece of work is.

    Args:
        what: the work, in words that a colon follows, such as "settling the cloth".
    """

    def __init__(self, what: str) -> None:
        self._what, self._next = what, time.monotonic() + _FIRST

    def tell(self, sentence: str) -> None:
        """Say how far it is, unless that was done a moment ago."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + _BETWEEN
            say(f"hood: {self._what}: {sentence}", error=True, passing=True)

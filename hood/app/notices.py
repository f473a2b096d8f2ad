"""What is told while something runs: sentences, and warnings as one sentence each, collected for summaries and for Python.

Nothing is printed here: the command line listens and prints, the Python interface listens and keeps.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

from hood.assets.files.said import Doubt, ProgressLines, listening, say

Item = TypeVar("Item")

_BY = "hood: "


class Heard(list[str]):
    """Sentences in their order, none twice; those of them that are doubts stand in ``doubts`` as well."""

    def __init__(self) -> None:
        super().__init__()
        self.doubts: list[Doubt] = []


#: Lists that are open, outermost first, and whether what they hear is said and passed on.
_OPEN: list[tuple[Heard, bool]] = []


@contextmanager
def heard(aloud: bool = True) -> Iterator[Heard]:
    """What is warned about inside (:func:`warnings.warn`), as a list of sentences in their order, none twice.

    Each is said as ``hood: warning: …`` when it comes. Calls nest: an inner list is part of the outer ones, and what an
    outer one holds already is not said again. With ``aloud=False`` it stays in this list: the caller tells it.
    """
    found = Heard()
    _OPEN.append((found, aloud))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)  # else a place in the code speaks once a process
            warnings.showwarning = _tell
            yield found
    finally:
        _OPEN.pop()


def _tell(message: Warning | str, *_: Any, **__: Any) -> None:
    sentence = " ".join(str(message).split())
    known = False
    for found, aloud in reversed(_OPEN):
        known = sentence in found
        if not known:
            found.append(sentence)
            found.doubts += [message] if isinstance(message, Doubt) else []
        if not aloud:
            return
    if not known:
        say(f"{_BY}warning: {sentence}", error=True)


@contextmanager
def collected(tell: Callable[[str], None] | None = None) -> Iterator[list[str]]:
    """What is said inside, a line each.

    Args:
        tell: hears every line when it comes, and also how far the work is.
    """
    lines: list[str] = []

    def listen(sentence: str, error: bool, passing: bool) -> None:
        for line in sentence.splitlines():
            line = line.removeprefix(_BY)
            if not passing:
                lines.append(line)
            if tell is not None:
                tell(line)

    with listening(listen):
        yield lines


class Bar(Protocol):
    """Shows how far a loop is: hands ``items``, ``total`` of them, through; ``what`` names the work."""

    def __call__(self, items: Iterable[Item], total: int, what: str) -> Iterable[Item]: ...


def tell_how_far(items: Iterable[Item], total: int, what: str) -> Iterator[Item]:
    """A :class:`Bar` that says how far it is every few seconds."""
    progress = ProgressLines(what)
    for place, item in enumerate(items):
        yield item
        progress.tell(f"{place + 1} of {total}")

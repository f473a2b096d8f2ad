"""Warnings printed as one sentence each on the error stream, and collected for summaries."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from hood.assets.files.said import Doubt


class Heard(list[str]):
    """Sentences in their order, none twice; those of them that are doubts stand in ``doubts`` as well."""

    def __init__(self) -> None:
        super().__init__()
        self.doubts: list[Doubt] = []


#: Lists that are open, outermost first, and whether what they hear is printed and passed on.
_OPEN: list[tuple[Heard, bool]] = []


@contextmanager
def heard(aloud: bool = True) -> Iterator[Heard]:
    """What is warned about inside (:func:`warnings.warn`), as a list of sentences in their order, none twice.

    Each is printed as ``hood: warning: …`` when it comes. Calls nest: an inner list is part of the outer ones, and what an
    outer one holds already is not printed again. With ``aloud=False`` it stays in this list: the caller tells it.
    """
    said = Heard()
    _OPEN.append((said, aloud))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)  # else a place in the code speaks once a process
            warnings.showwarning = _tell
            yield said
    finally:
        _OPEN.pop()


def _tell(message: Warning | str, *_: Any, **__: Any) -> None:
    sentence = " ".join(str(message).split())
    known = False
    for said, aloud in reversed(_OPEN):
        known = sentence in said
        if not known:
            said.append(sentence)
            said.doubts += [message] if isinstance(message, Doubt) else []
        if not aloud:
            return
    if not known:
        print(f"hood: warning: {sentence}", file=sys.stderr)

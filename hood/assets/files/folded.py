"""Names that people give, such as those of pattern pieces, in letters that every keyboard and every command line has."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping
from itertools import chain, count
from typing import Any

#: Letters that are written as two.
_PAIRS = {"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss", "æ": "ae", "œ": "oe", "ø": "oe", "å": "aa", "þ": "th", "đ": "d", "ł": "l"}
#: What stays in a folded name; the key of a table may hold it.
_KEPT = re.compile(r"[A-Za-z0-9_./+@ -]")


def folded(name: str) -> str:
    """The name in ASCII letters, digits, blanks and ``_ . / + - @``: ö is oe, é is e; a letter of another alphabet is its
    number, u5de6; whatever else is one ``_``. A name that holds nothing but these stays."""
    if all(map(_KEPT.fullmatch, name)):
        return name
    plain = re.sub(r" *_[_ ]*", "_", "".join(map(_letter, unicodedata.normalize("NFC", name)))).strip("_ ")
    return plain or "_"


def folded_names(names: Iterable[str]) -> dict[str, str]:
    """Names, each with its folded one; of two that fold alike the later one ends with ``_2``, and so on."""
    given = list(names)
    found = {name: name for name in given if folded(name) == name}
    for name in given:
        if name not in found:
            numbered = chain([folded(name)], (f"{folded(name)}_{k}" for k in count(2)))
            found[name] = next(short for short in numbered if short not in found.values())
    return {name: found[name] for name in given}


def meant(name: str, known: Mapping[str, Any] | Iterable[str]) -> str | None:
    """Which of the ``known`` names is ``name``, as it is or once both are folded; None where none is."""
    known = list(known)
    if name in known:
        return name
    return next((other for other in known if _loose(other) == _loose(name)), None)


def _loose(name: str) -> str:
    return folded(name).replace(" ", "_")


def _letter(letter: str) -> str:
    if _KEPT.fullmatch(letter):
        return letter
    pair = _PAIRS.get(letter.lower())
    if pair is not None:
        return pair if letter.islower() else pair.capitalize()
    base = unicodedata.normalize("NFKD", letter)[0]
    if base.isascii() and base.isalnum():
        return base
    return f"u{ord(letter):04x}" if letter.isalnum() else "_"

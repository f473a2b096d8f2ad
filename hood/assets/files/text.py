"""Text files in the encodings that programs write: UTF-8 with or without a byte-order mark, UTF-16, UTF-32, Latin-1.

Names that people give, such as those of pattern pieces, in letters that every keyboard and every command line has.

Lists of numbers in text or JSON files.

Frame rates as files say them: under any of the usual keys, as numbers or as text.
"""

from __future__ import annotations

import codecs
import json
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

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


#: Marks, the longer ones first: that of UTF-32 begins like that of UTF-16.
_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
#: Bytes that are looked at for zeros: every second byte of ASCII text in UTF-16 is one.
_HEAD = 256


def encoding_of(content: bytes) -> str:
    """The encoding of a text: that of its mark; UTF-16 without one where every second byte is zero; UTF-8 where the text is
    that, else Windows-1252, which has all letters of Latin-1."""
    for mark, name in _MARKS:
        if content.startswith(mark):
            return name
    head = content[:_HEAD]
    even, odd = head[0::2], head[1::2]
    if len(odd) > 1 and not any(odd[: len(even) - 1]) and all(even[:2]):
        return "utf-16-le"
    if len(even) > 1 and not any(even) and all(odd[:2]):
        return "utf-16-be"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(content, final=True)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def decoded_text_file(content: bytes) -> str:
    """The text of a file's bytes, see :func:`encoding_of`, without its mark; bytes that mean nothing there become one sign."""
    return content.decode(encoding_of(content), errors="replace")


def read_text(path: Path) -> str:
    """The text of a file, whatever it is encoded in."""
    return decoded_text_file(path.read_bytes())


_LIST_LIMIT = 64 << 20


def read_indices(path: Path) -> np.ndarray:
    """Vertex numbers from a text file (any white space or commas between, # starts a comment) or a JSON list.

    Raises:
        ValueError: something else than whole numbers; names the file.
    """
    if path.stat().st_size > _LIST_LIMIT:
        raise ValueError(f"{path}: {path.stat().st_size} bytes are no list of vertices")
    text = read_text(path)
    try:
        if path.suffix.lower() == ".json":
            values = json.loads(text)
        else:
            values = [int(word) for line in text.splitlines() for word in line.split("#")[0].replace(",", " ").split()]
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, list) or not all(
        isinstance(v, int) and not isinstance(v, bool) and abs(v) < 2**62 for v in values
    ):
        raise ValueError(
            f"{path}: not a list of vertex numbers; write whole numbers, as in 12 13 14 (.txt) or [12, 13] (.json)"
        )
    return np.array(values, dtype=np.int64)


def read_objects(path: Path) -> list[dict[str, Any]] | None:
    """The objects of a JSON file that is one or a list of them; None of any other file."""
    if not path.is_file() or path.stat().st_size > _LIST_LIMIT:
        return None
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError):
        return None
    objects = content if isinstance(content, list) else [content]
    return objects if objects and all(isinstance(one, dict) for one in objects) else None


_WHOSE = (
    "mocap|motion|video|source|src|original|orig|capture|captured|recorded|recording|sequence|seq|data|camera|cam|smpl|pose"
)
_RATE_KEY = re.compile(rf"({_WHOSE})?(framerate|fps|frequency|freq|samplingrate|samplerate|framespersecond)(hz|fps)?")
_TIME_KEY = re.compile(rf"({_WHOSE})?(frametime|framedt|timestep|dt)(s|sec|seconds)?")
#: Dicts within each other that are looked into.
_DEEPEST = 4
_SAID = re.compile(r"([0-9.eE+-]+)\s*(?:/\s*([0-9.]+))?\s*(?:fps|hz|1/s|frames per second)?", re.IGNORECASE)


def squeezed(key: str) -> str:
    """A key in lower case, letters and digits alone: ``mocap_frameRate`` and ``MocapFramerate`` are one."""
    return re.sub(r"[^a-z0-9]", "", key.lower())


def flat(value: Any) -> np.ndarray:
    """(M,): whatever a value holds, as an array of one axis; empty where its rows have several lengths."""
    try:
        return np.asarray(value).reshape(-1)
    except ValueError:
        return np.zeros(0)


def rates_in(source: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Keys and values that say a frame rate, those of AMASS first; the inverse of those that say a time."""
    for key in sorted(source, key=lambda key: not squeezed(key).startswith("mocap")):
        short, value = squeezed(key), source[key]
        if value is None:
            continue
        if _RATE_KEY.fullmatch(short):
            yield key, value
        elif _TIME_KEY.fullmatch(short) and len(flat(value)) == 1:
            yield key, _inverse(value)
    if depth < _DEEPEST:
        for value in source.values():
            if isinstance(value, Mapping):
                yield from rates_in(value, depth + 1)


def parse_rate(value: Any) -> float:
    """The number that a rate stands for: ``120``, ``[120.]``, ``"29.97"``, ``b"120 fps"``, ``"30000/1001"``; NaN for others."""
    item = flat(value)
    if len(item) != 1:
        return float("nan")
    if item.dtype.kind in "iuf":
        return float(item[0])
    text = item[0].decode("latin-1") if isinstance(item[0], bytes) else str(item[0])
    match = _SAID.fullmatch(text.strip().strip("'\""))
    try:
        return float(match[1]) / float(match[2] or 1) if match else float("nan")
    except (ValueError, ZeroDivisionError):
        return float("nan")


def _inverse(value: Any) -> float:
    seconds = parse_rate(value)
    return 1.0 / seconds if seconds > 0 else float("nan")

"""Text files in the encodings that programs write: UTF-8 with or without a byte-order mark, UTF-16, UTF-32, Latin-1."""

from __future__ import annotations

import codecs
from pathlib import Path

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


def decoded(content: bytes) -> str:
    """The text of a file's bytes, see :func:`encoding_of`, without its mark; bytes that mean nothing there become one sign."""
    return content.decode(encoding_of(content), errors="replace")


def read_text(path: Path) -> str:
    """The text of a file, whatever it is encoded in."""
    return decoded(path.read_bytes())

"""Words ``key=value`` as a shell hands them over, in the form that Hydra's grammar reads: names of files are quoted there."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import HydraException

from hood.assets.files.library import names

#: Characters of a word that a message repeats at most.
_SHOWN = 300
#: Values that an example of a loop has at most.
_SHOWN_VALUES = 3
_QUOTED = re.compile(r"'(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\"", re.DOTALL)
_BRACKETS = {"[": "]", "{": "}", "(": ")"}
_NUMBER = re.compile(r"[+-]?(\d[\d_]*\.?\d*|\.\d+)([eE][+-]?\d+)?|nan|inf|null|true|false", re.IGNORECASE)
#: Strings that Hydra reads as they are.
_BARE, _WORDS = re.compile(r"[A-Za-z_][A-Za-z0-9_./+-]*"), ("null", "true", "false", "nan", "inf")
_APART = re.compile(r"(\w+)=(\w+:[^{}]+)")
#: Keys of names: 2024_01 is a folder there, not a number.
_NAMES = ("output", "garment", "sequence", "body", "checkpoint", "texture")
#: What the grammar does not read in the key of a table, and how it is written there instead.
_FOREIGN, _CODE = re.compile(r"[^A-Za-z0-9_ /\-.+*@?|]"), re.compile(r"\$u(10[0-9a-f]{4}|[0-9a-f]{1,5})\$")


def parse(text: str) -> Override:
    """A word as Hydra reads it.

    Raises:
        HydraException: it does not.
    """
    return OverridesParser.create().parse_override(text)


def readable(text: str, several: bool) -> str:
    """The word ``key=value`` in a form that Hydra reads; one that it reads as it is stays.

    A value that it does not read is a name, and gets quotes; in a list or a table each one by itself.

    Args:
        text: with a ``=``.
        several: whether the key takes more than one value: commas may be those of a list without its brackets.

    Raises:
        ValueError: a bracket or a quote that is not closed, a key that is none, or several values without brackets.
    """
    key, _, value = text.partition("=")
    kind = _kind(text)
    if key in _NAMES and _is_other_number(text):
        return f"{key}={quoted(value)}"
    if kind not in (None, ValueType.SIMPLE_CHOICE_SWEEP):
        return text
    if _kind(f"{key}=0") is None:
        raise ValueError(f"{key[:_SHOWN]!r} cannot be a key; write key=value, the key in letters, digits and _ .")
    if os.path.exists(os.path.expanduser(value)):
        return f"{key}={quoted(value)}"
    value = value.strip()
    if kind is not None and value[:1] in "[{'\"":
        raise ValueError(_without_brackets(key, value))
    if value[:1] in "[{'\"":
        mended = _mended(value)
        if mended is None or _kind(f"{key}={mended}") is None:
            raise ValueError(_unread(key, value))
        return f"{key}={mended}"
    if not _is_balanced(value):
        raise ValueError(_unread(key, value))
    if "," in value and _is_list(value, several):
        if several:
            raise ValueError(_without_brackets(key, value))
        return readable(f"{key}=[{value}]", several)
    return f"{key}={quoted(value)}"


def require_braces(text: str, tables: Sequence[str]) -> None:
    """Raise ValueError where a word is a part of a table, ``key=part:value``: a shell makes them of braces without quotes."""
    found = _APART.fullmatch(text)
    if found is not None and found[1] in tables:
        raise ValueError(f"{text}: the shell has taken the braces apart; put the word in quotes, '{found[1]}={{{found[2]},…}}'")


def loop(command: str, key: str = "seed", values: Sequence[str] = ("0", "1")) -> str:
    """The way out for who asks one command for several values of a key."""
    if command == "train":
        several = f"{key}={','.join(values)}"
        return f"a training takes one value of a key, a sweep trains one run for each of several: hood train -m {several}"
    shown = " ".join(values[:_SHOWN_VALUES])
    rollouts = f"for x in {shown}; do hood {command} {key}=$x output=outputs/{key.rpartition('.')[2]}_$x; done"
    return f"a command takes one value of a key, a loop of the shell runs several: {rollouts}"


def quoted(text: str) -> str:
    """Text as Hydra reads it whatever it holds."""
    return "'" + re.sub(r"(\\+)(?=')|(\\+)$", lambda found: 2 * found[0], text).replace("'", "\\'") + "'"


def search_path(folders: Sequence[str | Path]) -> str:
    """The word that tells Hydra where further options lie."""
    return f"hydra.searchpath=[{','.join(quoted(f'file://{path}') for path in folders)}]"


def bare_or_quoted(text: str) -> str:
    """Text as Hydra reads it, in quotes where it needs them."""
    return text if _BARE.fullmatch(text) and text.lower() not in _WORDS else quoted(text)


def plain_word(key: str, value: str) -> str:
    """``key=value`` that gives ``value`` back when it is read, with no more quotes than that needs; not yet for a shell."""
    word = f"{key}={value}"
    try:
        same = parse(readable(word, several=True)).value() == value
    except (ValueError, HydraException):
        same = False
    return word if same else f"{key}={quoted(value)}"


def coded(key: str) -> str:
    """The key of a table, with what Hydra does not read there as numbers; :func:`decoded` gives it back."""
    return _FOREIGN.sub(lambda found: f"$u{ord(found[0]):x}$", key)


def is_coded(text: str) -> bool:
    """Whether some key in ``text`` is written by :func:`coded`."""
    return _CODE.search(text) is not None


def decoded(value: Any) -> Any:
    """A value with the keys that :func:`coded` has written as they were."""
    if isinstance(value, dict):
        return {decoded_text(key) if isinstance(key, str) else key: decoded(item) for key, item in value.items()}
    return [decoded(item) for item in value] if isinstance(value, list) else value


def decoded_text(text: str) -> str:
    """A text, with the keys in it that :func:`coded` has written as they were."""
    return _CODE.sub(lambda found: chr(int(found[1], 16)), text)


def _kind(text: str) -> ValueType | None:
    """What Hydra takes the value for; None where it cannot read the word."""
    try:
        override = parse(text)
    except HydraException:
        return None
    return override.value_type or ValueType.ELEMENT


def _is_other_number(text: str) -> bool:
    """Whether Hydra reads the value as a number that is written in another way: 007, 1_000, 1e3."""
    try:
        value = parse(text).value()
    except HydraException:
        return False
    return type(value) in (int, float) and str(value) != text.partition("=")[2].strip()


def _is_list(value: str, several: bool) -> bool:
    """Whether the parts between commas are values of their own rather than pieces of one name."""
    parts = [part.strip() for part in value.split(",")]
    known = {name for kind in ("garments", "motions", "body", "weights") for name in names(kind)}
    found = [part in known or os.path.exists(os.path.expanduser(part)) for part in parts]
    if all(found) or not several:
        return all(found)
    if all(_NUMBER.fullmatch(part) or there for part, there in zip(parts, found, strict=True)):
        return True
    endings = {bool(Path(part).suffix) for part in parts}
    return "/" not in value and len(endings) == 1


def _without_brackets(key: str, value: str) -> str:
    is_name = value[:1] not in "[{'\"" and not all(_NUMBER.fullmatch(part.strip()) for part in value.split(","))
    value = value[:_SHOWN]
    name = "" if not is_name else f"; a name that holds a comma in two pairs of quotes, \"{key}='{value}'\""
    return f"{key}={value}: several values stand in brackets, {key}=[{value}]{name}"


def _unread(key: str, value: str) -> str:
    what = f"cannot read {f'{key}={value}'[:_SHOWN]!r}"
    if value[:1] in "[{" and _items(value) is not None:
        return f"{what}: a value is missing beside a comma or a colon, or a quote is not closed"
    return (
        f"{what}: close every bracket and quote; a name that holds [ ] {{ }} ( ) or begins with a quote stands in two pairs of "
        f"quotes, \"{key}='name'\""
    )


def _mended(value: str) -> str | None:
    """A value with quotes around the names in it that need them; None where a bracket or a quote is not closed."""
    if value[:1] in ("[", "{"):
        items = _items(value)
        mended = [] if items is None else [_pair(item) if value[0] == "{" else _mended(item) for item in items]
        if items is None or None in mended:
            return None
        return value[0] + ",".join(map(str, mended)) + _BRACKETS[value[0]]
    kind = _kind(f"key={value}")
    if kind is ValueType.ELEMENT:
        return value
    return None if value[:1] in ("'", '"') else quoted(value)


def _pair(item: str) -> str | None:
    """``key:value`` of a table."""
    name = _QUOTED.match(item)
    key = item.partition(":")[0] if name is None else name[0]
    rest = item[len(key) :].lstrip()
    value = _mended(rest[1:].strip()) if rest.startswith(":") else None
    key = key.strip() if name is None else re.sub(r"\\(['\"])", r"\1", key[1:-1])
    return None if value is None or not key else f"{coded(key)}:{value}"


def _items(value: str) -> list[str] | None:
    """What stands between the outer brackets, divided at commas outside of others; None where they are not closed."""
    items, open_brackets, start, at, begins = list[str](), list[str](), 1, 0, True
    while at < len(value):
        letter = value[at]
        if begins and letter in "'\"":
            found = _QUOTED.match(value, at)
            if found is None:
                return None
            at, begins = found.end(), False
            continue
        if letter in _BRACKETS:
            open_brackets.append(_BRACKETS[letter])
        elif letter in _BRACKETS.values():
            if not open_brackets or open_brackets.pop() != letter:
                return None
        if (letter == "," and len(open_brackets) == 1) or not open_brackets:
            items.append(value[start:at].strip())
            start = at + 1
            if not open_brackets:
                return None if value[start:].strip() else ([] if items == [""] else items)
        begins = letter in "[{,:" or (begins and letter.isspace())
        at += 1
    return None


def _is_balanced(value: str) -> bool:
    """Whether every bracket is closed."""
    waiting: list[str] = []
    for letter in value:
        if letter in _BRACKETS:
            waiting.append(_BRACKETS[letter])
        elif letter in _BRACKETS.values() and (not waiting or waiting.pop() != letter):
            return False
    return not waiting

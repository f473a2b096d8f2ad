"""Python values as the ``key=value`` words of a command."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hood.app.settings.compose import TABLES, ConfigError
from hood.app.settings.overrides import bare_or_quoted, coded
from hood.assets.material import NO_GRADIENT

#: Keys of tables: names of parts in any alphabet, and of files.
_KEY = re.compile(r"[\w./+@-]+")
#: Keys of what is read from files, and how they are given.
_NAMES = {
    "garment": "a name, a file or a list of them, and to hood.simulate also by hood.Garment objects",
    "sequence": "a name (hood.names('motions')) or a file, and to hood.simulate also by a hood.PoseSequence",
    "body": "a name or a file, and to hood.simulate also by a hood.BodyMesh or a hood.Body",
    "checkpoint": "a name (hood.names('weights')) or a file",
}


def overrides(keys: Mapping[str, Any], group: str = "") -> list[str]:
    """Python values as the ``key=value`` words of a command.

    Args:
        keys: by name; None is ``null``, numbers and arrays of NumPy and torch are numbers and lists. A dictionary is a group
            of keys, of :data:`hood.app.settings.compose.TABLES` and in lists a table.
        group: what stands before every key, with a dot.

    Raises:
        ConfigError: a value that no command line can hold.
    """
    words: list[str] = []
    for key, value in keys.items():
        if isinstance(value, Mapping) and value and f"{group}{key}" not in TABLES:
            words += overrides(value, f"{group}{key}.")
        else:
            words.append(f"{group}{key}={_word(value, group + key)}")
    return words


def _word(value: Any, key: str) -> str:
    if key in _NAMES and not _may_name(value):
        raise ConfigError(f"{key} is given by {_NAMES[key]}, not as {_sort(value)}")
    if getattr(value, "requires_grad", False):
        raise ConfigError(f"{key}: {NO_GRADIENT}")
    if hasattr(value, "tolist"):  # of NumPy or torch
        value = value.tolist()
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, (list, tuple)):
        return f"[{','.join(_word(item, key) for item in value)}]"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{_key(name, key)}:{_word(item, key)}" for name, item in value.items()) + "}"
    if isinstance(value, (str, Path)):
        return bare_or_quoted(str(value))
    raise ConfigError(f"{key}={_sort(value)}: give a number, a word, a path, a list or a table of them, or None")


def _may_name(value: Any) -> bool:
    """Whether a value can be a name, or a list of some; lists are refused later where one name is wanted."""
    if isinstance(value, (list, tuple)):
        return all(map(_may_name, value))
    return value is None or isinstance(value, (str, Path, int, float, Mapping)) or getattr(value, "ndim", 1) == 0


def _sort(value: Any) -> str:
    """What a value is, without what it holds."""
    if hasattr(value, "tolist"):
        return f"an array {tuple(value.shape)}" if hasattr(value, "shape") else "an array"
    if isinstance(value, (list, tuple)):
        return f"a list of {_sort(value[0])}" if value else "an empty list"
    return f"an object of type {type(value).__name__}"


def _key(name: Any, key: str) -> str:
    text = str(name)
    if not _KEY.fullmatch(unicodedata.normalize("NFC", text)):
        raise ConfigError(f"{key}: {text!r} cannot be a key of a table; use letters, digits and _ . / + @ -")
    return coded(text)

"""Frame rates as files say them: under any of the usual keys, as numbers or as text."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

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

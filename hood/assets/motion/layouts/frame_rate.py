"""The frame rate of a motion, under every key and in every form in which files say it; a doubt where none does."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.doubt import Doubt
from hood.assets.motion.layouts.table import Layout, squeezed

#: Rates [1/s] that are taken from a file.
_SLOWEST, _FASTEST = 0.1, 1e5
_WHOSE = (
    "mocap|motion|video|source|src|original|orig|capture|captured|recorded|recording|sequence|seq|data|camera|cam|smpl|pose"
)
_RATE_KEY = re.compile(rf"({_WHOSE})?(framerate|fps|frequency|freq|samplingrate|samplerate|framespersecond)(hz|fps)?")
_TIME_KEY = re.compile(rf"({_WHOSE})?(frametime|framedt|timestep|dt)(s|sec|seconds)?")
#: Dicts within each other that are looked into.
_DEEPEST = 4
_SAID = re.compile(r"([0-9.eE+-]+)\s*(?:/\s*([0-9.]+))?\s*(?:fps|hz|1/s|frames per second)?", re.IGNORECASE)


def frame_rate(
    path: Path, sources: Sequence[Mapping[str, Any]], layout: Layout, given: float | None
) -> tuple[float, Doubt | None]:
    """Frames per second of a motion, and the doubt where it is assumed or said twice.

    Args:
        sources: what the file holds of the person, and the dicts in which that stands, which may say it as well.
        given: by the caller, instead of what the file says.

    Raises:
        ValueError: no number, out of range, or not there in a layout that has it; names file, key and fix.
    """
    if given is not None:
        if not _SLOWEST <= given <= _FASTEST:
            raise ValueError(f"{path}: file_fps={given}; give the file's frames per second, 0.1 to 100000")
        return float(given), None
    found = [(key, _rate(path, key, value)) for source in sources for key, value in rates_in(source)]
    if found:
        key, rate = found[0]
        other = next(((name, value) for name, value in found if abs(value / rate - 1.0) > 1e-3), None)
        if other is None:
            return rate, None
        said = f"{path}: says {key}={rate:g} and {other[0]}={other[1]:g}; {rate:g} is taken, file_fps={other[1]:g} is the other"
        return rate, Doubt("frame_rate", said, value=rate, unit="fps")
    if layout.fps is None:
        raise ValueError(f"{path}: no mocap_framerate: add it (frames per second) to the file, or pass file_fps=…")
    said = f"{path}: says no frame rate, {layout.fps:g} fps are assumed ({_reason(layout)}); file_fps=… gives the right one"
    return layout.fps, Doubt("frame_rate", said, value=layout.fps, unit="fps")


def rates_in(source: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Keys and values that say a frame rate, those of AMASS first; the inverse of those that say a time."""
    for key in sorted(source, key=lambda key: not squeezed(key).startswith("mocap")):
        short, value = squeezed(key), source[key]
        if value is None:
            continue
        if _RATE_KEY.fullmatch(short):
            yield key, value
        elif _TIME_KEY.fullmatch(short) and np.size(value) == 1:
            yield key, _inverse(value)
    if depth < _DEEPEST:
        for value in source.values():
            if isinstance(value, Mapping):
                yield from rates_in(value, depth + 1)


def parse_rate(value: Any) -> float:
    """The number that a rate stands for: ``120``, ``[120.]``, ``"29.97"``, ``b"120 fps"``, ``"30000/1001"``; NaN for others."""
    item = np.asarray(value).reshape(-1)
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


def _rate(path: Path, key: str, value: Any) -> float:
    rate = parse_rate(value)
    if not _SLOWEST <= rate <= _FASTEST:
        raise ValueError(
            f"{path}: {key} is {' '.join(str(value).split())[:40]}; it must be a positive number of frames per "
            "second (0.1 to 100000; file_fps=… overrides it)"
        )
    return rate


def _inverse(value: Any) -> float:
    seconds = parse_rate(value)
    return 1.0 / seconds if seconds > 0 else float("nan")


def _reason(layout: Layout) -> str:
    return f"as in {layout.name} files" if layout.name[0].isupper() or layout.name[0].isdigit() else "as in most videos"

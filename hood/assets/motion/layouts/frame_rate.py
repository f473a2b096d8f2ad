"""The frame rate of a motion, under every key and in every form in which files say it; a doubt where none does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hood.assets.files.doubt import Doubt
from hood.assets.files.frame_rates import parse_rate, rates_in
from hood.assets.motion.layouts.table import VIDEO_FPS, Layout

#: Rates [1/s] that are taken from a file.
_SLOWEST, _FASTEST = 0.1, 1e5


class Rate(NamedTuple):
    """A frame rate [1/s]. ``assumed``: neither the file nor the caller says it; ``doubt``: about it, where it counts."""

    fps: float
    assumed: bool = False
    doubt: Doubt | None = None


def frame_rate(
    path: Path, sources: Sequence[Mapping[str, Any]], layout: Layout, given: float | None, is_still: bool = False
) -> Rate:
    """The frame rate of a motion, and the doubt where it is assumed or said twice.

    Args:
        sources: what the file holds of the person, and the dicts in which that stands, which may say it as well.
        given: by the caller, instead of what the file says.
        is_still: a single pose, which is held at any rate: none need be said.

    Raises:
        ValueError: no number, out of range, or not there in a layout that has it; names file, key and fix.
    """
    if given is not None:
        if not _SLOWEST <= given <= _FASTEST:
            raise ValueError(f"{path}: file_fps={given}; give the file's frames per second, 0.1 to 100000")
        return Rate(float(given))
    found = [(key, _rate(path, key, value)) for source in sources for key, value in rates_in(source)]
    if found:
        key, rate = found[0]
        other = next(((name, value) for name, value in found if abs(value / rate - 1.0) > 1e-3), None)
        if other is None:
            return Rate(rate)
        said = f"{path}: says {key}={rate:g} and {other[0]}={other[1]:g}; {rate:g} is taken, file_fps={other[1]:g} is the other"
        return Rate(rate, doubt=Doubt("frame_rate", said, value=rate, unit="fps"))
    if is_still:
        return Rate(layout.fps or VIDEO_FPS, assumed=True)
    if layout.fps is None:
        raise ValueError(f"{path}: no mocap_framerate: add it (frames per second) to the file, or pass file_fps=…")
    said = f"{path}: says no frame rate, {layout.fps:g} fps are assumed ({_reason(layout)}); file_fps=… gives the right one"
    return Rate(layout.fps, assumed=True, doubt=Doubt("frame_rate", said, value=layout.fps, unit="fps"))


def _rate(path: Path, key: str, value: Any) -> float:
    rate = parse_rate(value)
    if not _SLOWEST <= rate <= _FASTEST:
        raise ValueError(
            f"{path}: {key} is {' '.join(str(value).split())[:40]}; it must be a positive number of frames per "
            "second (0.1 to 100000; file_fps=… overrides it)"
        )
    return rate


def _reason(layout: Layout) -> str:
    return f"as in {layout.name} files" if layout.name[0].isupper() or layout.name[0].isdigit() else "as in most videos"

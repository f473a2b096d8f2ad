"""Frames in words, and the worst of them."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

#: Runs of frames that a sentence names.
_MOST_RUNS = 4


def runs_of(chosen: np.ndarray) -> list[tuple[int, int]]:
    """First and last frame of every run of True in ``chosen`` (T,) bool."""
    frames = np.flatnonzero(chosen)
    if not len(frames):
        return []
    return [(int(run[0]), int(run[-1])) for run in np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)]


def mask_of(frames: Collection[int] | np.ndarray) -> np.ndarray:
    """(T,) bool, True at ``frames`` (N,), of which there is one at least; T is one more than the last of them."""
    chosen = np.zeros(max(frames) + 1, dtype=bool)
    chosen[np.asarray(frames)] = True
    return chosen


def name_frames(chosen: np.ndarray) -> str:
    """Where ``chosen`` (T,) bool holds, in words: ``frames 3, 7–9 and 12``; the first few runs of many."""
    runs = runs_of(chosen)
    texts = [f"{first}" if first == last else f"{first}–{last}" for first, last in runs]
    if len(texts) > _MOST_RUNS:
        more = sum(last - first + 1 for first, last in runs[_MOST_RUNS - 1 :])
        texts = [*texts[: _MOST_RUNS - 1], f"{more} more"]
    text = texts[0] if len(texts) == 1 else ", ".join(texts[:-1]) + f" and {texts[-1]}"
    return ("frame " if int(np.count_nonzero(chosen)) == 1 else "frames ") + text


def worst_frame(values: np.ndarray) -> tuple[float, int] | None:
    """The largest finite entry of ``values`` (T,) and its frame; None where there is none."""
    known = np.where(np.isfinite(values), values, -np.inf)
    if len(values) == 0 or not np.isfinite(known).any():
        return None
    frame = int(known.argmax())
    return float(values[frame]), frame

"""Frames in words, and the worst of them.

What makes frames bad, before it is decided whether there are too many of them.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from hood.assets.files.said import Doubt

#: Kinds of reasons, as they stand in ``summary.json``; these words stay.
KINDS = (
    "empty",  # no frame
    "not_finite",
    "not_worn",  # a part of the garment has come off
    "strain",  # torn, or stretched beyond what is cloth
    "distance",  # steps ended too far from their minimum
    "solver_target",  # the solver missed its target, and no distance was measured
    "gradient",  # the unbalanced force is too large, and no distance was measured
    "skin_through_cloth",  # a share of the cloth's triangles
    "skin_depth",  # how far it sticks out
    "inside_body",  # a share of the cloth's vertices
    "cloth_through_cloth",  # within one garment
    "garments_through_each_other",
)


@dataclass(frozen=True)
class Cause:
    """One kind of badness in the frames of a rollout."""

    kind: str  # of :data:`KINDS`
    text: str  # what is so in the bad frames; a whole sentence where ``whole``
    bad: np.ndarray  # (S,) bool
    values: np.ndarray | None = None  # (S,) of which the largest is named, in ``unit``
    limit: float | None = None
    unit: str = ""
    form: str = ".3g"
    shown_times: float = 1.0  # as in millimetres
    shown_unit: str = ""
    measured: np.ndarray | None = None  # (S,) bool; None: every frame
    part: int | None = None
    whole: bool = False

    @property
    def spread(self) -> np.ndarray:
        """(S,) bool: bad frames, one that was measured standing for those up to the next."""
        return self.bad if self.measured is None else standing_for(self.bad, self.measured)

    def shown(self, value: float) -> str:
        """A value in words."""
        return format(self.shown_times * value, self.form) + self.shown_unit


def standing_for(chosen: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """(S,) bool: where ``chosen`` (S,) holds in the last frame that was ``measured`` (S,) before or at each."""
    if not measured.any():
        return chosen
    last = np.maximum.accumulate(np.where(measured, np.arange(len(chosen)), -1))
    return np.asarray(np.where(last >= 0, chosen[last.clip(0)], False))


@dataclass(frozen=True)
class FoundFrames:
    """What a part of the rule has found: causes to be weighed, doubts, and what does not count."""

    causes: list[Cause] = field(default_factory=list)
    doubts: list[Doubt] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __add__(self, other: FoundFrames) -> FoundFrames:
        return FoundFrames(self.causes + other.causes, self.doubts + other.doubts, self.notes + other.notes)


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

"""The rule: whether a rollout can be trusted. One for what makes rollouts and for what reads them.

A rollout is unsound

- with a frame that is not finite;
- with a part of the garment that has come off (:mod:`hood.rollouts.verdict.worn`);
- with more than one bad frame, and more than 2% of all, or of those after the fifth where frame 0 was not at rest. A frame is
  bad where the cloth is torn, its step ended too far from the minimum, or skin or cloth come through the cloth.
  What is measured in every n-th frame stands for those up to the next; of five frames or fewer all after the start must be bad.
  Cloth that is torn to twice its length is judged in every frame, single ones as well. Of a limb that has gone through it, and
  of skin through a fiftieth of it, one frame is enough, however long the rollout is.

The numbers are those of :mod:`hood.limits`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hood.limits import CUT_FLASH, DEPTH_GROSS, SETTLING, STRAIN_TORN, TOLERATED
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.verdict.causes import causes_of, strain_of, unknown_steps
from hood.rollouts.verdict.frames import Cause, name_frames, runs_of, worst_frame
from hood.rollouts.verdict.surface import meshes_of
from hood.rollouts.verdict.unworn import worn_causes


@dataclass(frozen=True)
class Reason:
    """Why a rollout is unsound."""

    kind: str  # a stable word, see :data:`hood.rollouts.verdict.frames.KINDS`
    sentence: str  # the same in words, with the worst value
    frames: tuple[tuple[int, int], ...] = ()  # runs of bad frames, first and last
    value: float | None = None  # the worst
    frame: int | None = None  # where that is
    limit: float | None = None  # that the value is compared with
    unit: str = ""  # of both
    part: int | None = None  # of the garment, from 1

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**self.__dict__, "frames": [list(run) for run in self.frames]}


@dataclass(frozen=True)
class Verdict:
    """Sound, unsound, or, with None, not known."""

    sound: bool | None  # None: too little was measured
    reasons: tuple[Reason, ...] = ()  # why unsound, or what is missing
    doubts: tuple[dict[str, Any], ...] = ()  # :meth:`hood.assets.files.said.Doubt.as_dict`
    notes: tuple[str, ...] = ()  # what was seen and does not count, and why

    @property
    def sentences(self) -> tuple[str, ...]:
        """The reasons in words."""
        return tuple(reason.sentence for reason in self.reasons)


def judge_rollout(data: RolloutData) -> Verdict:
    """The verdict on the simulated frames of a rollout that was read back."""
    finite = data.step_finite
    if len(finite) == 0:
        return Verdict(None, (Reason("empty", "it holds no frame"),))
    meshes = meshes_of(data)
    strain = strain_of(data, meshes, finite)
    off, found = worn_causes(data, meshes, len(finite)), causes_of(data, meshes, finite, strain)
    reasons = [] if finite.all() else [_not_finite(finite)]
    reasons += [_reason(cause, np.ones(len(finite), dtype=bool), "frames") for cause in off.causes]
    torn = _torn(strain, len(finite))
    judged = _judged(len(finite), _settled(data)) | torn
    bad = np.any([cause.spread for cause in found.causes], axis=0) & judged if found.causes else np.zeros_like(judged)
    few = len(finite) <= SETTLING.value
    among = "frames" if few or judged[: int(SETTLING.value)].any() else "frames after the fifth"
    gross = any(_is_gross(cause, judged) for cause in found.causes)
    share = 0 if gross else max(TOLERATED.value * judged.sum(), 0 if torn.any() else 1)
    tolerated = judged.sum() - 1 if few else share
    if bad.sum() > tolerated:
        reasons += [_reason(cause, judged, among) for cause in found.causes if (cause.bad & judged).any()]
    doubts = (*stored_doubts(data), *(doubt.as_dict() for doubt in (*off.doubts, *found.doubts)))
    notes = (*off.notes, *found.notes)
    if reasons:
        return Verdict(False, tuple(reasons), doubts, notes)
    missing = _missing(data, judged, strain is not None)
    return Verdict(None if missing else True, missing, doubts, notes)


def stored_doubts(data: RolloutData) -> tuple[dict[str, Any], ...]:
    """Doubts about the inputs that the rollout was made from, as its file holds them; files from before hold none."""
    text = data.attributes.get("doubts")
    return () if text is None else tuple(json.loads(str(text)))


def _settled(data: RolloutData) -> bool:
    """Whether frame 0 was at rest."""
    reached = data.step_metrics.get("settle_reached")
    return reached is not None and len(reached) > 0 and bool(reached[0] == 1)


def _judged(count: int, settled: bool) -> np.ndarray:
    """(S,) bool: all frames where the start was at rest, else those after the fifth; of few all after the start."""
    few = count <= SETTLING.value
    first = min(1, count - 1) if few else 0 if settled else int(SETTLING.value)
    return np.arange(count) >= first


def _torn(strain: np.ndarray | None, count: int) -> np.ndarray:
    """(S,) bool: frames that are judged also where the start still settles."""
    if strain is None or count <= SETTLING.value:
        return np.zeros(count, dtype=bool)
    return np.asarray(np.nan_to_num(strain) > STRAIN_TORN.value)


#: What is seen in a single frame, by the kind of its cause: a limb that has gone through the cloth, and skin all over it.
_GROSS = {"skin_depth": DEPTH_GROSS, "skin_through_cloth": CUT_FLASH}


def _is_gross(cause: Cause, judged: np.ndarray) -> bool:
    """Whether one frame of it is seen."""
    if cause.kind not in _GROSS or cause.values is None:
        return False
    return bool((cause.values[cause.bad & judged] > _GROSS[cause.kind].value).any())


def _not_finite(finite: np.ndarray) -> Reason:
    text = f"{(~finite).sum()} of {len(finite)} frames are not finite: {name_frames(~finite)}"
    return Reason("not_finite", text, tuple(runs_of(~finite)))


def _reason(cause: Cause, judged: np.ndarray, among: str) -> Reason:
    which = cause.bad & judged
    worst = None if cause.values is None else worst_frame(np.where(which, cause.values, np.nan))
    counted = judged if cause.measured is None else judged & cause.measured
    text = f"{cause.text} in {which.sum()} of {counted.sum()} {among}: {name_frames(which)}"
    if cause.whole:
        text = cause.text
    elif worst is not None:
        text = f"{text}, worst {cause.shown(worst[0])} in frame {worst[1]}"
    value, frame = (None, None) if worst is None else worst
    return Reason(cause.kind, text, tuple(runs_of(which)), value, frame, cause.limit, cause.unit, cause.part)


def _missing(data: RolloutData, judged: np.ndarray, has_strain: bool) -> tuple[Reason, ...]:
    """What has to be known before a rollout is called sound, and is not."""
    if not has_strain:
        text = "the strain of simulated frames that are not stored was not measured; metrics=strain measures it"
        return (Reason("strain", text),)
    unknown = unknown_steps(data.step_metrics, judged)
    if unknown is None:
        return ()
    text = f"how far the steps to {name_frames(unknown)} ended from their minimum was not measured, so it cannot be judged"
    return (Reason("distance", f"{text}; metrics=all measures it", tuple(runs_of(unknown))),)


def sentences(reasons: Sequence[dict[str, Any]]) -> list[str]:
    """Of reasons or doubts as JSON holds them."""
    return [str(one["sentence"]) for one in reasons]

"""The verdict of a rollout (sound or unsound, and what is doubtful): in its summary, on the screen, as exit code.

What the exit codes mean: one table, for the commands and for the help.

What a rollout's file says about the cloth's surface: skin through cloth and cloth through cloth, in numbers and in words.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hood.limits import CUT_UNSOUND
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.verdict.frames import worst_frame
from hood.rollouts.verdict.rule import judge_rollout

#: A rollout that ran to its end and cannot be trusted.
UNSOUND = 3
#: A frame with a larger share of cut triangles is warned about.
WORST_CUT = CUT_UNSOUND.value


def summarise_surface(metrics: Mapping[str, np.ndarray], stride: int | None) -> dict[str, Any] | None:
    """Means and worst frames of :data:`hood.rollouts.verdict.surface.SURFACE_METRICS` by frame (T,); None where none was
    measured."""
    share = metrics.get("cut_face_share", np.empty(0))
    measured = int(np.isfinite(share).sum())
    if measured == 0:
        return None
    folds = metrics.get("cut_in_folds")  # older files have none
    apart = {} if folds is None else {"cut_apart_from_folds": _mean_and_worst(share - folds)}
    return {
        "stride": stride,
        "frames_measured": measured,
        "cut_face_share": _mean_and_worst(share),
        **apart,
        "cut_edge_share": _mean_and_worst(metrics["cut_edge_share"]),
        "skin_depth_m": _mean_and_worst(metrics["skin_depth"]),
        "self_crossings": _mean_and_worst(metrics["self_crossings"]),
        "garment_crossings": _mean_and_worst(metrics["garment_crossings"]),
    }


def describe_surface(surface: Mapping[str, Any] | None) -> list[str]:
    """A line on what was found, none where nothing was measured, and a warning for each thing that pictures show."""
    if surface is None:
        return []
    cut, depth, stride = surface["cut_face_share"], surface["skin_depth_m"], surface["stride"]
    every = "" if stride is None else " (every frame)" if stride == 1 else f" (one frame in {stride}, first and last)"
    crossed = [
        f"{surface[key]['mean']:.1f} pairs of triangles of {what} pass through each other on average"
        for key, what in (("self_crossings", "one garment"), ("garment_crossings", "two garments"))
        if surface[key]["worst"] > 0
    ]
    found = [
        f"the body cuts {cut['mean']:.1%} of the cloth's triangles on average, {cut['worst']:.1%} in frame {cut['frame']}"
        + _apart_from_folds(surface),
        f"skin at most {1e3 * depth['worst']:.1f} mm above the cloth",
        *crossed,
    ]
    return [f"surface{every}: {', '.join(found)}", *surface_warnings(surface)]


def _apart_from_folds(surface: Mapping[str, Any]) -> str:
    """What is left without the triangles that are caught where the body passes through itself; empty without such."""
    rest = surface.get("cut_apart_from_folds")
    if rest is None or rest["mean"] == surface["cut_face_share"]["mean"]:
        return ""
    return f" ({rest['mean']:.2%} and {rest['worst']:.2%} apart from where the body passes through itself)"


def cut_at_worst(surface: Mapping[str, Any] | None) -> str:
    """The worst frame in a few words, for a line among many."""
    return "skin through cloth n/a" if surface is None else f"skin cuts {surface['cut_face_share']['worst']:.1%} at worst"


def surface_warnings(surface: Mapping[str, Any]) -> list[str]:
    cut, lines = surface["cut_face_share"], []
    if cut["worst"] > WORST_CUT:
        lines.append(
            f"warning: the body's skin cuts {cut['worst']:.1%} of the cloth's triangles in frame {cut['frame']}; "
            "the verdict counts what a viewer sees of it"
        )
    for key, what in (("self_crossings", "the cloth"), ("garment_crossings", "two garments")):
        worst = surface[key]
        if worst["worst"] > 0:
            lines.append(
                f"warning: {worst['worst']:.0f} pairs of triangles of {what} pass through each other in frame {worst['frame']}"
            )
    return lines


def _mean_and_worst(values: np.ndarray) -> dict[str, Any]:
    """Over the measured ones of the frames; the first of equally bad frames is named."""
    worst = int(np.nanargmax(values))
    return {"mean": float(np.nanmean(values)), "worst": float(values[worst]), "frame": worst}


#: Metrics of which the worst frame is named beside the median.
_WORST = ("strain_p99", "distance_p99", "relative_gradient")
#: What ends with exit code 3; doubts are what ends so beside unsound results.
FAIL_ON = FAIL_ON_UNSOUND, FAIL_ON_DOUBTS, FAIL_ON_NOTHING = "unsound", "doubts", "nothing"


def summarise_verdict(data: RolloutData) -> dict[str, Any]:
    """Entries ``sound`` (None: not known), ``reasons`` and ``unsound_reasons`` (their sentences; what is missing, where not
    known), ``doubts``, ``notes`` and ``worst_frames``: docs/verdict.md has them as a schema."""
    verdict = judge_rollout(data)
    worst = {name: worst_frame(data.step_metrics[name]) for name in _WORST if name in data.step_metrics}
    return {
        "sound": verdict.sound,
        "reasons": [reason.as_dict() for reason in verdict.reasons],
        "unsound_reasons": list(verdict.sentences),
        "doubts": list(verdict.doubts),
        "notes": list(verdict.notes),
        "worst_frames": {name: {"value": found[0], "frame": found[1]} for name, found in worst.items() if found is not None},
    }


def describe_worst(summary: Mapping[str, Any], metric: str, form: str) -> str:
    """`` (worst 12.1% in frame 7)`` for the text behind a median; empty where nothing was measured."""
    found = summary["worst_frames"].get(metric)
    return "" if found is None else f" (worst {format(found['value'], form)} in frame {found['frame']})"


def describe_verdict(summary: Mapping[str, Any]) -> list[str]:
    """How far the steps were taken, what does not count, doubts, and the verdict with its reasons, a line each."""
    lines = [*_describe_distance(summary), *(f"not counted: {note}" for note in summary["notes"])]
    lines += [f"doubt: {doubt['sentence']}" for doubt in summary["doubts"]]
    reasons = summary["unsound_reasons"]
    if summary["sound"] is None:
        return [*lines, *(f"not judged: {reason}" for reason in reasons)]
    doubtful = f", with {_count(len(summary['doubts']), 'doubt')}" if summary["doubts"] else ""
    return [*lines, *(f"UNSOUND: {reason}" for reason in reasons)] if reasons else [*lines, f"sound{doubtful}"]


def _describe_distance(summary: Mapping[str, Any]) -> list[str]:
    """In millimetres where that was measured; else by the force that is left."""
    distance = summary["distance_p99_median_m"]
    if distance is not None:
        worst = summary["worst_frames"]["distance_p99"]
        return [
            f"distance to the minimum of a step (p99): {1e3 * distance:.2g} mm (worst {1e3 * worst['value']:.2g} mm in frame "
            f"{worst['frame']})"
        ]
    if summary["relative_gradient_median"] is None:
        return []
    worst_text = describe_worst(summary, "relative_gradient", ".2g")
    return [f"relative gradient {summary['relative_gradient_median']:.2g}{worst_text}"]


def exit_code(summaries: Iterable[Mapping[str, Any]], fail_on: str = FAIL_ON_UNSOUND) -> tuple[int, list[str]]:
    """3 where a guard has ended one of the rollouts, or one is what ``fail_on`` says, one of :data:`FAIL_ON`; and the sentences
    that say so."""
    summaries = list(summaries)
    if any((summary.get("guard") or {}).get("stopped") is not None for summary in summaries):
        return UNSOUND, []
    said: list[str] = []
    unsound = sum(summary.get("sound") is False for summary in summaries)
    doubtful = sum(bool(summary.get("doubts")) for summary in summaries) if fail_on == FAIL_ON_DOUBTS else 0
    if unsound and fail_on == FAIL_ON_NOTHING:
        said.append(f"{_are(unsound)} unsound, which fail_on=nothing allows")
        unsound = 0
    if unsound:
        said.append(f"{_are(unsound)} unsound; its files are kept, exit code {UNSOUND} (0 with fail_on=nothing)")
    if doubtful:
        said.append(f"{_are(doubtful)} doubtful; exit code {UNSOUND}, as fail_on=doubts asks")
    return UNSOUND if unsound or doubtful else 0, said


def _are(count: int) -> str:
    return "the rollout is" if count == 1 else f"{count} rollouts are"


def _count(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"

"""The verdict of a rollout (sound or unsound, and what is doubtful): in its summary, on the screen, as exit code."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any

from hood.commands.exit_codes import UNSOUND
from hood.dynamics.recorder import RolloutData
from hood.dynamics.verdict.frames import worst_frame
from hood.dynamics.verdict.rule import judge_rollout

#: Metrics of which the worst frame is named beside the median.
_WORST = ("strain_p99", "distance_p99", "relative_gradient")
#: What doubts do to the exit code.
DOUBTS = REPORT, REFUSE = "report", "refuse"


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


def exit_code(summaries: Iterable[Mapping[str, Any]], allow_unsound: bool, doubts: str = REPORT) -> int:
    """3 where a guard has ended one of the rollouts, one is unsound, unless that is allowed, or one has doubts that are to be
    refused; says so."""
    summaries = list(summaries)
    if any((summary.get("guard") or {}).get("stopped") is not None for summary in summaries):
        return UNSOUND
    unsound = sum(summary.get("sound") is False for summary in summaries)
    doubtful = sum(bool(summary.get("doubts")) for summary in summaries) if doubts == REFUSE else 0
    if unsound and allow_unsound:
        print(f"hood: {_are(unsound)} unsound, which allow_unsound=true allows", file=sys.stderr)
        unsound = 0
    if unsound:
        print(
            f"hood: {_are(unsound)} unsound; its files are kept, exit code {UNSOUND} (0 with allow_unsound=true)",
            file=sys.stderr,
        )
    if doubtful:
        print(f"hood: {_are(doubtful)} doubtful; exit code {UNSOUND}, as doubts=refuse asks", file=sys.stderr)
    return UNSOUND if unsound or doubtful else 0


def _are(count: int) -> str:
    return "the rollout is" if count == 1 else f"{count} rollouts are"


def _count(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"

"""The verdict of a rollout (sound or unsound): in its summary, on the screen, as exit code."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any

from hood.commands.exit_codes import UNSOUND
from hood.dynamics.recorder import RolloutData
from hood.dynamics.soundness import judge_rollout, worst_frame

#: Metrics of which the worst frame is named beside the median.
_WORST = ("strain_p99", "relative_gradient")


def summarise_verdict(data: RolloutData) -> dict[str, Any]:
    """Entries ``sound`` (None: not known), ``unsound_reasons`` (what is missing, where not known) and ``worst_frames``."""
    verdict = judge_rollout(data)
    worst = {name: worst_frame(data.step_metrics[name]) for name in _WORST if name in data.step_metrics}
    return {
        "sound": verdict.sound,
        "unsound_reasons": list(verdict.reasons),
        "worst_frames": {name: {"value": found[0], "frame": found[1]} for name, found in worst.items() if found is not None},
    }


def describe_worst(summary: Mapping[str, Any], metric: str, form: str) -> str:
    """`` (worst 12.1% in frame 7)`` for the text behind a median; empty where nothing was measured."""
    found = summary["worst_frames"].get(metric)
    return "" if found is None else f" (worst {format(found['value'], form)} in frame {found['frame']})"


def describe_verdict(summary: Mapping[str, Any]) -> list[str]:
    """The relative gradient where it is known, and the verdict with its reasons, a line each."""
    lines = []
    if summary["relative_gradient_median"] is not None:
        worst = describe_worst(summary, "relative_gradient", ".2g")
        lines.append(f"relative gradient {summary['relative_gradient_median']:.2g}{worst}")
    reasons = summary["unsound_reasons"]
    if summary["sound"] is None:
        return [*lines, *(f"not judged: {reason}" for reason in reasons)]
    return [*lines, *(f"UNSOUND: {reason}" for reason in reasons)] if reasons else [*lines, "sound"]


def exit_code(summaries: Iterable[Mapping[str, Any]], allow_unsound: bool) -> int:
    """3 where a guard has ended one of the rollouts, or one is unsound, unless that is allowed; says so."""
    summaries = list(summaries)
    if any((summary.get("guard") or {}).get("stopped") is not None for summary in summaries):
        return UNSOUND
    count = sum(summary.get("sound") is False for summary in summaries)
    if count == 0:
        return 0
    which = "the rollout is" if count == 1 else f"{count} rollouts are"
    if allow_unsound:
        print(f"hood: {which} unsound, which allow_unsound=true allows", file=sys.stderr)
        return 0
    print(f"hood: {which} unsound; its files are kept, exit code {UNSOUND} (0 with allow_unsound=true)", file=sys.stderr)
    return UNSOUND

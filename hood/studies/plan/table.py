"""What ``hood plan`` prints: a table and a paragraph.

What is said of every row of ``hood plan`` where combinations were searched in mm, and of other meshes and time steps.
"""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from hood.studies.plan.ablation import Effect
from hood.studies.plan.choices import PartChoice
from hood.studies.plan.decide import PlanVerdict, Tolerance, why_kept
from hood.studies.plan.discretisation import Apart
from hood.studies.plan.parts import Part

#: Decisions on what the chosen combination has.
_CHOSEN = ("left out", "taken")


def describe_plan(plan: Mapping[str, Any]) -> str:
    """The table and one paragraph."""
    where = ", ".join(f"{one['measured_from']} ({one['reason']})" for one in plan["windows"])
    lines = [
        f"measured from frames {where}; {plan['frames']} steps each; the full model takes {plan['full']['ms']:.1f} ms of the "
        f"processor a frame, "
        f"γ {short(plan['full']['gamma_p95'])}",
        "",
        f"{'row':<26}{'force/weight':>13}{'γ without':>11}{'p95':>10}{'mm p50':>9}{'p95':>8}{'ms':>8}{'saved':>8}  decision",
    ]
    for row in plan["rows"]:
        numbers = "".join(f"{_cell(row, key):>{width}}" for key, width in _COLUMNS)
        lines.append(f"{row['part']:<26}{numbers}  {row['decision']}: {row['reason']}")
    missed = plan["windows_without_minimum"]
    if missed:
        lines.append(f"γ is a lower bound in {missed} of {len(plan['windows'])} windows: the exact step was not reached there")
    return "\n".join([*lines, "", sentence(plan)])


_COLUMNS = (("force", 13), ("gamma_p50", 11), ("gamma_p95", 10), ("mm_p50", 9), ("mm", 8), ("ms", 8), ("saved", 8))


def _cell(row: Mapping[str, Any], key: str) -> str:
    if key not in row or (key == "force" and row[key] is None):
        return "-"
    if key == "saved":
        return f"{100 * row[key]:.0f}%"
    return f"{row[key]:.1f}" if key == "ms" else short(row[key])


def sentence(plan: Mapping[str, Any]) -> str:
    """What was decided, for someone who does not read tables."""
    needed = [row["part"] for row in plan["rows"] if row["decision"] == "kept" and row["reason"].startswith("without it")]
    if plan.get("combination"):
        return _found(plan) + (f" Not to be spared: {', '.join(needed)}." if needed else "")
    return f"{_left_out(plan)} Needed for this accuracy: {', '.join(needed) or 'nothing else that was looked at'}."


def _left_out(plan: Mapping[str, Any]) -> str:
    """Where parts alone are left out."""
    limit = plan["accuracy"]
    left = [row["part"] for row in plan["rows"] if row["decision"] in _CHOSEN]
    if not left:
        return f"Nothing is left out: no part both saves time and stays within {_asked(limit)}."
    found = plan["together"]
    error = f"{short(found['error'])} mm" if limit["unit"] == "mm" else f"γ = {short(found['error'])} more"
    return (
        f"Left out: {', '.join(left)}. Together this costs {error} where {_asked(limit)} was accepted, and saves "
        f"{100 * found['saved']:.0f}% of a frame ({plan['full']['ms']:.1f} ms before)."
    )


def _found(plan: Mapping[str, Any]) -> str:
    """Where a combination was searched by mm."""
    found, limit, budget = plan["combination"], plan["accuracy"], plan["budget_ms"]
    without = {row["part"] for row in plan["rows"] if row["decision"] == "left out"}
    names = [f"without {name}" if name in without else name for name in found["names"]]
    figures = f"{found['ms']:.1f} ms a frame instead of {found['full_ms']:.1f}, {short(found['mm'])} mm from the full model"
    figures += f" after {plan['frames']} frames (95th percentile; {short(found['mm_p50'])} in the median)"
    whole = " Run against the full model as a whole:" if names else ""
    chosen = f"{', '.join(names)}.{whole} {figures}." if names else f"the full model, {found['ms']:.1f} ms a frame."
    if not found["fits"]:
        return f"Nothing takes {budget:g} ms a frame or less; the nearest is {chosen}"
    if budget is None:
        return f"Chosen as the cheapest within {_asked(limit)} after {plan['frames']} frames: {chosen}"
    text = f"Chosen as the nearest to the full model within {budget:g} ms a frame: {chosen}"
    if limit["unit"] == "mm" and found["mm"] > limit["value"]:
        text += f" This misses {_asked(limit)}, which nothing meets in that time."
    return text


def _asked(limit: Mapping[str, Any]) -> str:
    return f"{limit['value']:g} mm" if limit["unit"] == "mm" else f"γ = {limit['value']:g}"


def plan_command(words: Sequence[str], chosen: Sequence[str]) -> str:
    """``hood rollout`` with the words of the scene and those that were chosen, which stand for earlier ones of the same key."""
    said = {word.partition("=")[0]: word for word in (*words, *chosen)}
    return shlex.join(["hood", "rollout", *said.values(), "output=outputs/mine"])


def short(value: float | None) -> str:
    """Two digits; ``broken`` for what is not finite."""
    return "broken" if value is None else f"{value:.2g}"


#: A part that is worth more than this γ is no simplification: without it accelerations are wrong by 1 g.
BROKEN = 1.0
#: Why what would do is not chosen, where something else is and where the full model is.
_OTHERWISE, _NOTHING = "what is chosen does it better", "no combination that was run as a whole did"
#: Why another mesh or time step is not chosen by γ.
_IN_MM = "another mesh or step has no γ: accuracy=5mm or budget_ms=… decides on it"


def broken(effect: Effect, full: Effect) -> bool:
    """Whether γ rises by more than :data:`BROKEN` over that of the full model."""
    return not Tolerance(BROKEN, "gamma").error(effect, full) <= BROKEN


def of_parts(
    parts: Sequence[Part],
    effects: Mapping[str, Effect],
    stay: Mapping[str, str],
    tolerance: Tolerance,
    names: Collection[str],
) -> dict[str, PlanVerdict]:
    """By part that was measured, where the combination ``names`` was chosen."""
    found, full = {}, effects[""]
    of_mm = tolerance if tolerance.unit == "mm" else Tolerance(float("inf"), "mm")
    for part in parts:
        if part.name not in effects:
            continue
        effect = effects[part.name]
        far = of_mm.say(effect.worst_mm)
        if part.name in names:
            verdict = PlanVerdict("left out", f"without it {far}, {100 * effect.saving(full):.0f}% of a frame saved")
        elif part.name not in stay and broken(effect, full):
            verdict = PlanVerdict("kept", f"without it γ = {Tolerance(BROKEN, 'gamma').error(effect, full):.2g} more")
        else:
            reason = why_kept(part.name, effect, full, of_mm, stay, ())
            verdict = PlanVerdict("kept", reason or f"{far} without it; {_why_else(names)}")
        found[part.name] = with_it(verdict) if part.instead else verdict
    return found


def of_choice(one: PartChoice, apart: Apart, full_ms: float, names: Collection[str] | None) -> PlanVerdict:
    """Of a mesh or time step, where the combination ``names`` was chosen; None where parts alone are decided on, by γ."""
    share = apart.frame_ms(one.pace) / full_ms
    far = f"{max(apart.mm):.2g} mm from what was asked for"
    if one.finer:
        return PlanVerdict("compared", f"finer: {far}, {share:.1f} times the time")
    said = f"{far}, {100 * (1 - share):.0f}% of the time saved"
    if names is None:
        return PlanVerdict("compared", f"{said}; {_IN_MM}")
    return PlanVerdict("taken", said) if one.name in names else PlanVerdict("not taken", f"{said}; {_why_else(names)}")


def _why_else(names: Collection[str]) -> str:
    return _OTHERWISE if names else _NOTHING


def with_it(verdict: PlanVerdict) -> PlanVerdict:
    """Of a way to take the steps, which is there or not."""
    decision = {"left out": "taken", "kept": "not taken"}.get(verdict.decision, verdict.decision)
    return PlanVerdict(decision, verdict.reason.replace("without it", "with it"))

"""What is said of every row of ``hood plan`` where combinations were searched in mm, and of other meshes and time steps."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from hood.commands.plan_choices import Choice
from hood.commands.plan_parts import Part
from hood.evaluation.decision import Tolerance, Verdict, why_kept
from hood.evaluation.elsewhere import Apart
from hood.evaluation.leaving_out import Effect

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
) -> dict[str, Verdict]:
    """By part that was measured, where the combination ``names`` was chosen."""
    found, full = {}, effects[""]
    of_mm = tolerance if tolerance.unit == "mm" else Tolerance(float("inf"), "mm")
    for part in parts:
        if part.name not in effects:
            continue
        effect = effects[part.name]
        far = of_mm.say(effect.worst_mm)
        if part.name in names:
            verdict = Verdict("left out", f"without it {far}, {100 * effect.saving(full):.0f}% of a frame saved")
        elif part.name not in stay and broken(effect, full):
            verdict = Verdict("kept", f"without it γ = {Tolerance(BROKEN, 'gamma').error(effect, full):.2g} more")
        else:
            reason = why_kept(part.name, effect, full, of_mm, stay, ())
            verdict = Verdict("kept", reason or f"{far} without it; {_why_else(names)}")
        found[part.name] = with_it(verdict) if part.instead else verdict
    return found


def of_choice(one: Choice, apart: Apart, full_ms: float, names: Collection[str] | None) -> Verdict:
    """Of a mesh or time step, where the combination ``names`` was chosen; None where parts alone are decided on, by γ."""
    share = apart.frame_ms(one.pace) / full_ms
    far = f"{max(apart.mm):.2g} mm from what was asked for"
    if one.finer:
        return Verdict("compared", f"finer: {far}, {share:.1f} times the time")
    said = f"{far}, {100 * (1 - share):.0f}% of the time saved"
    if names is None:
        return Verdict("compared", f"{said}; {_IN_MM}")
    return Verdict("taken", said) if one.name in names else Verdict("not taken", f"{said}; {_why_else(names)}")


def _why_else(names: Collection[str]) -> str:
    return _OTHERWISE if names else _NOTHING


def with_it(verdict: Verdict) -> Verdict:
    """Of a way to take the steps, which is there or not."""
    decision = {"left out": "taken", "kept": "not taken"}.get(verdict.decision, verdict.decision)
    return Verdict(decision, verdict.reason.replace("without it", "with it"))

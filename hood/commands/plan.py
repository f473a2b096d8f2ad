"""``hood plan``: what a scene needs of the model, what each part costs, and what would be lost without it."""

from __future__ import annotations

import hashlib
import shlex
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from omegaconf import DictConfig

from hood.assets.files.library import locate
from hood.commands.cloth_contact import potential_of
from hood.commands.common import held_folder, output_folder
from hood.commands.plan_file import write_plan
from hood.commands.plan_parts import Part, choose_parts
from hood.commands.plan_shown import differences, facts, show
from hood.commands.refinement import refined
from hood.commands.setup import Setup, check_config, make_stepper, set_up
from hood.config import ConfigError, load_config, with_words
from hood.dynamics.captured import network_of
from hood.dynamics.watched import WatchedStepper, lacking
from hood.evaluation.decision import QUANTILE, Decision, Tolerance, decide
from hood.evaluation.leaving_out import LEAD, Begun, Effect, Variant, active_terms, begin, measure, prices
from hood.evaluation.windows import Window, choose_windows
from hood.losses.layers import for_networks
from hood.media.plan_page import Difference

#: With ``accuracy=5mm``, γ may be so many times that of the windows, and this at least, before left-out energies come back.
_TIMES_PROBED, _LEAST_LIMIT = 3.0, 1e-3
#: Why parts whose absence nobody would notice are kept.
_UNSEEN = "a rollout would not notice where it is more"
#: Steps for which they stay then.
_HOLD = 15


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    own, words = _split(overrides)
    _check(words, own)
    output_folder(own)
    with held_folder(own) as folder:
        plan, shown = make_plan(words, own)
        write_plan(folder / "plan.json", plan)
        page = show(folder / "plan.html", plan, sentence(plan), shown)
    print(describe(plan))
    print(page)
    print(f"plan in {folder / 'plan.json'}; roll out by it: hood rollout plan={folder / 'plan.json'} output=outputs/mine")
    return 0


def make_plan(words: list[str], own: DictConfig) -> tuple[dict[str, Any], list[Difference]]:
    """The plan of a rollout with these words, measured here, and the largest differences that were seen.

    Args:
        own: the config of ``hood plan``.

    Raises:
        ConfigError, ValueError, FileNotFoundError: as for a rollout, and numbers of ``own`` that are none.
    """
    config, tolerance = _check(words, own)
    began = time.perf_counter()
    ready = set_up(config, make_stepper(config)[0])
    plan, shown = _probe(ready, [*words, *_settled_words(config, ready)], own, tolerance)
    return plan | {"asked": words, "seconds": time.perf_counter() - began, "facts": facts(ready)}, shown


def _check(words: list[str], own: DictConfig) -> tuple[DictConfig, Tolerance]:
    """The rollout's config and what is accepted, before anything is read."""
    config = load_config("rollout", words)
    check_config(config)
    for key, least, most in (("windows", 1, 5), ("frames", 1, 300)):
        if isinstance(own[key], bool) or not least <= int(own[key]) <= most:
            raise ConfigError(f"{key}={own[key]}: give a whole number from {least} to {most}")
    return config, _tolerance(own)


def _split(overrides: Sequence[str]) -> tuple[DictConfig, list[str]]:
    """The plan's own config, and the words of the rollout."""
    own = {str(key) for key in load_config("plan")}
    mine = [word for word in overrides if word.partition("=")[0].lstrip("+~") in own]
    words = [word for word in overrides if word not in mine]
    if any(word.partition("=")[0] == "plan" for word in words):
        raise ConfigError("plan=…: a plan is made of the full model; drop plan=…")
    return load_config("plan", mine), words


def _tolerance(own: DictConfig) -> Tolerance:
    try:
        return Tolerance.read(str(own.accuracy))
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _settled_words(asked: DictConfig, ready: Setup) -> list[str]:
    """What ``auto`` became."""
    alone = str(ready.config.stepper) == "newton"
    keys = [key for key in ("stepper", "refine") if asked[key] != ready.config[key] and not (alone and key == "refine")]
    return [f"{key}={ready.config[key]}" for key in keys]


def _variant(words: Sequence[str], ready: Setup) -> Variant:
    """The scene with these settings beside its own; its cloth, body and motion are those of the full model."""
    config = with_words(ready.config, words)
    check_config(config)
    stepper = refined(make_stepper(config)[0], config, ready.scene.cloth.num_vertices, potential_of(config))
    network = network_of(stepper)
    if network is not None:
        network.use_potential(for_networks(potential_of(config)))
    return Variant(stepper, potential_of(config), ready.scene)


def _probe(ready: Setup, words: list[str], own: DictConfig, tolerance: Tolerance) -> tuple[dict[str, Any], list[Difference]]:
    config, frames = ready.config, int(own.frames)
    parts = choose_parts(config, [str(name) for name in own.parts])
    if not parts:
        raise ConfigError("parts: this rollout has none that could be left out")
    full = Variant(ready.stepper, potential_of(config), ready.scene)
    count = min(int(config.num_frames), ready.scene.num_frames)
    windows = _windows(ready, count, own, frames)
    begun = begin(full, windows, str(config.settle))
    active, price = active_terms(full, begun), prices(full, begun)
    absent = {part.name: _why_absent(part, ready) for part in parts if part.term and part.term not in active}
    variants = {part.name: _variant(part.words, ready) for part in parts if part.name not in absent}
    stay = {part.name: part.stays or _UNSEEN for part in parts if part.stays or not part.watched}

    def enough(name: str, effect: Effect, of_full: Effect) -> bool:
        return name in stay or tolerance.hopeless(effect, of_full)

    effects = measure(full, variants, begun, frames, enough)

    def together(names: Sequence[str]) -> tuple[Effect, Effect]:
        lean = _variant(_words_of(parts, names), ready)
        left = lacking(lean.potential, full.potential)
        if len(names) == 1 and not left:
            return effects[""], effects[names[0]]
        if left:  # as a rollout takes its steps, with the price of what is left out
            potentials, limit = (lean.potential, full.potential), _limit(tolerance, [effects[name] for name in names])
            watched = WatchedStepper(lean.stepper, full.stepper, potentials, ready.scene, limit, _HOLD)
            lean = replace(lean, stepper=watched)
        found = measure(full, {"all": lean}, begun, frames)
        return found[""], found["all"]

    rivals = [[part.name for part in parts if part.rivals == name] for name in sorted({part.rivals for part in parts} - {""})]
    decision = decide(effects, absent, rivals, tolerance, together, stay, {part.name for part in parts if part.term})
    plan = _record(ready, words, parts, begun, effects, price, decision, tolerance, frames)
    watch = _watch(full, _variant(plan["chosen"], ready), [effects[name] for name in decision.left_out], tolerance)
    return plan | {"watch": watch}, differences(ready, begun, effects, frames)


def _limit(tolerance: Tolerance, left_out: Sequence[Effect]) -> float:
    """The γ above which left-out energies come back; with a length, some more than they had in the windows."""
    if tolerance.unit != "mm":
        return tolerance.value
    return max(_TIMES_PROBED * sum(effect.gamma_at(QUANTILE) for effect in left_out), _LEAST_LIMIT)


def _watch(full: Variant, lean: Variant, left_out: Sequence[Effect], tolerance: Tolerance) -> dict[str, float] | None:
    """When the left-out energies come back; None where none is left out."""
    if not lacking(lean.potential, full.potential):
        return None
    return {"limit": _limit(tolerance, left_out), "hold": _HOLD}


def _windows(ready: Setup, count: int, own: DictConfig, frames: int) -> list[Window]:
    try:
        return choose_windows(ready.scene.motion, count, int(own.windows), LEAD + frames + 1)
    except ValueError as error:
        raise ConfigError(f"frames={frames}: {error}") from error


def _why_absent(part: Part, ready: Setup) -> str:
    if part.term in ("collision", "friction") and ready.scene.motion.num_vertices == 0:
        return "there is no body"
    return "nothing in these windows comes near enough" if part.term == "layers" else "nothing in this scene uses it"


def _words_of(parts: Iterable[Part], names: Sequence[str]) -> list[str]:
    return list(dict.fromkeys(word for part in parts if part.name in names for word in part.words))


def _record(
    ready: Setup,
    words: list[str],
    parts: Sequence[Part],
    begun: Sequence[Begun],
    effects: dict[str, Effect],
    price: dict[str, float],
    decision: Decision,
    tolerance: Tolerance,
    frames: int,
) -> dict[str, Any]:
    full, chosen = effects[""], _words_of(parts, decision.left_out)
    rows = []
    for part in parts:
        verdict = decision.verdicts[part.name]
        row = {"part": part.name, "purpose": part.purpose, "words": list(part.words), "force": price.get(part.term)}
        row |= _numbers(effects[part.name], full) if part.name in effects else {}
        how = [f"parts=[{part.name}]", f"frames={frames}", f"windows={len(begun)}", f"accuracy={tolerance.text}"]
        command = shlex.join(["hood", "plan", *words, *how])
        rows.append({**row, "decision": verdict.decision, "reason": verdict.reason, "command": command})
    checkpoint = str(ready.config.checkpoint)
    network = network_of(ready.stepper) is not None and checkpoint != "untrained"
    together = None
    if decision.together is not None:
        together = _numbers(decision.together, full) | {"error": tolerance.error(decision.together, full)}
    return {
        "words": words,
        "chosen": chosen,
        "accuracy": {"value": tolerance.value, "unit": tolerance.unit},
        "windows": [{"first": one.window.first, "measured_from": one.frame, "reason": one.window.reason} for one in begun],
        "frames": frames,
        "full": _numbers(full, full),
        "windows_without_minimum": full.exact.count(False),
        "rows": rows,
        "together": together,
        "weights": hashlib.sha256(locate("weights", checkpoint).read_bytes()).hexdigest() if network else None,
    }


def _numbers(effect: Effect, full: Effect) -> dict[str, float | None]:
    found = {
        "gamma_p50": effect.gamma_at(0.5),
        "gamma_p95": effect.gamma_at(QUANTILE),
        "mm": effect.worst_mm,
        "ms": effect.median_ms,
        "saved": effect.saving(full),
        "windows": len(effect.gamma),
    }
    return {key: value if np.isfinite(value) else None for key, value in found.items()}


def describe(plan: dict[str, Any]) -> str:
    """The table and one paragraph."""
    where = ", ".join(f"{one['measured_from']} ({one['reason']})" for one in plan["windows"])
    lines = [
        f"measured from frames {where}; {plan['frames']} steps each; the full model takes {plan['full']['ms']:.1f} ms a frame, "
        f"γ {_short(plan['full']['gamma_p95'])}",
        "",
        f"{'part':<20}{'force/weight':>13}{'γ without':>11}{'p95':>10}{'mm':>9}{'saved':>8}  decision",
    ]
    for row in plan["rows"]:
        if "ms" in row:
            saved = f"{100 * row['saved']:>7.0f}%"
            numbers = f"{_short(row['gamma_p50']):>11}{_short(row['gamma_p95']):>10}{_short(row['mm']):>9}{saved}"
        else:
            numbers = f"{'-':>11}{'-':>10}{'-':>9}{'-':>8}"
        force = "-" if row["force"] is None else _short(row["force"])
        lines.append(f"{row['part']:<20}{force:>13}{numbers}  {row['decision']}: {row['reason']}")
    missed = plan["windows_without_minimum"]
    if missed:
        lines.append(f"γ is a lower bound in {missed} of {len(plan['windows'])} windows: the exact step was not reached there")
    return "\n".join([*lines, "", sentence(plan)])


def sentence(plan: dict[str, Any]) -> str:
    """What was decided, for someone who does not read tables."""
    limit = plan["accuracy"]
    asked = f"{limit['value']:g} mm" if limit["unit"] == "mm" else f"γ = {limit['value']:g}"
    left = [row["part"] for row in plan["rows"] if row["decision"] == "left out"]
    needed = [row["part"] for row in plan["rows"] if row["decision"] == "kept" and row["reason"].startswith("without it")]
    if not left:
        text = f"Nothing is left out: no part both saves time and stays within {asked}."
    else:
        found = plan["together"]
        error = f"{_short(found['error'])} mm" if limit["unit"] == "mm" else f"γ = {_short(found['error'])} more"
        text = (
            f"Left out: {', '.join(left)}. Together this costs {error} where {asked} was accepted, and saves "
            f"{100 * found['saved']:.0f}% of a frame ({plan['full']['ms']:.1f} ms before)."
        )
    return f"{text} Needed for this accuracy: {', '.join(needed) or 'nothing else that was looked at'}."


def _short(value: float | None) -> str:
    return "broken" if value is None else f"{value:.2g}"

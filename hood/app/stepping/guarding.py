"""The guard of a rollout: what a user says about it, and how its alarms are reported."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from hood.app.notices import say
from hood.app.settings.compose import ConfigError, build, require_choice
from hood.app.settings.rollout_settings import RolloutSettings, fixed_shapes, measurement, refinement
from hood.energies.potential import Potential
from hood.rollouts.checks.guard import (
    CHECK,
    CHECK_EVERY,
    CUT,
    FINITE,
    FORCE,
    INSIDE,
    MODES,
    SPEED,
    STRAIN,
    TARGET,
    TURN,
    Alarm,
    Guard,
)
from hood.rollouts.checks.step_repair import LEFT, REFINED, SOLVED
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.file.recorder import RolloutWriter
from hood.rollouts.verdict.frames import name_frames
from hood.steppers.newton import Stepper

OFF, REPAIR, STRICT = "off", "repair", "strict"
#: What is so in a frame, with the worst value and the limit.
_TEXTS = {
    FINITE: "positions that are not finite",
    TARGET: "the solver short of its target, relative gradient {value:.2g} at worst",
    STRAIN: "strain p99 beyond {limit:.0%}, {value:.0%} at worst",
    FORCE: "forces out of balance, {value:.3g} times the weight at worst, beyond {limit:.3g}",
    INSIDE: "a vertex {value:.2g} m inside the body at worst, beyond {limit:.2g}",
    CHECK: "strain p99 {value:.1%} away from that of a solver which goes on from the step, beyond {limit:.0%} (looked at in "
    f"every {CHECK_EVERY}th step and in those more strained than before; refine=5 or stepper=newton keeps nearer to it)",
    TURN: "the body turns by {value:.0f} degrees in a step, beyond {limit:.0f} (less with a higher fps=…)",
    SPEED: "the body moves by {value:.2g} m in a step, beyond {limit:.2g} (less with a higher fps=…)",
    CUT: "the skin cuts {value:.1%} of the cloth's triangles at worst, beyond {limit:.1%}",
}
#: Where an alarm of another cause has what its step comes to.
_MEASURED = {STRAIN: "strain", FORCE: "force", INSIDE: "depth"}


class GuardStopped(Exception):
    """``guard=strict`` has ended a rollout."""


def check_guard(config: RolloutSettings) -> None:
    """Raise ConfigError where the guard cannot do what is asked for."""
    require_choice(config, "guard", MODES)
    mode, step = str(config.guard), str(config.step)
    if not fixed_shapes(config):
        return
    if mode == REPAIR:
        raise ConfigError(f"guard=repair: step={step} has fixed shapes, a step that is repaired has not; use step=plain")
    if mode == STRICT and measurement(config).kind != "all":
        raise ConfigError(
            f"guard=strict: step={step} with metrics={measurement(config).kind} measures nothing that a guard could look at; "
            "use metrics=all"
        )


def make_guard(config: RolloutSettings, stepper: Stepper, potential: Potential) -> Guard | None:
    """A guard for one rollout; None, with a line where that is not what was asked for, where there is none."""
    mode = str(config.guard)
    if mode == OFF:
        return None
    if fixed_shapes(config) and measurement(config).kind != "all":
        say(
            f"guard=off: step={config.step} with metrics={measurement(config).kind} measures nothing that a guard could look at"
        )
        return None
    return Guard(mode, stepper, potential, build(config.solver), refinement(config).most)


def write_alarms(writer: RolloutWriter, guard: Guard | None) -> None:
    """Write what has been alarmed about since the last call."""
    if guard is not None and len(guard.alarms) > writer.alarms_done:
        writer.append_alarms([asdict(alarm) for alarm in guard.alarms[writer.alarms_done :]])


def summarise_guard(data: RolloutData) -> dict[str, Any]:
    """Entry ``guard`` of a summary: the alarms, how many frames have any, how many were repaired; empty where no guard looked.

    ``stopped`` is the frame that ``guard=strict`` ended the rollout before, None where it did not.
    """
    mode = str(data.attributes.get("guard", OFF))
    if mode == OFF:
        return {}
    rows, count = data.alarms, len(data.step_finite)
    kinds = {kind: sum(row["repair"] == kind for row in rows) for kind in (REFINED, SOLVED, LEFT)}
    return {
        "guard": {
            "mode": mode,
            "frames": len({row["frame"] for row in rows}),
            "causes": dict(Counter(row["cause"] for row in rows)),
            "repairs": kinds,
            "stopped": rows[0]["frame"] if mode == STRICT and rows else None,
            "sentence": guard_sentence(mode, [Alarm(**row) for row in rows], count),
            "alarms": [{key: None if value != value else value for key, value in row.items()} for row in rows],
        }
    }


def guard_sentences(entry: Mapping[str, Any] | None) -> list[str]:
    """The sentence on a guard's alarms; none without alarms."""
    return [entry["sentence"]] if entry and entry["sentence"] else []


def guard_sentence(mode: str, alarms: Sequence[Alarm], num_frames: int) -> str:
    """What is said of the alarms of a rollout; empty without any."""
    if not alarms:
        return ""
    if mode == STRICT:
        first = alarms[0]
        return (
            f"guard=strict: the rollout ends before frame {first.frame}: {_part(alarms[:1])}; the {num_frames} frames before "
            "it are kept"
        )
    causes = list(dict.fromkeys(alarm.cause for alarm in alarms))
    parts = [_named([alarm for alarm in alarms if alarm.cause == cause], alarms) for cause in causes]
    frames = len({alarm.frame for alarm in alarms})
    return f"guard: {frames} of {num_frames - 1} steps: {'; '.join([*parts, *_outcome(mode, alarms)])}"


def _part(alarms: Sequence[Alarm], all_alarms: Sequence[Alarm] = ()) -> str:
    """What was so, of one cause; the worst of ``all_alarms``, also of steps of which something graver is told."""
    text = _TEXTS.get(alarms[0].cause, "{value:.3g}, beyond {limit:.3g}")
    worst = max(alarms, key=lambda alarm: -math.inf if math.isnan(alarm.value) else alarm.value)
    measured = [getattr(alarm, _MEASURED[worst.cause]) for alarm in all_alarms] if worst.cause in _MEASURED else []
    return text.format(value=max([worst.value, *(value for value in measured if value > worst.value)]), limit=worst.limit)


def _named(alarms: Sequence[Alarm], all_alarms: Sequence[Alarm]) -> str:
    """The same with its frames."""
    chosen = np.zeros(1 + max(alarm.frame for alarm in alarms), dtype=bool)
    chosen[[alarm.frame for alarm in alarms]] = True
    return f"{_part(alarms, all_alarms)}, in {name_frames(chosen)}"


def _outcome(mode: str, alarms: Sequence[Alarm]) -> list[str]:
    steps = [alarm for alarm in alarms if alarm.mendable]
    if not steps:
        return []
    if mode != REPAIR:
        return ["guard=repair mends what it can"]
    repaired = sum(alarm.repair in (REFINED, SOLVED) for alarm in steps)
    return [f"{repaired} of {len(steps)} steps repaired"]

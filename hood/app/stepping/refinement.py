"""How far steps are refined (``refine``): checked, applied, reported."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from hood.app.settings.compose import ConfigError, brief, build, require_choice
from hood.app.settings.rollout_settings import Refinement, RolloutSettings, fixed_shapes, measurement, refinement
from hood.app.stepping.steppers import ALWAYS, NEVER, losses_of, option_of
from hood.assets.files.library import unknown
from hood.energies.potential import Potential
from hood.rollouts.frame import FIELD_CHOICES
from hood.solver.step_figures import count_reasons, name_counts
from hood.steppers.newton import Stepper
from hood.steppers.refined import METHODS, RefinedStepper
from hood.steppers.static_shapes.newton import minimizer_for
from hood.steppers.stopping import (
    Budget,
    Count,
    MaxStrain,
    StoppingCriterion,
    TargetResidual,
    costs_from_table,
    floor_from_table,
)

#: ``refine=auto``: as the garment's size needs (:mod:`hood.app.stepping.automatic`).
AUTO = "auto"
_COLOURS = ("none", "strain", "rg", "contact")
#: Units of goals, and an example of each: the unbalanced force as a share of the weight, the milliseconds of a frame, the 99th
#: percentile of the edge strain.
_SUCH_AS = {"rg": "0.1rg", "ms": "20ms", "%": "5%"}
_GOAL = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?) ?(rg|ms|%)")
_WAYS = "refine=5, refine=0.1rg, refine=20ms or refine=5%"
_BEGIN_FROM_TABLE = ("ms", "%")
#: An iteration in units of a frame without any, where none was taken: 0.3 of garments of 1,000 to 4,000 vertices; and how
#: much more than the median frame is given.
_ITERATION, _ROOM = 0.4, 1.1


class AskedRefinement(NamedTuple):
    """What ``refine`` asks for: iterations where ``unit`` is empty, else a goal, a share where it is ``rg`` or ``%``."""

    value: float
    unit: str
    text: str  # refine=5
    how: Refinement


def chosen(config: Mapping[Any, Any]) -> AskedRefinement | None:
    """What ``refine`` asks for; None where nothing is refined, and while it is left to ``auto``.

    Raises:
        ConfigError: it is neither a number of iterations nor a goal.
    """
    how = refinement(config)
    value = how.goal
    if value in (0, AUTO):
        return None
    if isinstance(value, (int, float)) and float(value).is_integer():
        return AskedRefinement(float(value), "", f"refine={value:g}", how)
    found = _GOAL.fullmatch(str(value))
    if found is None:
        raise ConfigError(
            f"refine={brief(value)}: give a whole number of iterations, or auto, or a goal such as 0.1rg (unbalanced force), "
            "20ms (time of a frame) or 5% (strain)"
        )
    number, unit = found.groups()
    goal = float(Decimal(number) / 100 if unit == "%" else Decimal(number))
    if not 0.0 < goal < math.inf:
        raise ConfigError(f"refine={value}: give a goal above 0, such as {_SUCH_AS[unit]}")
    return AskedRefinement(goal, unit, f"refine={value}", how)


def check_refinement(config: RolloutSettings) -> None:
    """Raise ConfigError where what is said about refinement, export and colour does not fit together."""
    asked, how = chosen(config), refinement(config)
    if how.method not in METHODS:
        raise ConfigError(f"refine={brief(config.refine)}: " + unknown("method", how.method, METHODS))
    require_choice(config, "colour", _COLOURS)
    if config.colour == "contact" and config.body == "none":
        raise ConfigError("colour=contact shows the distance from the body, and body=none has none; choose colour=strain")
    exported(config)
    if how.most < 1:
        raise ConfigError(f"refine={brief(config.refine)}: most is {how.most}; it must be at least 1")
    if asked is None:
        if option_of(config).refinement == ALWAYS:
            raise ConfigError(f"stepper={config.stepper} takes its steps by refinement alone; give {_WAYS}")
        if how != Refinement(how.goal):
            raise ConfigError(f"refine={brief(config.refine)}: nothing is refined; give a goal as well, refine={{goal:5,…}}")
        return
    if option_of(config).refinement == NEVER:
        raise ConfigError(f"{asked.text}: stepper={config.stepper} goes as far as solver.* says; use stepper=refine instead")
    if how.table is not None and asked.unit not in _BEGIN_FROM_TABLE:
        raise ConfigError(
            f"refine={brief(config.refine)}: its table says where refine=20ms and refine=5% begin; {asked.text} needs none"
        )
    make_goal(config, num_vertices=1000)


def exported(config: RolloutSettings) -> tuple[str, ...]:
    """Values of every vertex that go into the file: those asked for, and what pictures are coloured by.

    Raises:
        ConfigError: an unknown one.
    """
    names = measurement(config).fields
    for name in names:
        if name not in FIELD_CHOICES:
            choices = ",".join(FIELD_CHOICES)
            raise ConfigError(f"metrics={brief(config.metrics)}: unknown field {brief(name)!r}; give some of [{choices}]")
    drawn = str(config.colour)
    return tuple(dict.fromkeys([*names, *([drawn] if drawn in FIELD_CHOICES else [])]))


def make_goal(config: RolloutSettings, num_vertices: int) -> StoppingCriterion | None:
    """A new goal for one rollout of a cloth of this size; None where nothing is refined.

    Raises:
        ConfigError, ValueError: a value that no refinement can have.
    """
    asked = chosen(config)
    if asked is None:
        return None
    how = asked.how
    if not asked.unit:
        return Count(int(asked.value))
    if asked.unit == "rg":
        return TargetResidual(asked.value, how.most)
    table = None if how.table is None else Path(how.table).expanduser()
    if asked.unit == "ms":
        return Budget(asked.value, how.most, None if table is None else costs_from_table(table, num_vertices, how.method))
    return (
        MaxStrain(asked.value, how.most)
        if table is None
        else MaxStrain(asked.value, how.most, floor_from_table(table, asked.value, num_vertices, how.method))
    )


def refined(stepper: Stepper, config: RolloutSettings, num_vertices: int, potential: Potential | None = None) -> Stepper:
    """The stepper with its steps refined as the config says, down ``potential`` (default: its losses): itself where it says
    nothing."""
    goal = make_goal(config, num_vertices)
    if goal is None:
        return stepper
    potential = losses_of(config) if potential is None else potential
    method, settings = refinement(config).method, build(config.solver)
    fixed = method == "newton" and fixed_shapes(config)
    minimizer = minimizer_for(str(config.step), settings, torch.device(str(config.device))) if fixed else None
    return RefinedStepper(stepper, potential, goal, method, settings, minimizer)


def summarise_refinement(config: Mapping[str, Any], metrics: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Entry ``refinement`` of a summary: what was asked for, iterations and accuracy, frames that met it and that missed it.

    Frames count from the first step on. A frame meets a time with its own from one frame to the next, ``ms_total``.
    """
    asked = chosen(config)
    if asked is None or "refine_iterations" not in metrics:
        return {}
    iterations, residual = metrics["refine_iterations"][1:], metrics["refine_rg"][1:]
    entry: dict[str, Any] = {
        "asked": asked.text,
        "method": asked.how.method,
        "iterations_median": _of(np.median, iterations),
        "iterations_max": _of(np.max, iterations),
        "rg_median": _of(np.median, residual),
        "rg_p95": _of(lambda values: np.quantile(values, 0.95), residual),
        "steps_ended": count_reasons(metrics.get("refine_reason", np.zeros(0))),
    }
    met = metrics.get("refine_met")
    if asked.unit == "ms":
        times = metrics["ms_total"]
        met = np.where(np.isfinite(times), times <= asked.value, np.nan)
        entry["ms_p95"] = _of(lambda values: np.quantile(values, 0.95), times)
        entry |= _unrefined(iterations, times[1:], metrics.get("ms_refine", times)[1:])
        entry["budget_used_median"] = _of(lambda values: np.median(values) / asked.value, times)
    if met is not None:
        seen = met[1:][np.isfinite(met[1:])]
        entry |= {"frames_met": int((seen == 1).sum()), "frames_missed": int((seen == 0).sum())}
    return {"refinement": entry}


def describe_refinement(summary: Mapping[str, Any]) -> list[str]:
    """The entry in a line; none where nothing was refined."""
    entry = summary.get("refinement")
    if entry is None:
        return []
    iterations, residual = entry["iterations_median"], entry["rg_median"]
    text = f"refined, {entry['asked']}: median {iterations or 0:.0f} iterations ({entry['method']})"
    # Where every frame's is measured, it is told with its worst.
    told = residual is None or summary.get("relative_gradient_median") is not None
    text += "" if told else f", relative gradient {residual:.2g}"
    if entry["steps_ended"]:
        text += "; steps ended: " + name_counts(entry["steps_ended"])
    if "frames_met" in entry:
        text += f"; {entry['frames_met']} frames met it, {entry['frames_missed']} missed it"
    return [text, *_describe_unrefined(entry)]


def _unrefined(iterations: np.ndarray, times: np.ndarray, refining: np.ndarray) -> dict[str, Any]:
    """Frames without an iteration, what they take [ms], and a budget that has room for one; empty where most have some."""
    without = (iterations == 0) & np.isfinite(times)
    seen = without | (iterations > 0)
    if 2 * without.sum() <= seen.sum():
        return {}
    spent, some = float(np.median(times[without])), iterations > 0
    one = float(np.median(refining[some] / iterations[some])) if some.any() else _ITERATION * spent
    return {
        "frames_unrefined": int(without.sum()),
        "ms_unrefined": spent,
        "budget_for_one": float(np.ceil(_ROOM * (spent + one))),
    }


def _describe_unrefined(entry: Mapping[str, Any]) -> list[str]:
    if not entry.get("frames_unrefined"):
        return []
    count, total = entry["frames_unrefined"], entry["frames_met"] + entry["frames_missed"]
    return [
        f"{entry['asked']} is used up before the first iteration in {count} of {total} frames, which are not refined at all "
        f"and take {entry['ms_unrefined']:.1f} ms; about refine={entry['budget_for_one']:g}ms has room for one"
    ]


def _of(function: Any, values: np.ndarray) -> float | None:
    values = values[np.isfinite(values)]
    return float(function(values)) if len(values) else None

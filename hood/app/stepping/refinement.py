"""The keys of refinement (``refine``, ``target_rg``, ``budget_ms``, ``max_strain``): checked, applied, reported."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from hood.app.settings.compose import ConfigError, brief, build, plain, require_choice
from hood.app.stepping.steppers import ALWAYS, NEVER, losses_of, option_of
from hood.energies.potential import Potential
from hood.rollouts.frame import FIELD_CHOICES
from hood.solver.step_figures import count_reasons, name_counts
from hood.steppers.newton import Stepper
from hood.steppers.refined import METHODS, RefinedStepper
from hood.steppers.stopping import (
    Budget,
    Count,
    MaxStrain,
    StoppingCriterion,
    TargetResidual,
    costs_from_table,
    floor_from_table,
)

#: The ways to say how far a step is refined; a user gives one of them.
REFINEMENT_KEYS = ("refine", "target_rg", "budget_ms", "max_strain")
#: ``refine=auto``: as the garment's size needs (:mod:`hood.app.stepping.automatic`).
AUTO = "auto"
_COLOURS = ("none", "strain", "rg", "contact")
_BEGIN_FROM_TABLE = ("budget_ms", "max_strain")
#: An iteration in units of a frame without any, where none was taken: 0.3 of garments of 1,000 to 4,000 vertices; and how
#: much more than the median frame is given.
_ITERATION, _ROOM = 0.4, 1.1
#: What says more about a refinement, and its value where nothing is said.
_DETAILS = {"refine_method": "newton", "refine_most": 50, "refine_table": None}


def chosen(config: Mapping[Any, Any]) -> tuple[str, float] | None:
    """Name and value of the refinement key that is set; None where there is none, and while it is left to ``auto``.

    Raises:
        ConfigError: two are set, or the value is no number.
    """
    given = [*(["refine"] if config.get("refine") not in (None, 0, AUTO) else []), *other_refinement_keys(config)]
    if len(given) > 1:
        text = " and ".join(f"{name}={config[name]}" for name in given)
        raise ConfigError(
            f"{text}: these say in {len(given)} ways how far a step is refined; give one of {', '.join(REFINEMENT_KEYS)}"
        )
    if not given:
        return None
    value = config[given[0]]
    whole = given[0] != "refine" or (isinstance(value, (int, float)) and float(value).is_integer())
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not whole:
        what = "a whole number of iterations, or auto" if given[0] == "refine" else "a number"
        raise ConfigError(f"{given[0]}={brief(value)}: give {what}")
    return given[0], float(value)


def other_refinement_keys(config: Mapping[Any, Any]) -> list[str]:
    """The refinement keys but ``refine`` that are set."""
    return [name for name in REFINEMENT_KEYS if name != "refine" and config.get(name) is not None]


def check_refinement(config: DictConfig) -> None:
    """Raise ConfigError where what is said about refinement, export and colour does not fit together."""
    asked = chosen(config)
    require_choice(config, "refine_method", METHODS)
    require_choice(config, "colour", _COLOURS)
    if config.colour == "contact" and config.body == "none":
        raise ConfigError("colour=contact shows the distance from the body, and body=none has none; choose colour=strain")
    exported(config)
    if int(config.refine_most) < 1:
        raise ConfigError(f"refine_most={config.refine_most}: must be at least 1")
    if asked is None:
        if option_of(config).refinement == ALWAYS:
            raise ConfigError(
                f"stepper={config.stepper} takes its steps by refinement alone; give one of {', '.join(REFINEMENT_KEYS)}"
            )
        for name, default in _DETAILS.items():
            if config[name] != default:
                raise ConfigError(
                    f"{name}={config[name]}: nothing is refined; give one of {', '.join(REFINEMENT_KEYS)} as well"
                )
        return
    if option_of(config).refinement == NEVER:
        raise ConfigError(
            f"{asked[0]}={config[asked[0]]}: stepper={config.stepper} goes as far as solver.* says; use stepper=refine instead"
        )
    if config.refine_table is not None and asked[0] not in _BEGIN_FROM_TABLE:
        raise ConfigError(
            f"refine_table={config.refine_table}: says where {' and '.join(_BEGIN_FROM_TABLE)} begin; {asked[0]} needs none"
        )
    make_goal(config, num_vertices=1000)


def exported(config: DictConfig) -> tuple[str, ...]:
    """Values of every vertex that go into the file: those asked for, and what pictures are coloured by.

    Raises:
        ConfigError: an unknown one.
    """
    names = [str(name) for name in plain(config.export)]
    for name in names:
        if name not in FIELD_CHOICES:
            raise ConfigError(
                f"export={brief(config.export)}: unknown {brief(name)!r}; give some of [{','.join(FIELD_CHOICES)}]"
            )
    drawn = str(config.colour)
    return tuple(dict.fromkeys([*names, *([drawn] if drawn in FIELD_CHOICES else [])]))


def make_goal(config: DictConfig, num_vertices: int) -> StoppingCriterion | None:
    """A new goal for one rollout of a cloth of this size; None where nothing is refined.

    Raises:
        ConfigError, ValueError: a value that no refinement can have.
    """
    asked = chosen(config)
    if asked is None:
        return None
    name, value = asked
    most = int(config.refine_most)
    if name == "refine":
        return Count(int(value))
    if name == "target_rg":
        return TargetResidual(value, most)
    table = None if config.refine_table is None else Path(str(config.refine_table)).expanduser()
    method = str(config.refine_method)
    if name == "budget_ms":
        return Budget(value, most, None if table is None else costs_from_table(table, num_vertices, method))
    return (
        MaxStrain(value, most)
        if table is None
        else MaxStrain(value, most, floor_from_table(table, value, num_vertices, method))
    )


def refined(stepper: Stepper, config: DictConfig, num_vertices: int, potential: Potential | None = None) -> Stepper:
    """The stepper with its steps refined as the config says, down ``potential`` (default: its losses): itself where it says
    nothing."""
    goal = make_goal(config, num_vertices)
    if goal is None:
        return stepper
    potential = losses_of(config) if potential is None else potential
    return RefinedStepper(stepper, potential, goal, str(config.refine_method), build(config.solver))


def summarise_refinement(config: Mapping[str, Any], metrics: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Entry ``refinement`` of a summary: the key, iterations and accuracy reached, frames that met it and that missed it.

    Frames count from the first step on. A frame meets ``budget_ms`` with its time from one frame to the next, ``ms_total``.
    """
    asked = chosen(config)
    if asked is None or "refine_iterations" not in metrics:
        return {}
    name, value = asked
    iterations, residual = metrics["refine_iterations"][1:], metrics["refine_rg"][1:]
    entry: dict[str, Any] = {
        "asked": f"{name}={value:g}",
        "method": str(config["refine_method"]),
        "iterations_median": _of(np.median, iterations),
        "iterations_max": _of(np.max, iterations),
        "rg_median": _of(np.median, residual),
        "rg_p95": _of(lambda values: np.quantile(values, 0.95), residual),
        "steps_ended": count_reasons(metrics.get("refine_reason", np.zeros(0))),
    }
    met = metrics.get("refine_met")
    if name == "budget_ms":
        times = metrics["ms_total"]
        met = np.where(np.isfinite(times), times <= value, np.nan)
        entry["ms_p95"] = _of(lambda values: np.quantile(values, 0.95), times)
        entry |= _unrefined(iterations, times[1:], metrics.get("ms_refine", times)[1:])
        entry["budget_used_median"] = _of(lambda values: np.median(values) / value, times)
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
        f"and take {entry['ms_unrefined']:.1f} ms; about budget_ms={entry['budget_for_one']:g} has room for one"
    ]


def _of(function: Any, values: np.ndarray) -> float | None:
    values = values[np.isfinite(values)]
    return float(function(values)) if len(values) else None

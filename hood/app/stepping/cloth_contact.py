"""``cloth_contact=``: whether layers of cloth are kept apart, what that comes to in a rollout, and sentences on it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from hood.app.notices import say
from hood.app.settings.compose import ConfigError, brief, plain
from hood.app.settings.rollout_settings import RolloutSettings, cloth_contact, fixed_shapes, refinement
from hood.app.stepping.refinement import chosen
from hood.app.stepping.steppers import MAY, losses_of, option_of
from hood.assets.files.library import unknown
from hood.energies.potential import Potential, with_soft_pins
from hood.energies.self_contact import LayerBarrier, LayerFriction
from hood.energies.term import Role, Term, having
from hood.mesh import cloth_proximity
from hood.native.build import BuildError
from hood.solver.step_figures import LAYER_METRICS

_CHOICES = ("auto", "on", "off", "layers")


def check_cloth_contact(config: RolloutSettings) -> None:
    """Raise ConfigError where the key asks for what the other keys rule out."""
    mode, friction = cloth_contact(config)
    if mode not in _CHOICES:
        raise ConfigError(unknown("value for cloth_contact", mode, _CHOICES))
    if not 0.0 <= friction < math.inf:
        raise ConfigError(
            f"cloth_contact={brief(config.cloth_contact)}: friction is {friction}; give a coefficient of at least 0; 0 for none"
        )
    if mode in ("on", "layers"):
        reason = _hindrance(config)
        if reason and not (refinement(config).goal == "auto" or str(config.stepper) == "auto"):
            raise ConfigError(f"cloth_contact={mode}: {reason}")


def potential_of(config: RolloutSettings) -> Potential:
    """The potential of the config's losses and of soft pins, with a barrier and friction between layers of cloth where
    ``cloth_contact`` and the rest of the settled config ask for them."""
    potential: Potential = losses_of(config)
    if plain(config.pins) is not None:
        potential = with_soft_pins(potential)
    asked = cloth_contact(config)
    if asked.mode == "off" or _why_not(config, potential):
        return potential
    potential = potential.with_terms(layers=LayerBarrier(between=asked.mode == "layers"))
    return potential.with_terms(layer_friction=LayerFriction(float(asked.friction))) if asked.friction > 0 else potential


def check_soft_pins(config: RolloutSettings, soft: bool) -> None:
    """Raise ConfigError where pins are ``soft`` and nobody in the settled config knows of them."""
    if soft and option_of(config).network and chosen(config) is None:
        raise ConfigError(
            "pins: weights below 1 are springs, of which a network alone knows nothing; add refine=5, use stepper=newton, or "
            "leave weights out"
        )


def acts(config: RolloutSettings) -> bool:
    """Whether layers of cloth are kept apart.

    Raises:
        ConfigError: the key asks for it, but the settled config's steps cannot do it.
    """
    return cloth_contact(config).mode != "off" and not why_not(config)


def why_not(config: RolloutSettings) -> str:
    """Why layers are not kept apart in the settled config, with the way out; empty where they are, or nobody asks.

    Raises:
        ConfigError: the key asks for it, but the config's steps cannot do it.
    """
    return _why_not(config)


def _why_not(config: RolloutSettings, potential: Potential | None = None) -> str:
    """The same, with the potential of the config's losses where it is known."""
    asked = cloth_contact(config).mode
    reason = "" if asked == "off" else _hindrance(config, potential)
    if reason and asked != "auto":
        raise ConfigError(f"cloth_contact={asked}: {reason}")
    return reason


def tell_if_off(config: RolloutSettings, garments: int) -> None:
    """A line where contact that may be expected does not act: where the solver takes or refines the steps, and a warning where
    several garments start as they are, one through the other."""
    reason = why_not(config)
    if garments > 1 and plain(config.layers) != "auto" and not acts(config):
        warnings.warn("outfit: layers=… has no effect where cloth_contact is off", stacklevel=2)
    if reason and garments > 1:
        warnings.warn(
            f"outfit: the {garments} garments are not kept apart, and not taken apart at the start: {reason}", stacklevel=2
        )
    elif reason and not _rough(config):
        say(f"cloth_contact=auto: off; {reason}")


def _hindrance(config: RolloutSettings, potential: Potential | None = None) -> str:
    """Why layers cannot be kept apart in this rollout, with the way out; empty where they can. ``potential`` is that of the
    config's losses, where it is known."""
    if _rough(config):
        taker = "a network" if option_of(config).network else f"stepper={config.stepper}"
        return f"{taker} alone does not keep layers of cloth apart; add refine=5, or use stepper=newton"
    method, mode = refinement(config).method, cloth_contact(config).mode
    if method != "newton":
        return f"refine={{method:{method},…}} moves vertices through cloth; use method:newton"
    if fixed_shapes(config):
        return f"step={config.step} has fixed shapes, which contact of cloth with cloth has not; use step=plain"
    terms = (potential or losses_of(config)).terms
    if mode == "auto" and _are_published(terms):
        return "losses=… are those of published code, which has none; cloth_contact=on adds it"
    try:
        cloth_proximity.library()
    except BuildError as error:
        return str(error)
    return ""


def _are_published(terms: Mapping[str, Term]) -> bool:
    """Whether contact with the body is that of published code, and no other."""
    found = having(terms, Role.CONTACT, Role.FRICTION).values()
    others = [term for term in found if term.role is Role.CONTACT and not term.published]
    return not others and any(term.published for term in found)


def _rough(config: RolloutSettings) -> bool:
    """Whether nobody refines steps that may be refined."""
    return option_of(config).refinement == MAY and chosen(config) is None


def summarise_cloth_contact(config: Mapping[str, Any], metrics: Mapping[str, np.ndarray], reason: str = "") -> dict[str, Any]:
    """What ``summary.json`` says of it; nothing of files from before. ``reason`` is that of :func:`why_not`."""
    if "cloth_contact" not in config:
        return {}
    asked, friction = cloth_contact(config)
    if "layer_contacts" not in metrics:
        return {"cloth_contact": {"asked": asked, "used": "off"} | ({"reason": reason} if reason else {})}
    known = [np.nan_to_num(np.asarray(metrics.get(name, 0.0 * metrics["layer_contacts"]))) for name in LAYER_METRICS]
    near, crossed, released, overflow, ms, lag = known
    frames = np.flatnonzero(near > 0)
    return {
        "cloth_contact": {
            "asked": asked,
            "used": "layers" if asked == "layers" else "on",
            "friction": float(friction),
            "frames_with_contact": len(frames),
            "first_frame": int(frames[0]) if len(frames) else None,
            "last_frame": int(frames[-1]) if len(frames) else None,
            "contacts_max": int(near.max(initial=0.0)),
            "frames_with_crossed_cloth": [int(frame) for frame in np.flatnonzero((crossed > 0) | (overflow > 0))],
            "crossed_pairs_max": int(crossed.max(initial=0.0)),
            "frames_with_forced_pairs": [int(frame) for frame in np.flatnonzero(released > 0)],
            "frames_with_late_pins": [int(frame) for frame in np.flatnonzero(lag > 0)],
            "pin_lag_max": float(lag.max(initial=0.0)),
            "ms_median": float(np.median(ms[1:])) if len(ms) > 1 else None,
        }
    }


def describe_cloth_contact(summary: Mapping[str, Any]) -> list[str]:
    """Lines on it: when layers touched and what that cost, and where they could not be kept apart; where cloth went through
    cloth, why nothing kept it apart."""
    found = summary.get("cloth_contact")
    if found is None:
        return []
    if found["used"] == "off":
        crossed = _has_crossings(summary.get("surface"))
        return [f"cloth against cloth: off; {found['reason']}"] if crossed and "reason" in found else []
    touched = (
        "no frame"
        if not found["frames_with_contact"]
        else (
            f"{found['frames_with_contact']} frames ({found['first_frame']} to {found['last_frame']}), "
            f"up to {found['contacts_max']} pairs of features"
        )
    )
    lines = [f"cloth against cloth: {touched}; {found['ms_median'] or 0.0:.1f} ms a frame (median)"]
    crossed, forced = found["frames_with_crossed_cloth"], found["frames_with_forced_pairs"]
    if crossed:
        lines.append(
            f"{len(crossed)} steps (the first to frame {crossed[0]}) began with cloth through cloth, up to "
            f"{found['crossed_pairs_max']} pairs of triangles; these are left out until they come apart: "
            "start from cloth that is not crossed"
        )
    late = found.get("frames_with_late_pins")
    if late:
        lines.append(
            f"in {len(late)} frames (the first {late[0]}) held vertices stop up to {1e3 * found['pin_lag_max']:.1f} mm short "
            "of where they should be: cloth is in their way, and they go on when it makes room (pins=… holds fewer vertices)"
        )
    if forced:
        lines.append(
            f"in {len(forced)} steps (the first to frame {forced[0]}) held vertices drive cloth through cloth; these pairs are "
            "left out: let pins move more slowly, or hold fewer vertices (pins=…)"
        )
    return lines


def _has_crossings(surface: Mapping[str, Any] | None) -> bool:
    return surface is not None and any(surface[key]["worst"] > 0 for key in ("self_crossings", "garment_crossings"))

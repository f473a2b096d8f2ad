"""Warnings where a network is used outside the range that it was trained for; nothing is refused."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import replace

from hood.dynamics.captured import network_of
from hood.dynamics.ranges import Conditions, different, outside, scene_conditions
from hood.dynamics.refine import RefinedStepper
from hood.dynamics.stepper import Stepper
from hood.losses.layer_sides import LayerSides
from hood.losses.layers import LAYER_TERMS
from hood.losses.potential import Potential, default_potential
from hood.losses.term import named
from hood.scene.motion import BodyMotion
from hood.scene.scene import Scene
from hood.solver.forces import CLOSED_FORM


def scene_cautions(stepper: Stepper, scene: Scene, potential: Potential, name: str) -> list[str]:
    """Of a rollout: one sentence on values outside of what the network ``name`` was trained for, and one on a potential that
    it does not look at. None where a solver takes the steps."""
    betas = scene.motion.betas if isinstance(scene.motion, BodyMotion) else None
    gravity = float(stepper.gravity.norm())
    asked = scene_conditions(scene.garment, scene.cloth, scene.dt, potential, betas, gravity, scene.sizes)
    if scene.grip is not None:
        low, high = asked.spans["material.friction"]
        on_body = {"material.friction": (low * float(scene.grip.min()), high * float(scene.grip.max()))}
        asked = replace(asked, spans={**asked.spans, **on_body})
    way_out = "stepper=newton needs no weights" + ("" if _is_refined(stepper) else ", refine=10 corrects every step")
    sentences = []
    strange = strange_values(stepper, {scene.garment.name: asked})
    if strange:
        sentences.append(f"{name} was not trained for {strange}; the motion may be wrong: {way_out}")
    unseen = unseen_potential(stepper, asked)
    if unseen:
        sentences.append(f"{unseen}: {name} does not look at the potential; moved by it: stepper=newton{_or_refined(stepper)}")
    return sentences


def evaluation_cautions(steppers: Mapping[str, Stepper], asked: Mapping[str, Conditions]) -> list[str]:
    """The same of an evaluation of ``steppers`` by name, each on garments by name; models of whom the same is said share it."""
    sentences: dict[str, list[str]] = {}
    for name, stepper in steppers.items():
        way_out = "newton (stepper=newton) needs no weights"
        way_out += "" if _is_refined(stepper) else ", NAME+10 (refine=10) corrects every step"
        strange = strange_values(stepper, asked)
        if strange:
            text = f"not trained for {strange}; the motion may be wrong: {way_out}"
            sentences.setdefault(text, []).append(name)
        unseen = unseen_potential(stepper, next(iter(asked.values())))
        if unseen:
            text = f"{unseen}: the model does not look at the potential; moved by it: stepper=newton{_or_refined(stepper)}"
            sentences.setdefault(text, []).append(name)
    return [f"{', '.join(names)}: {text}" for text, names in sentences.items()]


def strange_values(stepper: Stepper, asked: Mapping[str, Conditions]) -> str:
    """What lies outside the stepper's training for garments by name, in words; empty for nothing, and where nothing is known.

    What is said of every garment is said once.
    """
    network = network_of(stepper)
    if network is None or network.trained_for is None:
        return ""
    found = {}
    for garment, conditions in asked.items():
        if not network.looks_at_potential:  # unseen_potential speaks of it
            conditions = Conditions(conditions.spans, network.trained_for.potential)
        found[garment] = outside(network.trained_for, conditions)
    shared = [text for text in next(iter(found.values())) if all(text in texts for texts in found.values())]
    parts = [", ".join(shared)] if shared else []
    for garment, texts in found.items():
        own = [text for text in texts if text not in shared]
        parts += [f"{', '.join(own)} of {garment}"] if own else []
    return "; ".join(parts)


def unseen_potential(stepper: Stepper, asked: Conditions) -> str:
    """What is said of the potential to a network that does not look at it, where it is not the network's own; else empty."""
    network = network_of(stepper)
    if network is None or network.looks_at_potential:
        return ""
    if network.trained_for is None:
        texts = different(default_potential().settings, asked.potential, "default")
    else:
        texts = different(network.trained_for.potential, asked.potential)
    if not texts:
        return ""
    measured = "what is measured and how steps are refined, not what is predicted"
    return f"{', '.join(texts)} changes only {measured if _is_refined(stepper) else 'what is measured, not the motion'}"


def known_by_slope(stepper: Stepper, potential: Potential) -> list[str]:
    """One sentence on energies whose curvature the solver does not know, where it takes or refines the steps; else none."""
    if network_of(stepper) is not None and not _is_refined(stepper):
        return []
    known = (*CLOSED_FORM, *LAYER_TERMS, LayerSides)
    names = [named(name, term) for name, term in potential.terms.items() if type(term) not in known]
    if not names:
        return []
    return [f"{', '.join(names)}: the solver knows the slope alone, not how stiff it is; stiff terms take many iterations"]


def warn(sentences: Iterable[str]) -> None:
    """Warn of each, see :func:`hood.commands.notices.heard`."""
    for sentence in sentences:
        warnings.warn(sentence, stacklevel=2)


def _or_refined(stepper: Stepper) -> str:
    return "" if _is_refined(stepper) else ", refine=10"


def _is_refined(stepper: Stepper) -> bool:
    return isinstance(stepper, RefinedStepper)

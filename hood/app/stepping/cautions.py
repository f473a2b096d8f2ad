"""Warnings where a network is used outside the range that it was trained for; nothing is refused.

Keys that a command gives and that do nothing beside its other keys: each is told in a line, none is passed over.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from omegaconf import DictConfig

from hood.app.settings.compose import NETWORK_KEYS, plain
from hood.app.settings.rollout_settings import Measurement, RolloutSettings, Settings, cloth_contact, measurement
from hood.app.stepping.steppers import option_of
from hood.energies.potential import Potential, default_potential
from hood.energies.term import Form, Role, having, named
from hood.scene.body_motion.motion import BodyMotion
from hood.scene.scene import Scene
from hood.steppers.newton import Stepper
from hood.steppers.ranges import Conditions, different, outside, scene_conditions
from hood.steppers.refined import RefinedStepper
from hood.steppers.static_shapes.simulator import network_of


def scene_cautions(stepper: Stepper, scene: Scene, potential: Potential, name: str) -> list[str]:
    """Of a rollout: the sentence that the weights of the network ``name`` bring along, one on values outside of what it was
    trained for, and one on a potential that it does not look at. None where a solver takes the steps."""
    betas = scene.motion.betas if isinstance(scene.motion, BodyMotion) else None
    gravity = float(stepper.gravity.norm())
    asked = scene_conditions(scene.garment, scene.cloth, scene.dt, potential, betas, gravity, scene.sizes)
    if scene.friction_scale is not None:
        low, high = asked.spans["material.friction"]
        on_body = {"material.friction": (low * float(scene.friction_scale.min()), high * float(scene.friction_scale.max()))}
        asked = replace(asked, spans={**asked.spans, **on_body})
    way_out = "stepper=newton needs no weights" + ("" if _is_refined(stepper) else ", refine=10 corrects every step")
    network = network_of(stepper)
    sentences = [f"{name}: {network.caution}"] if network is not None and network.caution else []
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
        network = network_of(stepper)
        if network is not None and network.caution:
            sentences.setdefault(network.caution, []).append(name)
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
    known = having(potential.terms, *Form, Role.TRAINING)
    names = [named(name, term) for name, term in potential.terms.items() if name not in known]
    if not names:
        return []
    return [f"{', '.join(names)}: the solver knows the slope alone, not how stiff it is; stiff terms take many iterations"]


def warn(sentences: Iterable[str]) -> None:
    """Warn of each, see :func:`hood.app.notices.heard`."""
    for sentence in sentences:
        warnings.warn(sentence, stacklevel=2)


def _or_refined(stepper: Stepper) -> str:
    return "" if _is_refined(stepper) else ", refine=10"


def _is_refined(stepper: Stepper) -> bool:
    return isinstance(stepper, RefinedStepper)


class _Rule(NamedTuple):
    """A key, when it acts, and what it waits for."""

    key: str
    acts: Callable[[Any], Any]  # its settings
    why: str


def _is_drawn(config: RolloutSettings) -> bool:
    return str(config.video) != "none" or bool(config.sheet)


def _is_measured_as_asked(config: RolloutSettings) -> bool:
    asked = measurement(config)
    return asked.kind == "all" or asked.surface_every == Measurement().surface_every


def _rubs_what_is_kept_apart(config: RolloutSettings) -> bool:
    asked = cloth_contact(config)
    return asked.mode != "off" or asked.friction == 0


_ROLLOUT = (
    _Rule("fabrics_seam", lambda config: config.fabrics is not None, "fabrics are not given"),
    _Rule("metrics", _is_measured_as_asked, "the surface is measured with kind:all alone"),
    _Rule("picture", _is_drawn, "nothing is drawn: video=none sheet=false"),
    _Rule("colour", lambda config: _is_drawn(config) or str(config.colour) == "rg", "nothing is drawn: video=none sheet=false"),
    _Rule("cloth_contact", _rubs_what_is_kept_apart, "there is no friction with mode:off"),
)
_TRAIN = (
    _Rule("data.validation_sequences", lambda config: int(config.trainer.validate_every), "trainer.validate_every is 0"),
    _Rule("data.validation_frames", lambda config: int(config.trainer.validate_every), "trainer.validate_every is 0"),
    _Rule("validation_states", lambda config: int(config.trainer.validate_every), "trainer.validate_every is 0"),
)


def idle_in_rollout(words: Sequence[str], config: RolloutSettings) -> list[str]:
    """A line for each of the words of a rollout that does nothing; its config has them."""
    return [*_without_network(words, config), *_idle(_ROLLOUT, words, config)]


def idle_in_training(words: Sequence[str], config: DictConfig) -> list[str]:
    """The same for a training."""
    return list(_idle(_TRAIN, words, config))


def _idle(rules: Sequence[_Rule], words: Sequence[str], config: Settings) -> Iterator[str]:
    given = {word.partition("=")[0]: word for word in words}
    for rule in rules:
        if rule.key in given and not rule.acts(config):
            yield f"{given[rule.key]} has no effect: {rule.why}"


def _without_network(words: Sequence[str], config: RolloutSettings) -> list[str]:
    """What is said of a network where none takes the steps."""
    given = [word for word in words if word.partition("=")[0].split(".")[0] in NETWORK_KEYS]
    if not given or option_of(config).network or plain(config.get("plan")) not in (None, "auto", "full"):
        return []
    return [f"{' '.join(given)} has no effect: with stepper={config.stepper} no network takes the steps"]

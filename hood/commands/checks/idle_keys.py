"""Keys that a command gives and that do nothing beside its other keys: each is told in a line, none is passed over."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from omegaconf import DictConfig

from hood.commands.steppers import option_of
from hood.config import NETWORK_KEYS, plain


class _Rule(NamedTuple):
    """A key, when it acts, and what it waits for."""

    key: str
    acts: Callable[[DictConfig], Any]
    why: str


def _is_drawn(config: DictConfig) -> bool:
    return str(config.video) != "none" or bool(config.sheet)


_ROLLOUT = (
    _Rule("blend_from", lambda config: float(config.blend_in) > 0, "blend_in is 0"),
    _Rule("size_seconds", lambda config: config.size_end is not None, "size_end is not given"),
    _Rule("fabrics_seam", lambda config: config.fabrics is not None, "fabrics are not given"),
    _Rule("events_speed", lambda config: len(config.events), "events are not given"),
    _Rule("surface_stride", lambda config: str(config.metrics) == "all", "the surface is measured with metrics=all alone"),
    _Rule("video_stride", lambda config: str(config.video) != "none", "video=none"),
    _Rule("thin_body", _is_drawn, "nothing is drawn: video=none sheet=false"),
    _Rule("colour", lambda config: _is_drawn(config) or str(config.colour) == "rg", "nothing is drawn: video=none sheet=false"),
    _Rule("cloth_friction", lambda config: str(config.cloth_contact) != "off", "cloth_contact=off"),
)
_TRAIN = (
    _Rule("data.validation_sequences", lambda config: int(config.trainer.validate_every), "trainer.validate_every is 0"),
    _Rule("data.validation_frames", lambda config: int(config.trainer.validate_every), "trainer.validate_every is 0"),
    _Rule("validation_states", lambda config: int(config.trainer.validate_every), "trainer.validate_every is 0"),
)


def idle_in_rollout(words: Sequence[str], config: DictConfig) -> list[str]:
    """A line for each of the words of a rollout that does nothing; its config has them."""
    return [*_without_network(words, config), *_idle(_ROLLOUT, words, config)]


def idle_in_training(words: Sequence[str], config: DictConfig) -> list[str]:
    """The same for a training."""
    return list(_idle(_TRAIN, words, config))


def _idle(rules: Sequence[_Rule], words: Sequence[str], config: DictConfig) -> Iterator[str]:
    given = {word.partition("=")[0]: word for word in words}
    for rule in rules:
        if rule.key in given and not rule.acts(config):
            yield f"{given[rule.key]} has no effect: {rule.why}"


def _without_network(words: Sequence[str], config: DictConfig) -> list[str]:
    """What is said of a network where none takes the steps."""
    given = [word for word in words if word.partition("=")[0].split(".")[0] in NETWORK_KEYS]
    if not given or option_of(config).network or plain(config.get("plan")) not in (None, "auto", "full"):
        return []
    return [f"{' '.join(given)} has no effect: with stepper={config.stepper} no network takes the steps"]

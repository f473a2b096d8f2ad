"""The steps of a rollout with other settings, beside those of its settled config, and the scenes that they are taken in."""

from __future__ import annotations

from collections.abc import Sequence

from omegaconf import DictConfig

from hood.commands.cloth_contact import potential_of
from hood.commands.plan_choices import scene_of
from hood.commands.refinement import refined
from hood.commands.setup import Setup, check_config, make_stepper, solves_in_double
from hood.commands.steppers import make_solver, option_of, with_stepper
from hood.config import with_words
from hood.dynamics.captured import network_of
from hood.evaluation.leaving_out import Variant
from hood.losses.layers import for_networks
from hood.scene.scene import Scene


class Variants:
    """Makes variants of a rollout; a scene is made once for every mesh, time step and precision that they need."""

    def __init__(self, ready: Setup) -> None:
        self.config = ready.config
        self.full = Variant(ready.stepper, potential_of(ready.config), ready.scene)
        self._scenes: dict[tuple[tuple[str, ...], bool], Scene] = {((), solves_in_double(ready.config)): ready.scene}

    def make(self, words: Sequence[str], other: tuple[str, ...] = ()) -> Variant:
        """The steps by further settings, in the scene with the words of ``other`` choices, in the precision they need.

        Raises:
            ConfigError, ValueError: settings that do not go with this rollout, or weights that cannot be used.
        """
        config = settled_with(words, self.config)
        key = other, solves_in_double(config)
        if key not in self._scenes:
            self._scenes[key] = scene_of(config, other)
        return variant(config, self._scenes[key])

    def full_in(self, scene: Scene) -> Variant:
        """The full model in one of the scenes."""
        return self.full if scene is self.full.scene else variant(self.config, scene)


def settled_with(words: Sequence[str], config: DictConfig) -> DictConfig:
    """A settled config with further settings, a stepper among them."""
    steppers = [word.partition("=")[2] for word in words if word.startswith("stepper=")]
    base = with_stepper(config, steppers[-1]) if steppers else config
    config = with_words(base, [word for word in words if not word.startswith("stepper=")])
    check_config(config)
    return config


def variant(config: DictConfig, scene: Scene) -> Variant:
    """What a settled config says of the steps, in a scene whose cloth, body and motion are given."""
    potential, option = potential_of(config), option_of(config)
    stepper = make_stepper(config)[0] if option.network else make_solver(option, config, potential, str(config.step))
    stepper = refined(stepper, config, scene.cloth.num_vertices, potential)
    network = network_of(stepper)
    if network is not None:
        network.use_potential(for_networks(potential))
    return Variant(stepper, potential, scene)

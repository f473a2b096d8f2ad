"""What a rollout could be done with instead: coarser and finer meshes of its garment, and other time steps.

The steps of a rollout with other settings, beside those of its settled config, and the scenes that they are taken in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hood.app.settings.compose import plain
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import Setup, check_config, make_scene, make_stepper, solves_in_double
from hood.app.stepping.cloth_contact import acts, potential_of
from hood.app.stepping.refinement import refined
from hood.app.stepping.steppers import make_solver, option_of, with_stepper
from hood.assets.files.library import names
from hood.energies.self_contact import for_networks
from hood.scene.held_layers import with_held_layers_apart
from hood.scene.scene import Scene
from hood.steppers.static_shapes.simulator import network_of
from hood.studies.plan.ablation import Variant

#: Frames a second below which a motion is not shown as one; beyond the other, steps are shorter than any motion needs.
_LEAST_FPS, _MOST_FPS = 24.0, 240.0
#: Kinds of choices.
MESH, TIME_STEP = "mesh", "time step"


@dataclass(frozen=True)
class PartChoice:
    """Another mesh or time step.

    Args:
        kind: :data:`MESH` or :data:`TIME_STEP`; of every kind at most one is taken.
        words: the settings.
        pace: its steps for one step of the full model.
        finer: it is finer than what was asked for: it is compared, never taken.
    """

    name: str
    kind: str
    purpose: str
    words: tuple[str, ...]
    pace: float = 1.0
    finer: bool = False


def choices_of(config: RolloutSettings) -> list[PartChoice]:
    """Of a settled config of ``hood rollout``; the coarsest mesh first, finer ones last."""
    return [*_meshes(config), *_time_steps(config)]


def choose_choices(config: RolloutSettings, asked: list[str]) -> list[PartChoice]:
    """Those of the names; where none is given all that are coarser, and the shorter time step."""
    there = choices_of(config)
    if asked:
        return [one for one in there if one.name in asked]
    return [one for one in there if not (one.finer and one.kind == MESH)]


def scene_of(config: RolloutSettings, words: Sequence[str]) -> Scene:
    """The scene of a settled config with the words of choices.

    Raises:
        ConfigError, ValueError, FileNotFoundError: as for a rollout.
    """
    other = config.with_words(words)
    scene = make_scene(other)
    return with_held_layers_apart(scene) if acts(other) else scene


def levels_of(garment: str) -> dict[str, int]:
    """Embedded meshes of the same garment with their thousands of vertices, coarse to fine: ``dress``, ``dress_4k``, …"""
    known, stem = names("garments"), garment.partition("_")[0]
    if garment not in known:
        return {}
    sizes = {name: int(name.rpartition("_")[2].rstrip("k")) for name in known if name.startswith(f"{stem}_")}
    return dict(sorted({stem: 1, **sizes}.items(), key=lambda pair: pair[1]))


def _meshes(config: RolloutSettings) -> list[PartChoice]:
    own = plain(config.garment)
    levels = levels_of(own) if isinstance(own, str) else {}
    if not levels or _by_vertices(config):
        return []
    found = []
    for name, size in levels.items():
        if name != own:
            finer = size > levels[own]
            purpose = "narrower folds" if finer else "fewer vertices, wider folds"
            found.append(PartChoice(f"mesh {name}", MESH, purpose, (f"garment={name}",), finer=finer))
    return found


def _by_vertices(config: RolloutSettings) -> bool:
    """Whether the config names vertices, which are those of one mesh: pins and parts by number or list."""
    pins = plain(config.pins)
    given = [*(pins if isinstance(pins, list) else [pins]), *(plain(config.fabrics) or {})]
    return any(isinstance(one, int) or str(one).endswith((".txt", ".json")) for one in given if one is not None)


def _time_steps(config: RolloutSettings) -> list[PartChoice]:
    """Twice and half as many steps; none for networks, which know the step of their training, and where frames are named."""
    if option_of(config).network or plain(config.events):
        return []
    fps, found = float(config.fps), []
    for pace, purpose in ((0.5, "fewer, longer steps"), (2.0, "shorter steps: motion is followed more closely")):
        if _LEAST_FPS <= pace * fps <= _MOST_FPS:
            frames = round((int(config.num_frames) - 1) * pace) + 1
            words = (f"fps={pace * fps:g}", f"num_frames={frames}")
            found.append(PartChoice(f"{pace * fps:g} fps", TIME_STEP, purpose, words, pace, finer=pace > 1.0))
    return found


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


def settled_with(words: Sequence[str], config: RolloutSettings) -> RolloutSettings:
    """A settled config with further settings, a stepper among them."""
    steppers = [word.partition("=")[2] for word in words if word.startswith("stepper=")]
    base = with_stepper(config, steppers[-1]) if steppers else config
    config = base.with_words([word for word in words if not word.startswith("stepper=")])
    check_config(config)
    return config


def variant(config: RolloutSettings, scene: Scene) -> Variant:
    """What a settled config says of the steps, in a scene whose cloth, body and motion are given."""
    potential, option = potential_of(config), option_of(config)
    stepper = make_stepper(config)[0] if option.network else make_solver(option, config, potential, str(config.step))
    stepper = refined(stepper, config, scene.cloth.num_vertices, potential)
    network = network_of(stepper)
    if network is not None:
        network.use_potential(for_networks(potential))
    return Variant(stepper, potential, scene)

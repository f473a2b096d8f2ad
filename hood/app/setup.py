"""Scene and stepper of a rollout, put together from its configuration."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from hood.app.common import picture_of, require_device, video_of
from hood.app.notices import say
from hood.app.output.frames import check_output_fps, check_refine_mesh
from hood.app.output.verdict import FAIL_ON
from hood.app.plan_file import plan_path, read_watch
from hood.app.scene.events import checked_events, with_events
from hood.app.scene.fabrics import checked_fabrics, fabric_of, with_body_friction
from hood.app.scene.garment_files import wanted_of
from hood.app.scene.garments import (
    checked_sizes,
    cut_to_size,
    heed,
    layer_order,
    names_of,
    names_of_own,
    read_outfit,
    with_pins,
)
from hood.app.scene.motion import NAMED, Own, check_motion_options, make_motion
from hood.app.settings.compose import ConfigError, brief, require_choice
from hood.app.settings.rollout_settings import RolloutSettings, fixed_shapes, measurement
from hood.app.stepping.automatic import Choice, choose, decided
from hood.app.stepping.cautions import known_by_slope, scene_cautions, warn
from hood.app.stepping.cloth_contact import acts, check_cloth_contact, check_soft_pins, potential_of, tell_if_off
from hood.app.stepping.guarding import check_guard
from hood.app.stepping.refinement import AUTO, check_refinement, chosen, refined
from hood.app.stepping.steppers import PLAIN, losses_of, make_network, make_solver, option_of
from hood.assets.files.library import unknown
from hood.assets.garment.garment import Garment
from hood.energies.potential import Potential
from hood.model.kernels.block import KERNELS
from hood.rollouts.frame import METRIC_CHOICES, SETTLE_CHOICES
from hood.rollouts.loop import own_start
from hood.rollouts.verdict.doubts import doubt_body, doubt_fabric
from hood.scene.held_layers import with_held_layers_apart
from hood.scene.scene import Scene, dressed_scene
from hood.scene.worn import doubts, misplacement
from hood.steppers.network import NetworkStepper
from hood.steppers.newton import Stepper
from hood.steppers.static_shapes.cuda_graph import has_graphs
from hood.steppers.static_shapes.simulator import MODES, CapturedSimulator, network_of
from hood.steppers.watched import WatchedStepper
from hood.tensors.dense import PRECISIONS, TF32


@dataclass(frozen=True)
class Setup:
    """What a rollout runs: ``config`` is the one asked for, with everything settled that it left to ``auto``."""

    config: RolloutSettings
    scene: Scene
    stepper: Stepper
    choice: Choice
    potential: Potential  # what steps are judged by; of a plan, that of the full model
    own: Own = NAMED


def check_config(config: RolloutSettings) -> None:
    """Raise ConfigError where keys of ``hood rollout`` have values that no rollout can have, before a file is read."""
    require_device(config)
    picture_of(config, video_of(config)[0])
    _check_metrics(config)
    start_of(config)
    require_choice(config, "fail_on", FAIL_ON)
    _check_numbers(config)
    checked_fabrics(config)
    checked_sizes(config)
    checked_events(config)
    require_choice(config, "kernels", (AUTO, *KERNELS))
    require_choice(config, "precision", (*PRECISIONS, TF32))
    option_of(config)
    wanted_of(config)
    require_choice(config, "step", (AUTO, PLAIN, *MODES))
    check_refinement(config)
    check_guard(config)
    check_cloth_contact(config)


def start_of(config: RolloutSettings) -> tuple[str, int]:
    """What ``settle`` says: one of :data:`hood.rollouts.frame.SETTLE_CHOICES`, and the number of relaxing steps.

    Raises:
        ConfigError: it says something else.
    """
    value = config.settle
    if isinstance(value, int):
        if value < 0:
            raise ConfigError(
                f"settle={value}: give a number of relaxing steps, at least 0, or one of {', '.join(SETTLE_CHOICES)}"
            )
        return "paper", value
    require_choice(config, "settle", SETTLE_CHOICES)
    return str(value), 1


def set_up(
    config: RolloutSettings,
    stepper: Stepper,
    own: Own = NAMED,
    tell: Callable[[str], None] = say,
) -> Setup:
    """The scene that the config names, and ``stepper`` with its steps refined as the config, or the scene, needs.

    Args:
        own: objects that stand for names of the config.
        tell: is called with every choice that was made, a sentence each.

    Raises:
        ConfigError, ValueError, FileNotFoundError: keys, files or assets that cannot be used.
    """
    config, why = decided(config)
    scene = make_scene(config, own)
    choice = choose(config, stepper, scene)
    choice.why[:0] = why
    settled = choice.settle(config)
    for sentence in choice.why:
        tell(sentence)
    if solves_in_double(settled) != solves_in_double(config):
        scene = make_scene(settled, own)
    check_soft_pins(settled, scene.held is not None and scene.held.stiffness is not None)
    if acts(settled):
        scene = with_held_layers_apart(scene)
    if not option_of(settled).network and network_of(stepper) is not None:
        stepper, _ = make_stepper(settled)
    stepper, settled = _by_itself(stepper, settled)
    stepper = refined(stepper, settled, scene.cloth.num_vertices, potential_of(settled))
    _check_start(settled, stepper, scene, tell)
    tell_if_off(settled, 1 if scene.outfit is None else len(scene.outfit.names))
    for doubt in (*doubt_body(scene.motion, int(settled.num_frames)), *doubt_fabric(scene.cloth, scene.garment.name)):
        warnings.warn(doubt, stacklevel=2)
    warn(scene_cautions(stepper, scene, losses_of(settled), str(settled.checkpoint)))
    for sentence in known_by_slope(stepper, losses_of(settled)):
        tell(sentence)
    potential = potential_of(settled)
    path = plan_path(config)
    if path is not None:
        stepper, potential = _watched(settled, stepper, scene, path)
    return Setup(settled, scene, stepper, choice, potential, own)


def _watched(config: RolloutSettings, reduced: Stepper, scene: Scene, path: Path) -> tuple[Stepper, Potential]:
    """A plan's stepper with its watch, and the potential of the full model; what it has alone where the plan has no watch."""
    potential, watch = potential_of(config), read_watch(path)
    if watch is None:
        return reduced, potential
    whole = RolloutSettings.from_words(watch.words)
    check_config(whole)
    everything = potential_of(whole)
    full = refined(make_stepper(whole)[0], whole, scene.cloth.num_vertices, everything)
    return WatchedStepper(reduced, full, (potential, everything), scene, watch.limit, watch.hold), everything


def make_scene(config: RolloutSettings, own: Own = NAMED) -> Scene:
    """Assets named in the config, or given, put together."""
    motion = make_motion(config, torch.float64 if solves_in_double(config) else torch.float32, own)
    given = config.garment if own.garment is None else own.garment
    names = names_of_own(own.garment) or names_of(config.garment)
    garment = read_outfit(given, motion, bool(config.triangulate), config.pins, wanted_of(config))
    order = None if isinstance(given, Garment) else layer_order(config.layers, _names_in(garment, names))
    garment = cut_to_size(config, garment, motion)
    fabric = fabric_of(config, garment, motion) if own.material is None else own.material
    scene = with_pins(replace(dressed_scene(garment, motion, fabric, checked_sizes(config)), layers=order), config)
    scene = with_body_friction(with_events(scene, config), config)
    found = misplacement(scene)
    if found is not None and found.grave:
        raise ValueError(
            f"garment {garment.name!r}: not worn by {motion.name!r} in its first frame: it {found.what}; give it as it is worn "
            f"there, {found.fix}"
        )
    heed(garment.name, [found] if found is not None else [])
    for name, doubt in doubts(scene):
        heed(name, [doubt])
    return scene


def _names_in(garment: Garment, files: list[str]) -> list[str]:
    """The garments of an outfit by the names of their files; by their own where a file holds several."""
    count = 1 if garment.piece is None else int(garment.piece.max()) + 1
    return files if len(files) == count else garment.name.split("+")


def solves_in_double(config: RolloutSettings) -> bool:
    """Whether steps are judged in float64: then states are kept in it, rounded ones would not meet what is said of them."""
    return bool(config.solver.double) and (not option_of(config).network or chosen(config) is not None)


def make_stepper(config: RolloutSettings) -> tuple[Stepper, str]:
    """What takes the steps, before they are refined, and the SHA-256 of its weights (``none`` without a network)."""
    config, _ = decided(config)
    option, step = option_of(config), str(config.step) if fixed_shapes(config) else PLAIN
    if option.network:
        return make_network(config, str(config.checkpoint), config.get("model"), step)
    return make_solver(option, config, potential_of(config), step), "none"


def _by_itself(stepper: Stepper, config: RolloutSettings) -> tuple[Stepper, RolloutSettings]:
    """What ``step=auto`` becomes: a CUDA graph where a network takes the steps alone and nothing in the command needs plain
    ones."""
    if str(config.step) != AUTO:
        return stepper, config
    if isinstance(stepper, NetworkStepper) and has_graphs(stepper.gravity.device) and chosen(config) is None:
        asked = config.with_values(step="captured")
        try:
            check_config(asked)
            return CapturedSimulator(stepper, "captured", or_plain=True), asked
        except ValueError:  # which says what needs plain steps
            pass
    return stepper, config.with_values(step=PLAIN)


def _check_start(config: RolloutSettings, stepper: Stepper, scene: Scene, tell: Callable[[str], None]) -> None:
    """A line where a rollout has a start of its own."""
    if str(config.settle) != "equilibrium":
        return
    reason = own_start(stepper, scene)
    if reason is not None:
        tell(f"settle=paper: {reason}")


def _check_metrics(config: RolloutSettings) -> None:
    asked = measurement(config)
    if asked.kind not in METRIC_CHOICES:
        raise ConfigError(unknown("value for metrics", asked.kind, METRIC_CHOICES))
    if asked.surface_every < 1:
        raise ConfigError(f"metrics={brief(config.metrics)}: surface_every is {asked.surface_every}; it must be at least 1")


def _check_numbers(config: RolloutSettings) -> None:
    for key, least in (("num_frames", 1), ("seed", 0)):
        if int(config[key]) < least:
            raise ConfigError(f"{key}={config[key]}: must be at least {least}")
    check_motion_options(config)
    check_output_fps(config)
    check_refine_mesh(config)
    if not 0.0 <= float(config.gravity) <= 1000.0:
        raise ConfigError(f"gravity={config.gravity}: give m/s², downwards, 0 to 1000")

"""What takes the steps: an option of ``configs/stepper``, by one word in every command.

A class from there is called as ``Class(potential, settings, **its own keys)``, with the potential that steps are judged by and
the solver's settings (``solver.*``). An option without a class stands for a network.

The potential of a config's losses: built once for every content, since a command asks for it many times.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

from hood.app.common import UNTRAINED, load_stepper, require_same_model, use_arithmetic, weigh
from hood.app.scene.fabrics import AUTO, measured_in, solved
from hood.app.settings.compose import CONFIG_FOLDER, ConfigError, build, load_config, options, plain
from hood.app.settings.rollout_settings import RolloutSettings, Settings
from hood.assets.files.library import locate
from hood.energies.potential import Potential
from hood.plugins import config_folders
from hood.steppers.network import NetworkStepper
from hood.steppers.newton import Stepper
from hood.steppers.static_shapes.simulator import CapturedSimulator

#: Contents that are remembered: a plan tries a few others beside the command's own.
_REMEMBERED = 32
_KNOWN: dict[str, Potential] = {}


def losses_of(config: Settings) -> Potential:
    """The energies that ``config.losses`` names. Terms of this package hold nothing but settings, and are shared by potentials
    of the same content; those of other packages are made anew each time.

    Raises:
        ConfigError, ValueError: as for :func:`hood.app.settings.compose.build`.
    """
    content = _with_air(config)
    if not _own(content):
        potential: Potential = build(content)
        return potential
    text = json.dumps(content)
    if text not in _KNOWN:
        _KNOWN[text] = build(content)
        if len(_KNOWN) > _REMEMBERED:
            del _KNOWN[next(iter(_KNOWN))]
    return Potential(_KNOWN[text].terms)


def air_of(config: Settings) -> Any:
    """``wind`` with ``auto`` settled: still air (0.0) where a solver takes the steps of measured cloth, else no air (None).

    Networks were trained without air, and so was the paper's fabric simulated. Measured cloth is so light, or so limp, that air
    which is left out shows.
    """
    if config.get("wind") != AUTO:
        return config.get("wind")
    return 0.0 if config.losses.terms.get("air") is not None and solved(config) and measured_in(config) else None


def with_air(config: RolloutSettings) -> tuple[RolloutSettings, list[str]]:
    """The config with the air of :func:`air_of`, and a sentence where ``auto`` chose some."""
    if config.wind != AUTO:
        return config, []
    wind, names = air_of(config), measured_in(config)
    sentence = f"wind=0: still air brakes {' and '.join(names)}, as measured cloth; wind=null leaves it out"
    why = [] if wind is None else [sentence]
    return config.with_values(losses=OmegaConf.create(_with_air(config)), wind=wind), why


def _with_air(config: Settings) -> Any:
    """The content of ``config.losses``, ``auto`` settled."""
    content = plain(config.losses)
    term = content["terms"].get("air") if isinstance(content, dict) and isinstance(content.get("terms"), dict) else None
    if term is not None and term.get("velocity") == AUTO:
        term["velocity"] = air_of(config)
    return content


def _own(content: Any) -> bool:
    """Whether all that is to be built is of this package."""
    if not isinstance(content, dict) or not isinstance(content.get("terms"), dict):
        return False
    nodes = [content, *(term for term in content["terms"].values() if term is not None)]
    return all(isinstance(node, dict) and str(node.get("_target_")).startswith("hood.energies.") for node in nodes)


GROUP = "stepper"
#: ``step=plain``: shapes as the step needs them, the readable reference.
PLAIN = "plain"
#: What an option says about refinement: its steps may be refined, are too rough without, or are not to be.
MAY, ALWAYS, NEVER = REFINEMENTS = ("may", "always", "never")


@dataclass(frozen=True)
class StepperOption:
    """An option of ``configs/stepper``.

    Args:
        network: whether the steps are those of a network, of ``checkpoint=`` or ``models=``.
        refinement: one of :data:`REFINEMENTS`.
        made_by: the class, as ``_target_``, and its own arguments.
    """

    name: str
    network: bool
    refinement: str
    made_by: dict[str, Any]


def option_of(config: Mapping[Any, Any]) -> StepperOption:
    """The option that the config of a rollout has chosen.

    Raises:
        ConfigError: none, or one that is not written as it has to be; names the option.
    """
    name, keys = config.get("stepper"), plain(config.get("stepping"))
    if name is None:
        raise ConfigError(f"stepper=null: somebody has to take the steps; give one of {', '.join(options(GROUP))}")
    return _option(str(name), keys)


def with_stepper(config: RolloutSettings, name: str) -> RolloutSettings:
    """A rollout's config with another option: the same where it is the one it has."""
    return config if config.stepper == name else config.with_values(**_content(name, config_folders()))


def find_option(name: str) -> StepperOption | None:
    """The option of that name whose steps are not those of a network; None where there is none."""
    if name not in options(GROUP):
        return None
    found = _option(name, _content(name, config_folders())["stepping"])
    return None if found.network else found


@lru_cache(maxsize=32)
def _content(name: str, plugins: tuple[Path, ...]) -> dict[str, Any]:
    """The keys of an option, ours or one from the config folders of ``plugins``."""
    file = CONFIG_FOLDER / GROUP / f"{name}.yaml"
    # One of ours says all by itself; it is read in a hundredth of the time of composing a rollout with it.
    content = plain(OmegaConf.load(file) if file.exists() else load_config("rollout", [f"{GROUP}={name}"]))
    return {key: content.get(key) for key in ("stepper", "stepping")}


def _option(name: str, keys: Any) -> StepperOption:
    where = f"configs/{GROUP}/{name}.yaml"
    if not isinstance(keys, dict) or bool(keys.get("network", False)) == ("_target_" in keys):
        raise ConfigError(f"{where}: has to say under 'stepping' either _target_: a class, or network: true")
    refinement = str(keys.get("refinement", MAY))
    if refinement not in REFINEMENTS:
        raise ConfigError(f"{where}: stepping.refinement is {refinement!r}; choose {', '.join(REFINEMENTS)}")
    made_by = {key: value for key, value in keys.items() if key not in ("network", "refinement")}
    return StepperOption(name, bool(keys.get("network", False)), refinement, made_by)


def make_solver(option: StepperOption, config: Settings, potential: Potential, step: str = PLAIN) -> Stepper:
    """The stepper of an option without a network, before it is refined, on the config's device.

    Args:
        step: how it is taken; :data:`PLAIN` or one of :data:`hood.steppers.static_shapes.simulator.MODES`.

    Raises:
        ConfigError: its class does not take these arguments, or has no steps of fixed shapes.
    """
    make = build({**option.made_by, "_partial_": True})
    try:
        stepper: Stepper = make(potential, build(config.solver))
    except TypeError as error:
        raise ConfigError(
            f"stepper={option.name}: {option.made_by['_target_']} is called with a potential, the solver's settings and the "
            f"keys of its option ({' '.join(str(error).split())})"
        ) from error
    _weigh(stepper, config)
    if step == PLAIN:
        return stepper
    in_fixed_shapes = getattr(stepper, "in_fixed_shapes", None)
    if in_fixed_shapes is None:
        raise ConfigError(f"step={step}: steps of stepper={option.name} are plain; drop step=… from the command")
    fixed: Stepper = in_fixed_shapes(step)
    return fixed


def make_network(
    config: Settings, checkpoint: str, model: Any = None, step: str = PLAIN, way_out: str = "drop model=… from the command"
) -> tuple[Stepper, str]:
    """A network's stepper, before it is refined, on the config's device, and the SHA-256 of its file.

    Args:
        checkpoint: embedded weights or a file; :data:`hood.app.common.UNTRAINED` for seeded random weights of ``model``.
        model: config of the model that the checkpoint has to hold; None: whichever it holds.
        step: as in :func:`make_solver`.
        way_out: what is advised where the checkpoint holds another model.

    Raises:
        ConfigError: it holds another model, or random weights are asked for without a model.
    """
    torch.manual_seed(int(config.seed))
    if checkpoint == UNTRAINED:
        if model is None:
            raise ConfigError("checkpoint=untrained needs a model: add model=small (or ours, fine15, fine48)")
        simulator: NetworkStepper = build(model)
        digest = UNTRAINED
    else:
        path = locate("weights", checkpoint)
        simulator = load_stepper(path, float(config.fps))
        if model is not None:
            require_same_model(path, simulator, build(model), way_out)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    simulator = simulator.eval().to(str(config.device))
    _weigh(simulator, config)
    use_arithmetic(simulator, config, traced=step == "compiled")
    return (simulator if step == PLAIN else CapturedSimulator(simulator, step)), digest


def _weigh(stepper: Stepper, config: Settings) -> None:
    """The command's gravity, before anything is made of the stepper that reads it; the stepper's own where it has none."""
    if "gravity" in config:
        weigh(stepper, config)
    else:
        stepper.gravity = stepper.gravity.to(str(config.device))

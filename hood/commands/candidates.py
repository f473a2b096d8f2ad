"""What ``hood evaluate`` compares: networks and the solver, by the names that the user gives them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import replace

from omegaconf import DictConfig

from hood.assets.files.library import locate
from hood.commands.common import UNTRAINED
from hood.commands.conditions import training_note
from hood.commands.losses import losses_of
from hood.commands.steppers import ALWAYS, NEVER, find_option, make_network, make_solver
from hood.config import ConfigError, build, load_config, options
from hood.dynamics.captured import network_of
from hood.dynamics.refine import RefinedStepper
from hood.dynamics.stopping import Count
from hood.evaluation.table import GUESS, Candidate, model_name


def make_candidate(name: str, config: DictConfig) -> Candidate:
    """A checkpoint by name or path, an option of ``configs/stepper`` (``newton`` for the solver, ``guess`` for where it
    starts), or ``untrained:MODEL`` for seeded random weights; all but the solver with ``+k`` behind the name: every step
    refined by k iterations."""
    start, iterations = split_refinement(name)
    inner = _unrefined_candidate(start, config)
    if iterations is None:
        option = find_option(start)
        if option is not None and option.refinement == ALWAYS:
            raise ConfigError(f"models: {name!r} takes its steps by refinement alone; give {name}+5, or another number")
        return inner
    potential, settings = losses_of(config), build(config.solver)
    stepper = RefinedStepper(inner.stepper, potential, Count(iterations), str(config.refine_method), settings)
    return Candidate(f"{inner.name}+{iterations}", inner.weights, stepper, inner.training)


def split_refinement(name: str) -> tuple[str, int | None]:
    """``NAME+k`` as the name and k, None where there is none.

    Raises:
        ConfigError: the solver is to be refined.
    """
    found = re.fullmatch(r"(.+)\+(\d+)", name)
    if found is None:
        return name, None
    option = find_option(found[1])
    if option is not None and option.refinement == NEVER:
        raise ConfigError(f"models: {name!r} refines what is solved already; {GUESS}+{found[2]} is the solver stopped early")
    return found[1], int(found[2])


def _unrefined_candidate(name: str, config: DictConfig) -> Candidate:
    option = find_option(name)
    if option is not None:
        return Candidate(name, "none", make_solver(option, config, losses_of(config)))
    prefix = UNTRAINED + ":"
    if name.startswith(prefix):
        model = name[len(prefix) :]
        if model not in options("model"):
            raise ConfigError(f"models: unknown model {model!r} in {name!r}; known are {', '.join(options('model'))}")
        stepper, _ = make_network(config, UNTRAINED, load_config("rollout", [f"model={model}"]).model)
        return Candidate(model, UNTRAINED, stepper)
    path = locate("weights", name)
    stepper, _ = make_network(config, str(path))
    return Candidate(model_name(str(path)), path.name, stepper, training_note(path))


def distinct(candidates: Sequence[Candidate]) -> list[Candidate]:
    """The same; random weights are called so where others have their model's name."""
    trained = {candidate.name for candidate in candidates if candidate.weights != UNTRAINED}
    return [
        replace(one, name=f"{UNTRAINED}:{one.name}") if one.weights == UNTRAINED and one.name in trained else one
        for one in candidates
    ]


def digest(candidate: Candidate) -> str:
    """SHA-256 of the weights: results are not taken over from others that had the same name."""
    network = network_of(candidate.stepper)
    if network is None:
        return "none"
    content = hashlib.sha256()
    for name, value in network.state_dict().items():
        content.update(name.encode())
        content.update(value.detach().cpu().contiguous().numpy().tobytes())
    return content.hexdigest()

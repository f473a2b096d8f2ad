"""What ``hood evaluate`` compares: networks and the solver, by the names that the user gives them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import replace

import torch
from omegaconf import DictConfig

from hood.assets.files.library import locate
from hood.commands.common import UNTRAINED, read_model, use_arithmetic
from hood.commands.conditions import training_note
from hood.config import ConfigError, build, load_config, options
from hood.dynamics.goals import Count
from hood.dynamics.refine import GuessStepper, RefinedStepper, unrefined
from hood.dynamics.simulator import Simulator
from hood.dynamics.stepper import NewtonStepper
from hood.evaluation.grid import GUESS, NEWTON, model_name
from hood.evaluation.table import Candidate


def make_candidate(name: str, config: DictConfig) -> Candidate:
    """A checkpoint by name or path, ``newton`` for the solver, ``guess`` for where it starts, or ``untrained:MODEL`` for seeded
    random weights; all but the solver with ``+k`` behind the name: every step refined by k iterations."""
    start, iterations = split_refinement(name)
    inner = _unrefined_candidate(start, config)
    if iterations is None:
        return inner
    potential, settings = build(config.losses), build(config.solver)
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
    if found[1] == NEWTON:
        raise ConfigError(f"models: {name!r} refines what is solved already; {GUESS}+{found[2]} is the solver stopped early")
    return found[1], int(found[2])


def _unrefined_candidate(name: str, config: DictConfig) -> Candidate:
    if name == GUESS:
        guess = GuessStepper(build(config.losses), build(config.solver))
        guess.gravity = guess.gravity.to(str(config.device))
        return Candidate(GUESS, "none", guess)
    if name == NEWTON:
        stepper = NewtonStepper(build(config.losses), build(config.solver))
        stepper.gravity = stepper.gravity.to(str(config.device))
        return Candidate(NEWTON, "none", stepper)
    prefix = UNTRAINED + ":"
    if name.startswith(prefix):
        model = name[len(prefix) :]
        if model not in options("model"):
            raise ConfigError(f"models: unknown model {model!r} in {name!r}; known are {', '.join(options('model'))}")
        torch.manual_seed(int(config.seed))
        simulator = build(load_config("rollout", [f"model={model}"]).model)
        use_arithmetic(simulator, config)
        return Candidate(model, UNTRAINED, simulator.eval().to(str(config.device)))
    path = locate("weights", name)
    simulator = read_model(path, float(config.fps)).to(str(config.device))
    use_arithmetic(simulator, config)
    return Candidate(model_name(str(path)), path.name, simulator, training_note(path))


def distinct(candidates: Sequence[Candidate]) -> list[Candidate]:
    """The same; random weights are called so where others have their model's name."""
    trained = {candidate.name for candidate in candidates if candidate.weights != UNTRAINED}
    return [
        replace(one, name=f"{UNTRAINED}:{one.name}") if one.weights == UNTRAINED and one.name in trained else one
        for one in candidates
    ]


def digest(candidate: Candidate) -> str:
    """SHA-256 of the weights: results are not taken over from others that had the same name."""
    stepper = unrefined(candidate.stepper)
    if not isinstance(stepper, Simulator):
        return "none"
    content = hashlib.sha256()
    for name, value in stepper.state_dict().items():
        content.update(name.encode())
        content.update(value.detach().cpu().contiguous().numpy().tobytes())
    return content.hexdigest()

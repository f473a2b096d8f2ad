"""What ``hood evaluate`` compares: networks and the solver, by the names that the user gives them.

The conditions of an evaluation in words: its command, the machine, how the models were trained.
"""

from __future__ import annotations

import hashlib
import platform
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig

from hood.app.common import UNTRAINED
from hood.app.settings.compose import ConfigError, build, load_config, options, plain
from hood.app.stepping.steppers import ALWAYS, NEVER, find_option, losses_of, make_network, make_solver
from hood.assets.files.library import locate
from hood.evaluation.table import GUESS, Candidate, model_name
from hood.evaluation.table_one import TableConditions
from hood.steppers.checkpoint import read_header
from hood.steppers.published import SUFFIXES
from hood.steppers.refined import RefinedStepper
from hood.steppers.static_shapes.simulator import network_of
from hood.steppers.stopping import Count

#: Arguments that change nothing about the figures.
_ASIDE = ("output", "resume", "max_rollouts", "contact_sheets")


def conditions(
    config: DictConfig,
    overrides: Sequence[str],
    motions: Sequence[str],
    vertices: Mapping[str, int],
    training: Mapping[str, str],
) -> TableConditions:
    """Of an evaluation with ``config``: ``vertices`` by garment, ``training`` in words by model."""
    return TableConditions(
        command=command_line("evaluate", overrides),
        machine=machine_name(str(config.device)),
        body=f"{Path(str(config.body)).stem} (embedded)" if str(config.body) == "default" else Path(str(config.body)).name,
        motions=[Path(name).stem for name in motions],
        num_shapes=len(plain(config.shapes)),
        num_frames=int(config.num_frames),
        fps=float(config.fps),
        vertices=dict(vertices),
        training=dict(training),
    )


def command_line(command: str, overrides: Sequence[str]) -> str:
    """The command that gives the same figures: what says where files go is left out."""
    kept = [text for text in overrides if text.split("=", 1)[0].strip("+~") not in _ASIDE]
    return shlex.join(["hood", command, *kept])


def machine_name(device: str) -> str:
    """:func:`device_name`, threads of a processor, torch version."""
    threads = "" if device.startswith("cuda") else f"{torch.get_num_threads()} thread(s), "
    return f"{device_name(device)}, {threads}torch {torch.__version__}"


def device_name(device: str) -> str:
    """What the processor or the graphics card calls itself."""
    if device.startswith("cuda"):
        return torch.cuda.get_device_name(device)
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name") and ":" in line]
    return names[0] if names else platform.processor() or platform.machine()


def training_note(path: Path) -> str:
    """What a model file says about its training; empty where it says nothing."""
    if path.suffix.lower() in SUFFIXES:
        return "published weights"
    header = {key: value for key, value in read_header(path).items() if key not in ("format", "model", "ranges", "validation")}
    iteration = header.pop("iteration", None)
    notes = [] if iteration is None else [f"{int(iteration):,} updates"]
    return ", ".join([*notes, *(f"{key} {value}" for key, value in sorted(header.items()))])


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

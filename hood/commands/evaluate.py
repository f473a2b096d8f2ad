"""``hood evaluate``: cost, reach and accuracy of several models and of the solver, printed and as CSV and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig
from tqdm import tqdm

from hood.assets.body import load_body
from hood.assets.garment import load_garment
from hood.assets.library import locate, motion_split
from hood.assets.sequence import load_sequence
from hood.commands.common import UNTRAINED, prepare_folder, read_model, require_device
from hood.config import ConfigError, build, load_config, options, save_run_record
from hood.dynamics.stepper import NewtonStepper
from hood.evaluation.gap import REFERENCE
from hood.evaluation.report import describe, format_table, write_table
from hood.evaluation.table import Candidate, GapSettings, evaluate
from hood.scene.scene import Scene, build_scene

#: ``models=[newton]``: no network, the potential minimised in every frame.
NEWTON = "newton"


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    config = load_config("evaluate", overrides)
    require_device(config)
    _check_numbers(config)
    gaps = GapSettings(int(config.gap_states), replace(REFERENCE, max_iterations=int(config.gap_iterations)))
    candidates = [make_candidate(str(name), config) for name in config.models]
    scenes = make_scenes(config)
    folder = prepare_folder(Path(str(config.output)).expanduser())
    save_run_record(folder, config, int(config.seed))
    total = len(candidates) * sum(len(variants) for variants in scenes.values())
    with tqdm(total=total, desc="evaluate", unit="rollout", disable=None) as bar:

        def progress(text: str, done: int) -> None:
            bar.set_postfix_str(text, refresh=False)
            bar.update(done - bar.n)
            bar.refresh()

        rows = evaluate(candidates, scenes, build(config.losses), int(config.num_frames), gaps, progress)
    print(format_table(rows))
    print(f"\n{describe(rows)}")
    csv_path, json_path = write_table(rows, folder)
    print(f"tables in {csv_path} and {json_path}")
    return 0


def make_candidate(name: str, config: DictConfig) -> Candidate:
    """A checkpoint by name or path, ``newton`` for the solver, or ``untrained:MODEL`` for seeded random weights."""
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
        simulator.network.use_precision(str(config.precision))
        return Candidate(model, UNTRAINED, simulator.eval().to(str(config.device)))
    path = locate("weights", name)
    simulator = read_model(path, float(config.fps)).to(str(config.device))
    simulator.network.use_precision(str(config.precision))
    return Candidate(path.stem if path.stem != "model" else path.parent.name, path.name, simulator)


def make_scenes(config: DictConfig) -> dict[str, list[Scene]]:
    """Every garment on every motion of the validation list."""
    motions = [str(name) for name in config.sequences] or motion_split()["validation"]
    sequences = [load_sequence(name, float(config.fps)) for name in motions]
    body, material, device = load_body(str(config.body)), build(config.material), str(config.device)
    garments = [load_garment(str(name)) for name in config.garments]
    return {g.name: [build_scene(g, body, s, material, device=device) for s in sequences] for g in garments}


def _check_numbers(config: DictConfig) -> None:
    for key, least, why in (
        ("num_frames", 4, "the first frames are not timed"),
        ("gap_states", 0, "0 computes no gap"),
        ("gap_iterations", 1, "a reference needs iterations; gap_states=0 computes no gap"),
    ):
        if int(config[key]) < least:
            raise ConfigError(f"{key}={config[key]}: must be at least {least}, {why}")

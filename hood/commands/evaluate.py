"""``hood evaluate``: the paper's Table 1 columns for several models, printed and as CSV and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig
from tqdm import tqdm

from hood.assets.body import load_body
from hood.assets.garment import load_garment
from hood.assets.library import locate, motion_split
from hood.assets.sequence import load_sequence
from hood.commands.common import UNTRAINED, prepare_folder, require_device
from hood.config import ConfigError, build, load_config, options, save_run_record
from hood.dynamics.simulator import load_simulator
from hood.evaluation.table import Candidate, evaluate, format_table, write_table
from hood.scene.scene import Scene, build_scene


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    config = load_config("evaluate", overrides)
    require_device(config)
    if int(config.num_frames) < 4:
        raise ConfigError(f"num_frames={config.num_frames}: must be at least 4, the first frames are not timed")
    candidates = [make_candidate(str(name), config) for name in config.models]
    scenes = make_scenes(config)
    folder = prepare_folder(Path(str(config.output)).expanduser())
    save_run_record(folder, config, int(config.seed))
    total = len(candidates) * sum(len(variants) for variants in scenes.values())
    with tqdm(total=total, desc="evaluate", unit="rollout", disable=None) as bar:

        def progress(text: str) -> None:
            bar.set_postfix_str(text)
            bar.update(1)

        rows = evaluate(candidates, scenes, build(config.losses), int(config.num_frames), progress)
    print(format_table(rows))
    csv_path, json_path = write_table(rows, folder)
    print(f"tables in {csv_path} and {json_path}")
    return 0


def make_candidate(name: str, config: DictConfig) -> Candidate:
    """A checkpoint by name or path, or ``untrained:MODEL`` for seeded random weights of a model config."""
    prefix = UNTRAINED + ":"
    if name.startswith(prefix):
        model = name[len(prefix) :]
        if model not in options("model"):
            raise ConfigError(f"models: unknown model {model!r} in {name!r}; known are {', '.join(options('model'))}")
        torch.manual_seed(int(config.seed))
        simulator = build(load_config("rollout", [f"model={model}"]).model)
        return Candidate(model, UNTRAINED, simulator.eval().to(str(config.device)))
    path = locate("weights", name)
    return Candidate(
        path.stem if path.stem != "model" else path.parent.name, path.name, load_simulator(path).to(str(config.device))
    )


def make_scenes(config: DictConfig) -> dict[str, list[Scene]]:
    """Every garment on every motion of the validation list."""
    motions = [str(name) for name in config.sequences] or motion_split()["validation"]
    sequences = [load_sequence(name, float(config.fps)) for name in motions]
    body, material, device = load_body(str(config.body)), build(config.material), str(config.device)
    garments = [load_garment(str(name)) for name in config.garments]
    return {g.name: [build_scene(g, body, s, material, device=device) for s in sequences] for g in garments}

"""``hood plan`` of a training: where an update's time goes, which terms teach nothing, and what is never drawn."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from hood.app.common import require_device
from hood.app.settings.compose import ConfigError, load_config
from hood.app.train import make_trainer
from hood.assets.files.atomic import write_atomically
from hood.assets.material import RANGES, UNITS
from hood.assets.motion.motion_files import MotionFiles
from hood.cloth.cloth import Cloth
from hood.energies.potential import Potential, relative_gradient
from hood.energies.problem import StepProblem
from hood.steppers.network import Prediction
from hood.steppers.protocol import Stopwatch
from hood.training.trainer import Trainer

FORMAT, FILE = "hood-training-plan/1", "training_plan.json"
#: A term whose force stays below this share of the residual teaches nothing in the scenes that were looked at.
_SMALL = 1e-3
#: Updates before the timed ones: kernels are compiled, and statistics collected.
_WARM_UP = 2
#: Updates in search of some that begin no scene, for one that is timed.
_TIMES_MORE = 4
#: Equal shares of every range, on a logarithmic axis, that are looked for among the scenes.
_BANDS = 5
_PARTS = ("scenes", "search", "features", "network", "losses", "backward", "optimiser", "rest")


def checked_training(words: Sequence[str], own: DictConfig) -> DictConfig:
    """The config of the training, with scenes made in this process, before anything is read.

    Raises:
        ConfigError: unknown keys or values, or numbers that are none.
    """
    for key, least, most in (("updates", 1, 1000), ("scenes", 1, 100_000)):
        value = own[key]
        if isinstance(value, bool) or not least <= int(value) <= most:
            raise ConfigError(f"{key}={value}: give a whole number from {least} to {most}")
    config = load_config("train", [*words, "trainer.workers=0"])
    require_device(config)
    return config


def plan_training(config: DictConfig, words: Sequence[str], updates: int, scenes: int) -> dict[str, Any]:
    """Times, terms and draws of the training that a config of ``hood train`` describes; nothing of it is written.

    Args:
        updates: that are timed.
        scenes: that are drawn, the first ones of the training.
    """
    trainer = make_trainer(config)
    settings = trainer.settings
    trainer.settings = replace(settings, statistics_iterations=min(settings.statistics_iterations, _WARM_UP))
    shares = _Shares()
    times = _timed(trainer, shares, updates)
    drawn = _draw(trainer, scenes)
    counts = (settings.count(index) for index in range(settings.iterations))
    steps = float(np.mean([settings.horizon.after_relaxing(count) + 1 for count in counts]))
    scene_ms = drawn.pop("ms_per_scene")
    times["scenes"] += scene_ms * trainer.slots.num_slots / len(trainer.slots.buckets) / steps
    total = sum(times.values())
    return {
        "format": FORMAT,
        "words": list(words),
        "updates": updates,
        "iterations": settings.iterations,
        "ms": total,
        "hours": total * settings.iterations / 3.6e6,
        "ms_per_scene": scene_ms,
        "steps_per_scene": steps,
        "rows": [{"part": name, "ms": times[name], "share": times[name] / total} for name in _PARTS],
        "terms": shares.found(),
        "drawn": drawn,
    }


class _Shares:
    """Of every term, the largest force as a share of the residual's, over scenes and updates."""

    def __init__(self) -> None:
        self.most: dict[str, float] = {}

    def __call__(self, problem: StepProblem, potential: Potential, prediction: Prediction, residual: Tensor) -> None:
        pos, acc, free = prediction.next_pos.detach(), prediction.acc.detach(), problem.cloth.free.unsqueeze(1)
        active = potential.active(problem)
        for name in potential.terms:
            share = 0.0
            if name in active:
                gradient, _ = potential.only({name: active[name]}).gradient(problem, pos, acc)
                shares = relative_gradient(problem, gradient * free) / residual.clamp_min(1e-30)
                share = float(shares.nan_to_num(torch.inf).max())
            self.most[name] = max(self.most.get(name, 0.0), share)

    def found(self) -> dict[str, dict[str, Any]]:
        """By term, the largest force first."""
        order = sorted(self.most.items(), key=lambda pair: -pair[1])
        return {name: {"share": min(share, 1e30), "teaches": share > _SMALL} for name, share in order}


def _timed(trainer: Trainer, shares: _Shares, updates: int) -> dict[str, float]:
    """Milliseconds of the parts of an update that begins no scene, the medians; scenes that begin are timed by themselves."""
    alone = torch.get_num_threads() == 1 and trainer.simulator.gravity.device.type == "cpu"
    watch = Stopwatch(time.process_time if alone else time.perf_counter)
    laps: list[dict[str, float]] = []

    def look(problem: StepProblem, potential: Potential, prediction: Prediction, residual: Tensor) -> None:
        with watch.aside("terms"):
            shares(problem, potential, prediction, residual)

    for _ in range(_WARM_UP):
        trainer.update()
    trainer.stopwatch, trainer.observe = watch, look
    for _ in range(_TIMES_MORE * updates):
        takes = trainer.slots.feed.takes
        watch.lap()
        trainer.update()
        lap = watch.lap()
        if trainer.slots.feed.takes == takes:
            laps.append(lap)
        if len(laps) == updates:
            break
    trainer.slots.close()
    laps = laps or [lap]  # every update began a scene
    return {name: float(np.median([lap.get(name, 0.0) for lap in laps])) for name in _PARTS}


def _draw(trainer: Trainer, scenes: int) -> dict[str, Any]:
    """What the first scenes of the training are, and what of the data is not among them."""
    sampler, slots = trainer.slots.sampler, trainer.slots
    garments, motions = Counter[str](), Counter[str]()
    values: dict[str, list[float]] = {name: [] for name in RANGES}
    began = time.process_time()
    for number in range(scenes):
        index, draw = number % slots.num_slots, number // slots.num_slots
        start = slots.scene(index, draw)
        garments[sampler.garments[start.window.template].name] += 1
        motions[_name_of(start.window.scene.motion.name)] += 1
        for name, found in _fabric(start.window.scene.cloth).items():
            values[name] += found
    ms = 1e3 * (time.process_time() - began) / scenes
    known = [garment.name for garment in sampler.garments]
    titles = [_name_of(name) for name in _titles(sampler.sequences)]
    return {
        "scenes": scenes,
        "ms_per_scene": ms,
        "garments": dict(garments),
        "garments_never": [name for name in known if name not in garments],
        "motions": len(motions),
        "motions_never": [name for name in titles if name not in motions],
        "fabrics_never": _empty_bands(values, sampler.material is not None),
    }


def _name_of(motion: str) -> str:
    """Motions of files and of the package by the same kind of name."""
    return Path(motion).stem


def _titles(sequences: Any) -> list[str]:
    """Names of a sampler's motions, which may not be read yet."""
    return list(sequences.names) if isinstance(sequences, MotionFiles) else [sequence.name for sequence in sequences]


def _fabric(cloth: Cloth) -> dict[str, list[float]]:
    """Least, median and greatest value of a scene's fabric, by property."""
    found = {}
    for name in RANGES:
        values = getattr(cloth, name).double()
        found[name] = [float(values.min()), float(values.median()), float(values.max())]
    return found


def _empty_bands(values: Mapping[str, Sequence[float]], given: bool) -> dict[str, list[list[float]]]:
    """By property, the parts of its range that no scene has; none where one fabric was ``given`` for all."""
    if given:
        return {}
    empty = {}
    for name, (low, high) in RANGES.items():
        edges = np.geomspace(low, high, _BANDS + 1)
        counts, _ = np.histogram(np.clip(values[name], low, high), edges)
        empty[name] = [[float(edges[i]), float(edges[i + 1])] for i in np.flatnonzero(counts == 0)]
    return {name: bands for name, bands in empty.items() if bands}


def describe_training(plan: Mapping[str, Any]) -> str:
    """The table, and a sentence each on terms, garments, motions and fabrics."""
    drawn = plan["drawn"]
    lines = [
        f"an update takes {plan['ms']:.0f} ms, {plan['iterations']:,} of them {plan['hours']:.1f} hours; a scene takes "
        f"{plan['ms_per_scene']:.0f} ms to make and lasts {plan['steps_per_scene']:.0f} updates (the mean of the schedule)",
        "",
        f"{'part of an update':<20}{'ms':>9}{'share':>8}",
    ]
    lines += [f"{row['part']:<20}{row['ms']:>9.1f}{100 * row['share']:>7.0f}%" for row in plan["rows"]]
    small = [f"{name} ({one['share']:.1g})" for name, one in plan["terms"].items() if not one["teaches"]]
    fabrics = [
        f"{name} {', '.join(f'{low:.3g}–{high:.3g}' for low, high in bands)} {UNITS.get(name, '')}".rstrip()
        for name, bands in drawn["fabrics_never"].items()
    ]
    never = {
        f"terms whose force is never more than {_SMALL:g} of the residual": small,
        f"garments that {drawn['scenes']} scenes never have": drawn["garments_never"],
        "motions that they never have": drawn["motions_never"],
        "ranges of fabrics that they never have": fabrics,
    }
    lines += ["", *(f"{what}: {', '.join(found) or 'none'}" for what, found in never.items())]
    return "\n".join(lines)


def write_training_plan(folder: Path, plan: Mapping[str, Any]) -> Path:
    """Write it; returns the file."""
    write_atomically(folder / FILE, json.dumps(plan, indent=1, allow_nan=False).encode())
    return folder / FILE

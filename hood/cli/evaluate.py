"""``hood evaluate``: cost, reach and accuracy of several models and of the solver, printed and as CSV and JSON.

What an evaluation prints and writes when all its rollouts are done.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from tqdm import tqdm

from hood.app.batch.batch import require_motions
from hood.app.candidates import conditions, digest, distinct, make_candidate
from hood.app.common import (
    held_folder,
    output_folder,
    require_device,
    require_distinct,
    require_package,
    together,
)
from hood.app.scene.garments import as_simulated, shape_coefficients
from hood.app.settings.compose import ConfigError, build, load_config, plain, require_choice
from hood.app.settings.record import require_same_config, save_run_record
from hood.app.stepping.cautions import evaluation_cautions, warn
from hood.assets.body.load import load_body
from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import motion_split
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.motion.load import load_sequence
from hood.assets.motion.motion_files import find_motions
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import build_cloth
from hood.energies.potential import Potential
from hood.evaluation.files import EvaluationUnit, RolloutLog, columns, describe_rows, format_table, write_rows
from hood.evaluation.gap import REFERENCE
from hood.evaluation.spectrum import SPECTRUM_COLUMNS as SPECTRUM_COLUMNS
from hood.evaluation.spectrum import bar_panels, format_spectrum, spectrum_rows
from hood.evaluation.table import Candidate, GapSettings, MeasuredRollout, candidate_rows, measure
from hood.evaluation.table_one import TableConditions, page
from hood.evaluation.validation import sideways_drift, standing_scene
from hood.model.kernels.block import KERNELS
from hood.model.network.kernel_choice import AUTO
from hood.rollouts.frames import KeptFrames
from hood.scene.scene import Scene, build_scene
from hood.steppers.ranges import Conditions, scene_conditions
from hood.steppers.refined import METHODS
from hood.tensors.dense import check_precision
from hood.training import distributed


def report_table(rows: Sequence[Mapping[str, Any]], about: TableConditions, folder: Path) -> None:
    """Print the table; write it as ``table.csv``, ``table.json`` and, beside the paper's, ``table1.md``."""
    print(format_table(rows))
    print(f"\n{describe_rows(rows)}")
    csv_path, json_path = write_rows(rows, columns(rows), folder, "table")
    page_path = folder / "table1.md"
    write_atomically(page_path, page(rows, about).encode())
    print(f"tables in {csv_path}, {json_path} and, beside the paper's, {page_path}")


def report_spectrum(rows: Sequence[Mapping[str, Any]], folder: Path, picture: bool) -> None:
    """Print in which wavelengths the errors are; write it as ``spectrum.csv``, ``spectrum.json`` and, as ``picture``,
    ``spectrum.png``."""
    print(f"\n{format_spectrum(rows)}")
    paths = [str(path) for path in write_rows(rows, SPECTRUM_COLUMNS, folder, "spectrum")]
    if picture:
        from hood.media.bars import write_bars

        write_bars(bar_panels(rows), folder / "spectrum.png")
        paths.append(str(folder / "spectrum.png"))
    print(f"spectrum in {', '.join(paths)}")


#: What is made of the spectra of the errors.
SPECTRA = ("none", "table", "picture")
#: The motion of a body that stands still, on which drift is measured.
STANDING = ":standing"


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    config = load_config("evaluate", overrides)
    require_device(config)
    _check_lists(config)
    _check_numbers(config)
    require_choice(config, "refine_method", METHODS)
    require_choice(config, "kernels", (AUTO, *KERNELS))
    check_precision(str(config.precision), torch.device(str(config.device)))
    require_choice(config, "spectrum", SPECTRA)
    if config.spectrum != "none" and int(config.gap_states) == 0:
        raise ConfigError(
            f"spectrum={config.spectrum}: it is computed of the states of gap_states, which is 0; give gap_states >= 1"
        )
    if bool(config.contact_sheets):
        require_package("PIL", "Pillow", "pictures", "contact_sheets=true")
    if config.spectrum == "picture":
        require_package("matplotlib", "matplotlib", "charts", "spectrum=picture")
    return together(lambda: _evaluate(config, overrides))


def _evaluate(config: DictConfig, overrides: Sequence[str]) -> int:
    plan = _make_plan(config)
    with held_folder(config) as folder:
        return _run(plan, folder, overrides)


def _run(plan: Plan, folder: Path, overrides: Sequence[str]) -> int:
    config = plan.config
    distributed.on_main(lambda: _prepare(config, folder))
    if distributed.rank() == 0:
        warn(evaluation_cautions({one.name: one.stepper for one in plan.candidates}, plan.conditions()))
    log = RolloutLog(folder, distributed.rank())
    done = {key: item for part in distributed.gather(log.read(plan.digests)) for key, item in part.items()}
    todo = [unit for unit in plan.units if unit not in done][: config.max_rollouts]
    if done and distributed.rank() == 0:
        print(f"{len(done)} of {len(plan.units)} rollouts were done before")
    mine = _measure(config, plan, todo[distributed.rank() :: distributed.world_size()], log)
    measured = done | {key: item for part in distributed.gather(mine) for key, item in part.items()}
    if distributed.rank() == 0:
        if len(measured) < len(plan.units):
            print(f"{len(measured)} of {len(plan.units)} rollouts are done; resume=true does the rest and writes the tables")
        else:
            _report(plan, measured, folder, overrides)
    return 0


def _measure(
    config: DictConfig, plan: Plan, todo: Sequence[EvaluationUnit], log: RolloutLog
) -> dict[EvaluationUnit, MeasuredRollout]:
    """This process's share of the rollouts; each is written down as soon as it is done."""
    potential, count = build(config.losses), int(config.num_frames)
    reference = replace(REFERENCE, max_iterations=int(config.gap_iterations))
    gaps = GapSettings(int(config.gap_states), reference, config.spectrum != "none")
    measured: dict[EvaluationUnit, MeasuredRollout] = {}
    quiet = True if distributed.rank() else None
    with tqdm(total=len(todo), desc="evaluate", unit="rollout", disable=quiet) as bar:

        def tell(text: str) -> None:
            bar.set_postfix_str(text, refresh=False)
            bar.refresh()

        for unit in todo:
            measured[unit] = _measure_unit(config, plan, unit, potential, count, gaps, tell)
            log.write(unit, plan.digests[unit.model], measured[unit])
            bar.update()
    return measured


def _measure_unit(
    config: DictConfig,
    plan: Plan,
    unit: EvaluationUnit,
    potential: Potential,
    count: int,
    gaps: GapSettings,
    tell: Callable[[str], None],
) -> MeasuredRollout:
    candidate, scene = plan.candidates[unit.model], plan.scene(unit)
    if unit.motion == STANDING:
        tell(f"{candidate.name} {unit.garment} {STANDING}")
        return MeasuredRollout(drifts=[sideways_drift(candidate.stepper, scene, potential)])
    kept, drawn = KeptFrames(), bool(config.contact_sheets)
    measured = measure(candidate, scene, potential, count, gaps, tell, partial(kept.see, scene) if drawn else None)
    if drawn:
        name = f"{unit.model}_{candidate.name}_{unit.garment}_{unit.motion}_{unit.shape}.png"
        _write_sheet(kept, output_folder(config) / "sheets" / name.replace("/", "-"))
    return measured


def _write_sheet(kept: KeptFrames, path: Path) -> None:
    from hood.media.film import Film, Shots, write_sheet

    path.parent.mkdir(parents=True, exist_ok=True)
    write_sheet(Film(kept.data(), 1280, 720, shots=Shots()), path)


def _report(plan: Plan, measured: Mapping[EvaluationUnit, MeasuredRollout], folder: Path, overrides: Sequence[str]) -> None:
    rows: list[dict[str, Any]] = []
    waves: list[dict[str, Any]] = []
    for index, candidate in enumerate(plan.candidates):
        parts: dict[str, list[MeasuredRollout]] = {name: [] for name in plan.garments}
        for unit in plan.units:
            if unit.model == index:
                parts[unit.garment].append(measured[unit])
        rows += candidate_rows(candidate, parts)
        for name, part in parts.items():
            waves += spectrum_rows(candidate.name, name, [item for one in part for item in one.spectra])
    vertices = {name: len(garment.rest_pos) for name, garment in plan.garments.items()}
    training = {candidate.name: candidate.training for candidate in plan.candidates}
    report_table(rows, conditions(plan.config, overrides, plan.motions, vertices, training), folder)
    if plan.config.spectrum != "none":
        report_spectrum(waves, folder, picture=plan.config.spectrum == "picture")


def _prepare(config: DictConfig, folder: Path) -> None:
    if bool(config.resume):
        require_same_config(config, folder, ("resume", "output", "max_rollouts"))
    else:
        for path in folder.glob("rollouts.*.jsonl"):
            path.unlink()
    save_run_record(folder, config, int(config.seed))


@dataclass
class Plan:
    """What is evaluated: every candidate with every garment on every motion."""

    config: DictConfig
    candidates: list[Candidate]
    digests: list[str]  # of the candidates' weights
    garments: dict[str, Garment]
    motions: list[str]
    shapes: list[np.ndarray]  # (10,) each

    @property
    def units(self) -> list[EvaluationUnit]:
        """The rollouts, in a fixed order."""
        performed = [(motion, shape) for shape in range(len(self.shapes)) for motion in self.motions]
        if int(self.config.drift_frames):
            performed.append((STANDING, 0))
        return [EvaluationUnit(m, g, *one) for m in range(len(self.candidates)) for g in self.garments for one in performed]

    def conditions(self) -> dict[str, Conditions]:
        """What every garment, on all bodies, asks of a model."""
        config, potential, betas = self.config, build(self.config.losses), np.concatenate(self.shapes)
        cloths = {
            name: build_cloth(
                garment.rest_pos, garment.faces, build(config.material), flat=garment.flat, made=garment.construction
            )
            for name, garment in self.garments.items()
        }
        fps = float(config.fps)
        return {
            name: scene_conditions(self.garments[name], cloth, 1.0 / fps, potential, betas) for name, cloth in cloths.items()
        }

    def scene(self, unit: EvaluationUnit) -> Scene:
        """The scene of a rollout; the last one is kept, and so is its motion."""
        return _scene(self, unit)


def _make_plan(config: DictConfig) -> Plan:
    """Candidates, garments and motions named in the config.

    Raises:
        ConfigError: two models or two garments with one name.
    """
    candidates = distinct([make_candidate(str(name), config) for name in config.models])
    titles = [candidate.name for candidate in candidates]
    if len(set(titles)) < len(titles):
        raise ConfigError(f"models={plain(config.models)}: names must differ, these are {', '.join(titles)}; rename a file")
    sequences = [str(name) for name in config.sequences]
    require_motions("sequences", sequences)
    motions = find_motions(sequences) or motion_split()["validation"]
    garments = [as_simulated(load_garment(str(name))) for name in config.garments]
    names = [garment.name for garment in garments]
    if len(set(names)) < len(names):
        raise ConfigError(f"garments={plain(config.garments)}: names must differ, these are {', '.join(names)}")
    shapes = [shape_coefficients(given, "shapes") for given in config.shapes]
    digests = [digest(candidate) for candidate in candidates]
    return Plan(config, candidates, digests, dict(zip(names, garments, strict=True)), motions, shapes)


@lru_cache(maxsize=1)
def _sequence(name: str, fps: float) -> PoseSequence:
    return load_sequence(name, fps)


def _scene(plan: Plan, unit: EvaluationUnit) -> Scene:
    config, garment, body = plan.config, plan.garments[unit.garment], load_body(str(plan.config.body))
    material, fps = build(config.material), float(config.fps)
    if unit.motion == STANDING:
        return standing_scene(garment, body, int(config.drift_frames), material, fps, device=str(config.device))
    sequence = _sequence(unit.motion, fps)
    return build_scene(garment, body, sequence, material, plan.shapes[unit.shape], device=str(config.device))


def _check_lists(config: DictConfig) -> None:
    for key, example in (("models", "[quickstart,newton]"), ("garments", "[tank]"), ("shapes", "[[]], the mean shape")):
        if not len(config[key]):
            raise ConfigError(f"{key}=[]: nothing is left to evaluate; give some, e.g. {key}={example}")
        require_distinct(key, plain(config[key]))


def _check_numbers(config: DictConfig) -> None:
    if not (math.isfinite(config.fps) and config.fps > 0):
        raise ConfigError(f"fps={config.fps:g}: must be a number of frames per second above 0, e.g. fps=30")
    most = config.max_rollouts
    if most is not None and (isinstance(most, bool) or not isinstance(most, int) or most < 1):
        raise ConfigError(f"max_rollouts={most}: must be a whole number of at least 1; null for all")
    for key, least, why in (
        ("num_frames", 4, "the first frames are not timed"),
        ("seed", 0, "it seeds random weights"),
        ("drift_frames", 0, "0 measures no drift"),
        ("gap_states", 0, "0 computes no gap"),
        ("gap_iterations", 1, "a reference needs iterations; gap_states=0 computes no gap"),
    ):
        if int(config[key]) < least:
            raise ConfigError(f"{key}={config[key]}: must be at least {least}, {why}")

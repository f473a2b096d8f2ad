"""``hood tradeoff``: time against accuracy of every setting, measured and charted on one page.

What ``hood tradeoff`` refuses before hours are spent on it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from hood.app.batch.batch import require_motions
from hood.app.candidates import device_name
from hood.app.common import (
    UNTRAINED,
    held_folder,
    output_folder,
    require_device,
    require_distinct,
    require_package,
)
from hood.app.scene.garments import shape_coefficients
from hood.app.settings.compose import ConfigError, load_config, options, plain
from hood.app.settings.record import require_same_config, save_run_record
from hood.app.stepping.steppers import find_option
from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import locate, names
from hood.assets.garment.garment import load_garment
from hood.assets.motion.motion_files import find_motions
from hood.evaluation.files import write_rows
from hood.evaluation.table import GUESS, NEWTON, model_name
from hood.steppers.checkpoint import read_header
from hood.steppers.published import SUFFIXES
from hood.steppers.refined import METHODS
from hood.studies.tradeoff.comparison import Study, pareto_front
from hood.studies.tradeoff.grid import Grid, GridSize, Point, listed_words
from hood.studies.tradeoff.points import Failure, Points
from hood.studies.tradeoff.results import Reached, overstretched, read_measured, read_reached, refinement_tables
from hood.tensors.dense import PRECISIONS, TF32, check_precision

#: Keys of ``hood evaluate`` that every point sets by itself.
_OWN = (
    "models", "garments", "sequences", "num_frames", "gap_states", "precision", "refine_method", "device", "output", "resume",
    "max_rollouts",
)  # fmt: skip


def _check_config(config: DictConfig, sizes: Sequence[str]) -> None:
    """Raise ConfigError where a key cannot be meant; names it."""
    require_device(config)
    require_package("matplotlib", "matplotlib", "charts", "hood tradeoff")
    for key in ("jobs", "turns"):
        if int(config[key]) < 1:
            raise ConfigError(f"{key}={config[key]}: must be at least 1")
    for key, known in (("refine_methods", METHODS), ("precisions", (*PRECISIONS, TF32))):
        given = [str(name) for name in config[key]]
        if not given or not set(given) <= set(known):
            raise ConfigError(f"{key}={plain(config[key])}: give some of {', '.join(known)}")
        require_distinct(key, given)
    for precision in config.precisions:
        check_precision(str(precision), torch.device(str(config.device)))
    sequences = [str(name) for name in config.sequences]
    require_motions("sequences", sequences)
    motions = find_motions(sequences)
    if not motions:
        raise ConfigError("sequences=[]: give motions")
    require_distinct("sequences", motions)
    for size in sizes:
        _check_size(config, size)


def check_models(names: Sequence[str]) -> None:
    """Raise an error unless every name is one of weights that are there, of random ones, or of a stepper.

    Raises:
        FileNotFoundError: no such weights.
        ValueError: not a model file, or no network's name; names it.
    """
    require_distinct("models", names)
    for name in names:
        if name in (GUESS, NEWTON):
            raise ConfigError(f"models: {name!r} is the solver, which has keys of its own: newton=true and guess_1k, _4k, _12k")
        if name.startswith(UNTRAINED + ":"):
            if name.removeprefix(UNTRAINED + ":") not in options("model"):
                raise ConfigError(f"models: {name!r} is no model; known are {', '.join(options('model'))}")
            continue
        if find_option(name) is not None:
            continue
        path = locate("weights", name)
        if path.suffix.lower() not in SUFFIXES:
            read_header(path)


def check_points(points: Sequence[Point]) -> None:
    """Raise ConfigError unless there are points, and ``hood evaluate`` reads their settings."""
    if not points:
        raise ConfigError("no point is left to measure: give garments, and models or newton=true")
    for point in {point.size: point for point in points}.values():
        load_config("evaluate", point.settings)


def check_settings(settings: Sequence[str]) -> None:
    """Raise ConfigError where one of the further ``settings`` of every point is one that points differ in."""
    for text in settings:
        key = text.split("=")[0].strip()
        if key in _OWN:
            raise ConfigError(f"settings: {key} is set by hood tradeoff itself; leave it out")


def _check_size(config: DictConfig, size: str) -> None:
    for key, least, why in (("frames", 4, "the first frames are not timed"), ("states", 1, "γ is what the chart shows")):
        if int(config[f"{key}_{size}"]) < least:
            raise ConfigError(f"{key}_{size}={config[f'{key}_{size}']}: must be at least {least}, {why}")
    for key, least in (("refine", 0), ("guess", 1)):
        for value in plain(config[f"{key}_{size}"]):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ConfigError(f"{key}_{size}: {value!r} is no number of iterations; give whole numbers from {least} on")
    if not plain(config[f"shapes_{size}"]):
        raise ConfigError(f"shapes_{size}=[]: give shape coefficients; [[]] is the mean body")
    for shape in plain(config[f"shapes_{size}"]):
        shape_coefficients(shape, f"shapes_{size}")
    for key in ("garments", "models", "precisions", "refine", "guess", "shapes"):
        require_distinct(f"{key}_{size}", plain(config[f"{key}_{size}"]))


#: Where no models are given: those of them that are embedded.
KNOWN = ("small-fine15", "small-fine48", "small-ours", "small1", "small2", "small3", "quickstart")
SIZES = ("1k", "4k", "12k")
#: Measured on the largest garments where nothing else is said.
_LARGEST = ("small-fine15", "small-ours")
#: Measured with all iterations at every size where nothing else is said.
_REFINED_MODEL = "small-ours"
#: Settings that may change from one call to the next: they add points or leave some out, and change none.
_FREE = ("models", "precisions", "refine_methods", "newton", "refined", "jobs", "turns", "measure", "output")
_FREE_BY_SIZE = ("refine", "guess", "models", "precisions")


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code: 1 where points failed and the page is without them."""
    config = load_config("tradeoff", overrides)
    folder = output_folder(config)
    _check_config(config, SIZES)
    check_settings([str(text) for text in config.settings])
    models, absent = chosen_models(config)
    grid = make_grid(config, models)
    points, vertices = grid.points(), _vertices(grid)
    check_points(points)
    device = str(config.device)
    name = f"{'CPU' if device == 'cpu' else 'GPU'} ({device_name(device)})"
    store = Points(folder / "points", int(config.jobs), name, int(config.turns))
    if not config.measure and not any(store.is_done(point) for point in points):
        raise ConfigError(f"measure=false: {folder} holds none of these points; leave measure out, or give their output")
    free = (*_FREE, *(f"{key}_{size}" for key in _FREE_BY_SIZE for size in SIZES))
    with held_folder(config):
        require_same_config(config, folder, free)
        save_run_record(folder, config, seed=0)
        failures = store.measure(points) if bool(config.measure) else []
        reached, failures = collect(store, points, vertices, failures)
        _write(folder, reached, failures, absent)
    return 1 if failures else 0


def chosen_models(config: DictConfig) -> tuple[list[str], list[str]]:
    """The models of the grid, and those of the known ones that are not embedded.

    Raises:
        FileNotFoundError, ValueError: a model that was asked for is not there, or none.
    """
    given = [str(name) for name in config.models]
    check_models(given)
    if given:
        return given, []
    there = names("weights")
    return [name for name in KNOWN if name in there], [name for name in KNOWN if name not in there]


def make_grid(config: DictConfig, models: Sequence[str]) -> Grid:
    """The grid that the config describes."""
    sequences = [str(name) for name in config.sequences]
    shared = [listed_words("sequences", sequences)]
    if str(config.device) != "cpu":
        shared.append(f"device={config.device}")
    sizes = tuple(_size(config, name, models) for name in SIZES)
    precisions, methods = (tuple(map(str, config[key])) for key in ("precisions", "refine_methods"))
    settings = (*shared, *(str(text) for text in config.settings))
    motions = len(find_motions(sequences))
    return Grid(tuple(models), precisions, methods, sizes, settings, bool(config.newton), motions)


def _size(config: DictConfig, name: str, models: Sequence[str]) -> GridSize:
    def values(key: str) -> tuple[Any, ...]:
        return tuple(plain(config[f"{key}_{name}"]))

    wanted = tuple(map(str, values("models")))
    if not wanted and name == SIZES[-1]:
        most = (*_LARGEST, _refined_model(config, models))
        wanted = tuple(model for model in models if {model, model_name(model)} & {*most}) or tuple(models[:1])
    garments = tuple(map(str, values("garments")))
    numbers = int(config[f"frames_{name}"]), int(config[f"states_{name}"])
    precisions = tuple(map(str, values("precisions")))
    further = () if name == SIZES[0] else tuple(plain(config[f"refine_{SIZES[0]}"]))
    refined = (_refined_model(config, models), further)
    shapes = tuple(tuple(map(float, shape)) for shape in values("shapes"))
    return GridSize(name, garments, values("refine"), values("guess"), *numbers, wanted, precisions, refined, shapes)


def _refined_model(config: DictConfig, models: Sequence[str]) -> str:
    """The model that is measured with every number of iterations at every size; "" for none."""
    if config.refined is None:
        return next((model for model in models if model_name(model) == _REFINED_MODEL), "")
    if str(config.refined) == "none":
        return ""
    if str(config.refined) not in (*models, *map(model_name, models)):
        raise ConfigError(f"refined={config.refined}: is none of the models ({', '.join(models) or 'none'})")
    return str(config.refined)


def collect(
    store: Points, points: Sequence[Point], vertices: dict[str, int], failures: Sequence[Failure]
) -> tuple[list[Reached], list[Failure]]:
    """What the points gave, and every point that gave nothing: each is in one of the lists."""
    reached, failed = [], list(failures)
    for point in points:
        if any(failure.point == point for failure in failures):
            continue
        if not store.is_done(point):
            failed.append(Failure(point, "not measured yet", store.log_of(point)))
            continue
        folder = store.folder_of(point)
        try:
            reached.append(read_reached(point, folder, vertices[point.size], read_measured(folder)))
        except ValueError as error:
            failed.append(Failure(point, str(error), store.log_of(point)))
    return reached, failed


def _write(folder: Path, reached: Sequence[Reached], failures: Sequence[Failure], absent: Sequence[str]) -> None:
    for failure in failures:
        log = f"; {failure.log}" if failure.log.exists() else ""
        print(f"hood: left out: {failure.point.size} {failure.point.label}: {failure.reason}{log}", file=sys.stderr)
    if not any(item.charted for item in reached):
        raise ValueError(f"{folder}: no point has a time and a gap; the logs in points/*/log.txt say why")
    from hood.studies.tradeoff.page import write_tradeoff_page

    rejected = overstretched(reached)
    left_out = [(failure.point, failure.reason, str(failure.log)) for failure in failures]
    study = Study(list(reached), rejected, left_out, list(absent))
    tables = [folder / "points.csv", *_write_tables(folder, reached)]
    page = write_tradeoff_page(study, folder)
    print(_front_text(reached, rejected))
    if study.warning:
        print(f"\n{study.warning}")
    print(f"\n{study.sentence}\n\npage in {page}, tables in {', '.join(map(str, tables))}")


def _write_tables(folder: Path, reached: Sequence[Reached]) -> list[Path]:
    """``points.csv`` and ``points.json``, and the tables for ``refine``, whose paths are returned: of every series, and
    ``refine_table.json`` of the checkpoint that ``hood rollout`` takes by default, where that was measured."""
    rows = [item.row() for item in reached]
    write_rows(rows, list(rows[0]), folder, "points")
    default, written = f"{load_config('rollout').checkpoint}_fp32", []
    for name, table in refinement_tables(reached).items():
        named = folder / f"refine_table_{name.replace('/', '-').replace(':', '-')}.json"
        for path in (folder / "refine_table.json", named) if name == default else (named,):
            write_atomically(path, _json(table))
            written.append(path)
    return written


def _json(table: Any) -> bytes:
    return json.dumps(table, indent=1, allow_nan=False).encode()


def _front_text(reached: Sequence[Reached], rejected: set[Point]) -> str:
    """The Pareto fronts as a table."""
    lines = [f"{'size':>5}  {'setting':<34}{'ms':>8}  {'γ median':>10}  {'γ p95':>10}  {'strain p99':>10}"]
    for size in dict.fromkeys(item.point.size for item in reached):
        for item in pareto_front([r for r in reached if r.point.size == size], rejected):
            numbers = f"{item.ms.value:8.1f}  {item.gap.value:10.3g}  {item.gap_p95.value:10.3g}  {item.strain_p99:10.1%}"
            lines.append(f"{size:>5}  {item.label:<34}{numbers}")
    return "\n".join(lines)


def _vertices(grid: Grid) -> dict[str, int]:
    """Mean number of vertices of the garments of every size."""
    counts = {size.name: [len(load_garment(name).rest_pos) for name in size.garments] for size in grid.sizes}
    return {name: round(sum(found) / len(found)) for name, found in counts.items() if found}

"""``hood tradeoff``: time against accuracy of every setting, measured and charted on one page."""

from __future__ import annotations

import csv
import importlib.util
import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hood.assets.atomic import write_atomically
from hood.assets.garment import load_garment
from hood.assets.library import locate, names
from hood.commands.batch import expand_sequences
from hood.commands.common import UNTRAINED, prepare_folder, require_device, require_same_config
from hood.commands.points import Failure, Points, device_name
from hood.config import ConfigError, load_config, plain, save_run_record
from hood.dynamics.refine import METHODS
from hood.evaluation.comparison import pareto_front
from hood.evaluation.grid import Grid, Point, Size, listed
from hood.evaluation.reached import Reached, overstretched, read_reached, read_record, refinement_tables
from hood.evaluation.study import Study

#: Where no models are given: those of them that are embedded.
KNOWN = ("fine15", "fine48", "ours", "small1", "small2", "small3", "quickstart")
SIZES = ("1k", "4k", "12k")
#: Measured on the largest garments where nothing else is said.
_LARGEST = ("fine15", "ours")
#: Settings that may change from one call to the next: they add points or leave some out, and change none.
_FREE = ("models", "precisions", "refine_methods", "newton", "jobs", "measure", "output")
_FREE_BY_SIZE = ("refine", "guess", "models")


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code: 1 where points failed and the page is without them."""
    config = load_config("tradeoff", overrides)
    require_device(config)
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError('hood tradeoff draws with matplotlib, which is not installed (pip install "hood[charts]")')
    _check(config)
    models, absent = chosen_models(config)
    grid = make_grid(config, models)
    points, vertices = grid.points(), _vertices(grid)
    _check_points(points)
    folder = Path(str(config.output)).expanduser()
    free = (*_FREE, *(f"{key}_{size}" for key in _FREE_BY_SIZE for size in SIZES))
    prepare_folder(folder)
    require_same_config(config, folder, free)
    save_run_record(folder, config, seed=0)
    store = Points(folder / "points", int(config.jobs), device_name(str(config.device)))
    failures = store.measure(points) if bool(config.measure) else []
    reached, failures = collect(store, points, vertices, failures)
    _write(folder, reached, failures, absent)
    return 1 if failures else 0


def chosen_models(config: DictConfig) -> tuple[list[str], list[str]]:
    """The models of the grid, and those of the known ones that are not embedded.

    Raises:
        FileNotFoundError: a model that was asked for is not there.
    """
    given = [str(name) for name in config.models]
    for name in given:
        if not name.startswith(UNTRAINED + ":"):
            locate("weights", name)
    if given:
        return given, []
    there = names("weights")
    return [name for name in KNOWN if name in there], [name for name in KNOWN if name not in there]


def make_grid(config: DictConfig, models: Sequence[str]) -> Grid:
    """The grid that the config describes."""
    shared = [listed("sequences", [str(name) for name in config.sequences])]
    if str(config.device) != "cpu":
        shared.append(f"device={config.device}")
    sizes = tuple(_size(config, name, models) for name in SIZES)
    precisions, methods = (tuple(map(str, config[key])) for key in ("precisions", "refine_methods"))
    settings = (*shared, *(str(text) for text in config.settings))
    return Grid(tuple(models), precisions, methods, sizes, settings, bool(config.newton))


def _size(config: DictConfig, name: str, models: Sequence[str]) -> Size:
    def values(key: str) -> tuple[Any, ...]:
        return tuple(plain(config[f"{key}_{name}"]))

    wanted = tuple(map(str, values("models")))
    if not wanted and name == SIZES[-1]:
        wanted = tuple(model for model in models if model in _LARGEST) or tuple(models[:1])
    garments = tuple(map(str, values("garments")))
    numbers = int(config[f"frames_{name}"]), int(config[f"states_{name}"])
    return Size(name, garments, values("refine"), values("guess"), *numbers, models=wanted)


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
            reached.append(read_reached(point, folder, vertices[point.size], read_record(folder)))
        except ValueError as error:
            failed.append(Failure(point, str(error), store.log_of(point)))
    return reached, failed


def _write(folder: Path, reached: Sequence[Reached], failures: Sequence[Failure], absent: Sequence[str]) -> None:
    for failure in failures:
        print(f"hood: left out: {failure.point.size} {failure.point.label}: {failure.reason}; {failure.log}", file=sys.stderr)
    if not any(item.charted for item in reached):
        raise ValueError(f"{folder}: no point has a time and a gap; the logs in points/*/log.txt say why")
    from hood.media.tradeoff_page import write_page

    rejected = overstretched(reached)
    left_out = [(failure.point, failure.reason, str(failure.log)) for failure in failures]
    study = Study(list(reached), rejected, left_out, list(absent))
    _write_tables(folder, reached)
    page = write_page(study, folder)
    print(_front_text(reached, rejected))
    if study.warning:
        print(f"\n{study.warning}")
    print(f"\n{study.sentence}\n\npage in {page}, tables in {folder / 'points.csv'} and {folder / 'refine_table.json'}")


def _write_tables(folder: Path, reached: Sequence[Reached]) -> None:
    """``points.csv`` and ``points.json``, and the tables for ``refine_table``: ``refine_table.json`` is that of the checkpoint
    that ``hood rollout`` takes by default, or of the first series where that was not measured."""
    rows = [item.row() for item in reached]
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(folder / "points.csv", text.getvalue().encode())
    write_atomically(folder / "points.json", json.dumps(rows, indent=1).encode())
    tables = refinement_tables(reached)
    for name, table in tables.items():
        write_atomically(folder / f"refine_table_{name.replace('/', '-').replace(':', '-')}.json", _json(table))
    if tables:
        default = f"{load_config('rollout').checkpoint}_fp32"
        write_atomically(folder / "refine_table.json", _json(tables.get(default, next(iter(tables.values())))))


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


def _check_points(points: Sequence[Point]) -> None:
    """Raise ConfigError unless ``hood evaluate`` reads the settings, before hours are spent on them."""
    if not points:
        raise ConfigError("no point is left to measure: give garments, and models or newton=true")
    own = {text.split("=")[0] for text in points[0].settings[:4]} | {"precision", "refine_method", "output", "resume"}
    for point in {point.size: point for point in points}.values():
        for text in point.settings:
            key = text.split("=")[0]
            if key in own and sum(other.split("=")[0] == key for other in point.settings) > 1:
                raise ConfigError(f"settings: {key} is set by hood tradeoff itself; leave it out")
        load_config("evaluate", point.settings)


def _check(config: DictConfig) -> None:
    if int(config.jobs) < 1:
        raise ConfigError(f"jobs={config.jobs}: must be at least 1")
    for key, known in (("refine_methods", METHODS), ("precisions", ("fp32", "bf16", "tf32"))):
        strange = [str(name) for name in config[key] if str(name) not in known]
        if strange or not len(config[key]):
            raise ConfigError(f"{key}={plain(config[key])}: give some of {', '.join(known)}")
    motions = expand_sequences([str(name) for name in config.sequences])
    if not motions:
        raise ConfigError("sequences=[]: give motions")
    for motion in motions:
        locate("motions", motion)
    for size in SIZES:
        _check_size(config, size)


def _check_size(config: DictConfig, size: str) -> None:
    for key, least, why in (("frames", 4, "the first frames are not timed"), ("states", 1, "γ is what the chart shows")):
        if int(config[f"{key}_{size}"]) < least:
            raise ConfigError(f"{key}_{size}={config[f'{key}_{size}']}: must be at least {least}, {why}")
    for key, least in (("refine", 0), ("guess", 1)):
        for value in plain(config[f"{key}_{size}"]):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ConfigError(f"{key}_{size}: {value!r} is no number of iterations; give whole numbers from {least} on")

"""``hood compare A.h5 B.h5``: rollouts of one motion next to each other, as a video and a contact sheet.

``hood compare runs/*``: trainings, as a table.
"""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from tqdm import tqdm

from hood.app.common import held_folder, output_folder, require_package, short_names, split_words, thinning
from hood.app.output.export import lay_on, read_checked, read_textures
from hood.app.settings.compose import ConfigError, require_choice, shown
from hood.app.settings.record import read_record, read_words
from hood.app.sweep import REASON, state_of
from hood.app.train import last_record
from hood.assets.files.atomic import write_atomically
from hood.assets.formats.raw_mesh import Texture
from hood.evaluation.files import fixed_width, write_rows
from hood.rollouts.file.reader import RolloutData

_COLOURS = ("strain", "rg", "contact", "fabric")
#: Written above a rollout where its file holds them: medians over the frames that have a value.
_NOTED = (
    ("gap", "gap {:.2g}"),
    ("relative_gradient", "rg {:.2g}"),
    ("strain_p99", "p99 strain {:.1%}"),
    ("ms_total", "{:.0f} ms a frame"),
)


@dataclass(frozen=True)
class _Entry:
    """A rollout that is compared."""

    path: Path
    name: str
    data: RolloutData
    textures: Mapping[str, Texture] = field(default_factory=dict)


def run(arguments: Sequence[str]) -> int:
    """Run the command ``compare``; returns the exit code."""
    files, config = _split(arguments)
    runs = _runs_among(files)
    if runs:
        return _compare_runs(runs, [word for word in arguments if "=" in word and not Path(word).exists()], config)
    if len(files) < 2:
        raise ConfigError(f"number of rollouts given: {len(files)}; give two or more, hood compare A.h5 B.h5")
    require_choice(config, "colour", _COLOURS)
    require_choice(config, "video", ("mp4", "gif", "none"))
    for key, least in (("num_frames", 1), ("video_stride", 1), ("seed", 0), ("height", 64)):
        if config[key] is not None and (not isinstance(config[key], int) or config[key] < least):
            raise ConfigError(f"{key}={config[key]}: must be a whole number, at least {least}")
    thinning(config)
    if str(config.video) == "none" and not bool(config.sheet):
        raise ConfigError("video=none and sheet=false leave nothing to draw; leave one of them out")
    if config.texture is not None and str(config.colour) != "fabric":
        raise ConfigError(
            f"colour={config.colour}: hides texture={config.texture}; add colour=fabric, or leave the texture out"
        )
    textures = read_textures(config)
    output_folder(config)
    require_package("PIL", "Pillow", "pictures", "hood compare")
    entries = _read(files, config)
    laid_on = lay_on(textures, [entry.data for entry in entries])
    entries = [replace(entry, textures=images) for entry, images in zip(entries, laid_on, strict=True)]
    if bool(config.blind):
        entries = _shuffled(entries, int(config.seed))
    with held_folder(config) as folder:
        _draw(entries, config, folder)
    return 0


def _split(arguments: Sequence[str]) -> tuple[list[Path], DictConfig]:
    """Files in their order and the config: a word of the form ``key=value`` is an override, every other word a file."""
    given, config = split_words("compare", arguments)
    files = [str(config[key]) for key in ("a", "b") if config[key] is not None] + given
    return [Path(name).expanduser() for name in files], config


def _read(files: Sequence[Path], config: DictConfig) -> list[_Entry]:
    """The rollouts, cut to the frames that are shown.

    Raises:
        ValueError: a file is none, or they cannot be shown side by side.
    """
    from hood.media.beside import require_same_motion

    paths = [path / "rollout.h5" if path.is_dir() else path for path in files]
    read = [(str(path), read_checked(path, str(config.colour))) for path in paths]
    count = None if config.num_frames is None else int(config.num_frames)
    cut = require_same_motion(read, count)
    return [_Entry(*one) for one in zip(paths, short_names(paths), cut, strict=True)]


def _shuffled(entries: Sequence[_Entry], seed: int) -> list[_Entry]:
    """An order that depends on the seed and on what the rollouts hold, not on the order in which they were given."""
    digests = {id(entry): hashlib.sha256(entry.data.cloth_pos.tobytes()).hexdigest() for entry in entries}
    order = sorted(entries, key=lambda entry: (digests[id(entry)], str(entry.path)))
    random.Random(f"{seed} {' '.join(digests[id(entry)] for entry in order)}").shuffle(order)
    return order


def _draw(entries: Sequence[_Entry], config: DictConfig, folder: Path) -> None:
    from hood.media.beside import Panel, SideBySide, write_beside
    from hood.media.video import save_png

    blind, colour = bool(config.blind), str(config.colour)
    rows = [{"title": _letter(i) if blind else e.name, **_facts(e)} for i, e in enumerate(entries)]
    panels = [
        Panel(entry.data, str(row["title"]), "" if blind else _note(row), entry.textures)
        for entry, row in zip(entries, rows, strict=True)
    ]
    height = int(config.height)
    view = SideBySide(panels, "none" if colour == "fabric" else colour, round(height / 1.4), height, thinning(config))
    written = []
    if bool(config.sheet):
        written.append(save_png(folder / "contact_sheet.png", view.sheet()))
    if str(config.video) != "none":
        frames = tqdm(range(0, view.num_frames, int(config.video_stride)), desc="video", unit="frame", disable=None)
        written.append(write_beside(view, folder / f"comparison.{config.video}", frames, int(config.video_stride)))
    key = {"colour": colour, "num_frames": view.num_frames, "blind": blind, "seed": int(config.seed), "left_to_right": rows}
    write_atomically(folder / "key.json", json.dumps(key, indent=1).encode())
    if not blind:
        print("\n".join(f"{row['title']}: {_note(row) or 'no metrics'}" for row in rows))
    print(f"files in {folder}: {', '.join(path.name for path in written)}; key.json says which is which")


def _facts(entry: _Entry) -> dict[str, Any]:
    """File, size and the medians that its metrics allow."""
    facts: dict[str, Any] = {"file": str(entry.path), "vertices": int(entry.data.cloth_pos.shape[1])}
    for name, _ in _NOTED:
        values = entry.data.metrics.get(name, np.empty(0))
        if np.isfinite(values).any():
            facts[name] = float(np.median(values[np.isfinite(values)]))
    return facts


def _note(facts: dict[str, Any]) -> str:
    return ", ".join(text.format(facts[name]) for name, text in _NOTED if name in facts)


def _letter(index: int) -> str:
    """A, B, … Z, then numbers."""
    return chr(ord("A") + index) if index < 26 else str(index + 1)


#: What a folder of a training holds, at least one of them.
_OF_RUNS = ("checkpoint.pt", "checkpoint.previous.pt", "metrics.jsonl", REASON, ".hydra")
#: Figures of a training, by the titles of their columns.
_FIGURES = {
    "loss": "loss",
    "rg": "relative_gradient",
    "γ": "validation_gap",
    "strain": "validation_strain_p99",
    "seconds": "seconds",
}
#: Columns of keys that the table has at most; the files have all.
_KEYS = 6


def table_of_runs(runs: Sequence[Path]) -> list[str]:
    """The table of trainings for a terminal: the keys in which they differ, how far they are, what was measured last."""
    rows, columns, further = _rows(runs)
    lines = fixed_width(rows, columns).splitlines()
    return [*lines, f"they differ in {', '.join(further)} as well"] if further else lines


def _compare_runs(runs: Sequence[Path], words: Sequence[str], config: DictConfig) -> int:
    strange = next((word for word in words if word.partition("=")[0] not in ("a", "b", "output")), None)
    if strange is not None:
        raise ConfigError(f"{strange}: is about rollouts, and {runs[0]} is a training; leave it out")
    target = output_folder(config) if any(word.startswith("output=") for word in words) else None
    if target is not None and target.suffix != ".csv":
        raise ConfigError(f"output={target}: the table of trainings is one file; name it, such as output=runs.csv")
    print("\n".join(table_of_runs(runs)))
    if target is not None:
        rows, columns, further = _rows(runs)
        target.parent.mkdir(parents=True, exist_ok=True)
        written = write_rows(rows, [*columns, *further], target.parent, target.stem)
        print(f"written: {', '.join(map(str, written))}")
    return 0


def _runs_among(paths: Sequence[Path]) -> list[Path]:
    """Folders of trainings; a folder that holds some, as that of a sweep, stands for them.

    Raises:
        ConfigError: some are trainings and others are not.
    """
    runs, others = list[Path](), list[Path]()
    for path in paths:
        inside = [] if _is_run(path) or not path.is_dir() else sorted(filter(_is_run, path.iterdir()))
        runs += [path] if _is_run(path) else inside
        others += [] if _is_run(path) or inside or path.name == "multirun.yaml" else [path]  # which Hydra writes beside them
    if runs and others:
        raise ConfigError(f"{others[0]}: is no training, and {runs[0]} is one; compare trainings or rollouts, not both")
    return runs


def _is_run(path: Path) -> bool:
    return not (path / "rollout.h5").exists() and any((path / name).exists() for name in _OF_RUNS)


def _rows(runs: Sequence[Path]) -> tuple[list[dict[str, Any]], list[str], list[str]]:
    """A row for every training, the columns of the table, and the keys in which they differ for which it has no room."""
    settings, rows = [_settings(run) for run in runs], list[dict[str, Any]]()
    if not all(words for _, words in settings):
        settings = [(record, dict(_leaves(record))) for record, _ in settings]
    keys = dict.fromkeys(key for _, values in settings for key in values if key not in ("output", "resume"))
    differ = [key for key in keys if len({values.get(key, "") for _, values in settings}) > 1]
    names = short_names([run / "rollout.h5" for run in runs])  # the name of a rollout is that of its folder
    for run, name, (record, values) in zip(runs, names, settings, strict=True):
        (iteration, total, state), figures = state_of(run, record), last_record(run)
        rows.append(
            {
                "run": name,
                **{key: values.get(key) for key in differ},
                "iteration": iteration,
                "of": total,
                **{title: figures.get(figure) for title, figure in _FIGURES.items()},
                "state": state,
            }
        )
    measured = [title for title in _FIGURES if any(row[title] is not None for row in rows)]
    return rows, ["run", *differ[:_KEYS], "iteration", "of", *measured, "state"], differ[_KEYS:]


def _settings(run: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """The record of a run, and its words where a sweep began it; each empty where there is none."""
    record, words = run / "config.yaml", run / ".hydra" / "overrides.yaml"
    return (read_record(record) if record.exists() else {}), (read_words(words) if words.exists() else {})


def _leaves(node: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Keys and values of a record, ``a.b`` for a key in another."""
    if isinstance(node, dict):
        for name, item in node.items():
            yield from _leaves(item, f"{key}.{name}" if key else str(name))
    else:
        yield key, shown(node)

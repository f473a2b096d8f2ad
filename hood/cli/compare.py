"""``hood compare A.h5 B.h5``: rollouts of one motion next to each other, as a video and a contact sheet."""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from tqdm import tqdm

from hood.app.common import held_folder, output_folder, require_package, split_words, thinning
from hood.app.output.export import lay_on, read_checked, read_textures
from hood.app.settings.compose import ConfigError, require_choice
from hood.assets.files.atomic import write_atomically
from hood.assets.formats.image import Texture
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
    if len(files) < 2:
        raise ConfigError(f"number of rollouts given: {len(files)}; give two or more, hood compare A.h5 B.h5")
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


def short_names(paths: Sequence[Path]) -> list[str]:
    """The shortest ends of the paths that tell them apart, ``rollout.h5`` left out."""
    parts = [path.absolute().parent.parts + (() if path.name == "rollout.h5" else (path.stem,)) for path in paths]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(set(parts)):
            break
    return names


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

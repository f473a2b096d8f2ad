"""``hood view rollout.h5 …``: rollouts as one HTML page that turns and plays in a browser, without a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig

from hood.app.common import frame_count, output_folder, split_words
from hood.app.output.export import read_checked
from hood.app.output.textures import lay_on, read_textures
from hood.app.settings.compose import ConfigError
from hood.assets.files.atomic import write_atomically
from hood.cli.compare import short_names
from hood.rollouts.file.reader import RolloutData

#: More would be too narrow to see anything.
_MOST = 4
#: A page beyond this [bytes] is slow to send and to open.
_HEAVY = 12_000_000


def run(arguments: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    files, config = _split(arguments)
    count = frame_count(config)
    target = output_folder(config)
    if target.suffix.lower() not in (".html", ".htm") or target.is_dir():
        raise ConfigError(f"output={target}: name a file that ends in .html, e.g. output=view.html")
    textures = read_textures(config)
    rollouts = [_first_frames(read_checked(path, "fabric"), count) for path in files]
    from hood.media.viewer.page import view_page

    names = short_names(files)
    title = " and ".join(names) if config.title is None else str(config.title)
    page = view_page(list(zip(names, rollouts, strict=True)), title, lay_on(textures, rollouts)).encode()
    target.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(target, page)
    frames = max(len(data.time) for data in rollouts)
    print(f"{target}: {len(page) / 1e6:.1f} MB, {frames} frames; open it in a browser")
    if len(page) > _HEAVY and frames > 1:
        most = max(max(data.cloth_pos.shape[1], data.body_pos.shape[1]) for data in rollouts)
        fewer = max(int(frames * _HEAVY / len(page)), 1)
        print(f"that is a heavy page, of up to {most:,} vertices a mesh: num_frames={fewer} keeps it below {_HEAVY / 1e6:g} MB")
    return 0


def _split(arguments: Sequence[str]) -> tuple[list[Path], DictConfig]:
    """Files in their order and the config: a word of the form ``key=value`` is an override, every other word a file."""
    given, config = split_words("view", arguments)
    if not 1 <= len(given) <= _MOST:
        raise ConfigError(f"number of rollouts given: {len(given)}; give one to {_MOST}, hood view rollout.h5")
    paths = [Path(name).expanduser() for name in given]
    return [path / "rollout.h5" if path.is_dir() else path for path in paths], config


def _first_frames(data: RolloutData, count: int | None) -> RolloutData:
    if count is None:
        return data
    metrics = {name: values[:count] for name, values in data.metrics.items()}
    return replace(
        data, cloth_pos=data.cloth_pos[:count], body_pos=data.body_pos[:count], time=data.time[:count], metrics=metrics
    )

"""``hood view rollout.h5 …``: rollouts as one HTML page that turns and plays in a browser, without a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hood.app.common import frame_count, output_folder, short_names, split_words
from hood.app.output.export import lay_on, read_checked, read_textures
from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import overrides
from hood.assets.files.atomic import write_atomically
from hood.rollouts.file.reader import RolloutData

#: More would be too narrow to see anything.
_MOST = 4
#: Height of the page in a notebook [pixels].
_HEIGHT = 640


@dataclass(frozen=True, repr=False)
class Page:
    """A page of the viewer, whole in one file. A notebook shows it where it is the value of a cell."""

    text: str  # HTML
    target: Path  # where save() writes it
    num_frames: int  # that can be played
    most: int  # vertices of the largest mesh

    def save(self, path: str | Path | None = None) -> Path:
        """Write the page, in place of a file that is there; returns its path, by default ``output``."""
        target = self.target if path is None else Path(path).expanduser()
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, self.text.encode())
        return target

    def __repr__(self) -> str:
        return f"Page({self.num_frames} frames, {len(self.text.encode()) / 1e6:.1f} MB)"

    def _repr_html_(self) -> str:
        """The page inside that of a notebook."""
        style = f"width:100%;height:{_HEIGHT}px;border:0"
        return f'<iframe title="hood view" style="{style}" srcdoc="{escape(self.text, quote=True)}"></iframe>'


def view(*rollouts: str | Path, **keys: Any) -> Page:
    """The page of ``hood view``: up to four rollouts to turn and play, in a notebook where it is the value of a cell.

    Args:
        rollouts: their ``rollout.h5``, or the folders of them.
        keys: those of ``hood view --help``, such as ``num_frames=30``.

    Returns:
        The page; ``save("view.html")`` writes it.

    Raises:
        ValueError, OSError: keys or files that cannot be used.

    Examples:
        >>> import hood
        >>> _ = hood.rollout(garment="tank", num_frames=3, video="none", output="outputs/tank")
        >>> hood.view("outputs/tank").save("tank.html").name
        'tank.html'
    """
    return viewer_page([*(str(Path(rollout)) for rollout in rollouts), *overrides(keys)])


def viewer_page(arguments: Sequence[str]) -> Page:
    """The page that words of ``hood view`` ask for: rollouts, and keys of configs/view.yaml.

    Raises:
        ConfigError, ValueError: words or files that cannot be used.
    """
    files, config = _split(arguments)
    count = frame_count(config)
    target = output_folder(config)
    if target.suffix.lower() not in (".html", ".htm") or target.is_dir():
        raise ConfigError(f"output={target}: name a file that ends in .html, e.g. output=view.html")
    textures = read_textures(config)
    whole = [read_checked(path, "fabric") for path in files]
    rollouts = [_first_frames(data, count) for data in whole]
    from hood.media.viewer.page import view_page

    names = short_names(files)
    title = " and ".join(names) if config.title is None else str(config.title)
    named = list(zip(names, rollouts, strict=True))
    text = view_page(named, title, lay_on(textures, rollouts), whole)
    most = max(max(data.cloth_pos.shape[1], data.body_pos.shape[1]) for data in rollouts)
    return Page(text, target, max(len(data.time) for data in rollouts), most)


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

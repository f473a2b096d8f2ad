"""Files of the rollout that was in a folder before: without them, what lies there is of one rollout."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hood.commands.export import exports_beside, remove_whole
from hood.config import plain

_NAMES = ("summary.json", "contact_sheet.png", "rollout.mp4", "rollout.gif", "plan.json")


def remove_earlier(folder: Path, config: DictConfig) -> None:
    """Remove summary, pictures, exports and plan of the rollout that was in ``folder``: they would pass for the next one's.

    The summary goes first: its presence says that everything is there. What ``config`` names as input stays.
    """
    given = {Path(word).expanduser().resolve() for word in _words(plain(config))}
    for path in (*(folder / name for name in _NAMES), *exports_beside(folder / "rollout.h5")):
        if path.resolve() not in given:
            remove_whole(path)


def _words(value: Any) -> Iterator[str]:
    """All strings in a value of a config."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _words(item)

"""``summary.json`` over many motions: the rows of every call that wrote into the folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hood.assets.files.atomic import write_atomically
from hood.assets.files.folder_lock import occupy
from hood.config import ConfigError

_NAME = "summary.json"
#: Seconds to wait for another call that writes its rows at this moment.
_PATIENCE = 20.0


def write_overview(output: Path, rows: Mapping[str, dict[str, Any]], folders: Mapping[str, Path]) -> Path:
    """Write the rows of this call, by motion, beside those of others that are still there; returns the file.

    Args:
        rows: summaries, or ``{"error": …}``.
        folders: of all motions of this call, in its order; those without a row yet keep the one that they had.
    """
    path = output / _NAME
    places = {name: folder.relative_to(output).as_posix() for name, folder in folders.items()}
    with occupy(output, _PATIENCE):
        before, their_places = _read(path)
        replaced = {places[name] for name in rows}
        kept = {
            name: row
            for name, row in before.items()
            if name not in rows and their_places.get(name) not in replaced and _is_there(output, their_places.get(name), row)
        }
        known = {name: place for name, place in their_places.items() if name in kept} | places
        order = [*(name for name in kept if name not in places), *places]
        shown = {name: row for name in order if (row := rows.get(name, kept.get(name))) is not None}
        content = {
            "num_motions": len(order),
            "motions": shown,
            "folders": {name: known[name] for name in order if name in known},
        }
        write_atomically(path, json.dumps(content, indent=1).encode())
    return path


def refuse_overview(folder: Path) -> None:
    """Raise ConfigError where one rollout would write into the folder of many, and replace the summary over all of them."""
    count = len(_read(folder / _NAME)[0])
    if count:
        raise ConfigError(f"output={folder}: holds the rollouts of {count} motions and their summary; give a folder of its own")


def refuse_rollout(folder: Path) -> None:
    """Raise ConfigError where the folder for many motions holds one rollout: its summary would be replaced."""
    if (folder / "rollout.h5").exists():
        raise ConfigError(
            f"output={folder}: holds one rollout, whose summary that of many would replace; choose another output"
        )


def _is_there(output: Path, place: str | None, row: Mapping[str, Any]) -> bool:
    """Whether a row of another call still says what lies in the folder; earlier versions do not say in which."""
    return place is None or "error" in row or (output / place / "rollout.h5").exists()


def _read(path: Path) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Rows and folders by motion that a file holds; nothing where it is none of many motions."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        motions, folders = content["motions"], content.get("folders", {})
    except (OSError, ValueError, KeyError, TypeError):
        return {}, {}
    ours = isinstance(motions, dict) and isinstance(folders, dict) and all(isinstance(row, dict) for row in motions.values())
    return (motions, folders) if ours else ({}, {})

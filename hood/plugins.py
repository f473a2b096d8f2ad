"""Installed packages that add to hood: their classes may be named in configs, and their configs are options beside ours.

A package registers in its ``pyproject.toml``; nothing else is ever imported or executed from a config::

    [project.entry-points."hood.plugins"]
    my_cloth = "my_cloth"

Options lie in its folder ``configs``, in groups as in ours: ``my_cloth/configs/losses/windy.yaml`` is ``losses=windy``.
"""

from __future__ import annotations

import importlib.util
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

#: Entry points of this group name packages.
GROUP = "hood.plugins"


@cache
def packages() -> tuple[str, ...]:
    """Names of the registered packages, in alphabetical order."""
    return tuple(sorted({point.value.split(":")[0] for point in entry_points(group=GROUP)}))


@cache
def config_folders() -> tuple[Path, ...]:
    """Folders of their configs, of those that have one.

    Raises:
        ValueError: a registered package is not there.
    """
    folders = []
    for name in packages():
        try:
            spec = importlib.util.find_spec(name)
        except ImportError:
            spec = None
        if spec is None:
            raise ValueError(f"plugin {name!r}: registered under {GROUP}, but there is no such package; install it again")
        folders += [Path(place) / "configs" for place in spec.submodule_search_locations or ()]
    return tuple(folder for folder in folders if folder.is_dir())

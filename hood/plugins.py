"""Installed packages that add to hood: configs that are options beside ours, and objects that are named beside ours.

A package registers in its ``pyproject.toml``; nothing else is ever imported or executed from a config or a model file::

    [project.entry-points."hood.plugins"]
    my_cloth = "my_cloth"

    [project.entry-points."hood.features"]
    curvature = "my_cloth:Curvature"

Options lie in its folder ``configs``, which its wheel has to hold, in groups as in ours:
``my_cloth/configs/losses/windy.yaml`` is ``losses=windy``. What stands in a group of :data:`KINDS` has a name of its own:
``model.features=physical+curvature``.
"""

from __future__ import annotations

import importlib.util
import re
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

#: Entry points of this group name packages.
GROUP = "hood.plugins"
#: Entry points of the group ``hood.KIND`` name objects: groups of features, outputs and networks of models, and readers of
#: mesh and motion files, which have a file's suffix, without its dot, as their name.
READERS = ("meshes", "motions")
#: ``commands``: functions that run ``hood COMMAND``, and ``planners``, of which ``accuracy`` makes the plan of a rollout that
#: has the key ``accuracy``. hood registers its own studies so; its core imports none of them.
KINDS = ("features", "outputs", "networks", "commands", "planners", *READERS)
#: Suffixes that mean something already.
TAKEN = frozenset(
    "npz npy pkl pickle pk p joblib obj ply off stl glb gltf usd usda usdc usdz pc2 mdd txt json csv h5 hdf5 safetensors pth "
    "pt ckpt".split()
)


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
    return tuple(folder for name in packages() for folder in _config_folders_of(name))


def without_options() -> str:
    """A sentence about the first registered package that has no option, with the way out; empty where each has one.

    A package is registered for its options and their classes; what builds it may leave out files that are not Python.
    """
    for name in packages():
        if not any(folder.glob("*/*.yaml") for folder in _config_folders_of(name)):
            return (
                f"the plugin {name!r} is installed without its files configs/GROUP/*.yaml: where setuptools builds it, add "
                f'[tool.setuptools.package-data] {name} = ["configs/**/*.yaml"] to its pyproject.toml, and install it again'
            )
    return ""


def _config_folders_of(name: str) -> list[Path]:
    """The folders ``configs`` of a registered package, as many as there are."""
    try:
        spec = importlib.util.find_spec(name)
    except ImportError:
        spec = None
    if spec is None:
        raise ValueError(f"plugin {name!r}: registered under {GROUP}, but there is no such package; install it again")
    folders = [Path(place) / "configs" for place in spec.submodule_search_locations or ()]
    return [folder for folder in folders if folder.is_dir()]


def names(kind: str) -> tuple[str, ...]:
    """Registered names of a kind, in alphabetical order."""
    return tuple(_points(kind))


def find(kind: str, name: str) -> Any:
    """The object that is registered under a name; its package is imported now.

    Raises:
        KeyError: there is none of that name.
        ValueError: its package cannot be imported, or does not have it.
    """
    point = _points(kind)[name]
    try:
        return point.load()
    except Exception as error:  # whatever the package raises while it is imported
        raise ValueError(
            f"plugin {point.value!r}: registered as {name!r} under hood.{kind}, but cannot be imported "
            f"({' '.join(str(error).split()) or type(error).__name__}); install it again"
        ) from error


def origin(kind: str, name: str) -> str:
    """The distribution that registers a name, and its version: ``my-cloth 1.0``.

    Raises:
        KeyError: there is none of that name.
    """
    point = _points(kind)[name]
    return point.value if point.dist is None else f"{point.dist.name} {point.dist.version}"


def forget() -> None:
    """Look again at the next question: a package has been installed or removed since."""
    for function in (packages, config_folders, _points):
        function.cache_clear()


@cache
def _points(kind: str) -> dict[str, EntryPoint]:
    """Entry points of a kind by name.

    Raises:
        ValueError: two packages register one name, or one registers what no name can be.
    """
    assert kind in KINDS, kind
    found: dict[str, EntryPoint] = {}
    for point in sorted(entry_points(group=f"hood.{kind}"), key=lambda point: (point.name, point.value)):
        if not re.fullmatch(r"[a-z][a-z0-9_]*", point.name) or (kind in READERS and point.name in TAKEN):
            raise ValueError(
                f"plugin {point.value!r}: is registered as {point.name!r} under hood.{kind}; "
                + ("its suffix is hood's own" if point.name in TAKEN else "give it a name of small letters, digits and _")
            )
        other = found.setdefault(point.name, point)
        if other.value != point.value:
            raise ValueError(
                f"plugins {other.value!r} and {point.value!r}: both are registered as {point.name!r} under hood.{kind}; "
                "uninstall one of the two"
            )
    return found

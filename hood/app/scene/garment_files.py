"""Garments from files, brought to cloth of one layer that hangs together; what was done is warned about.

``objects``, ``weld``, ``shells`` and ``small_parts`` of a config.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hood.app.settings.compose import ConfigError, plain, require_choice
from hood.app.settings.rollout_settings import Settings, objects
from hood.assets.contents.sort_out import mend, take_objects
from hood.assets.files.said import Doubt
from hood.assets.fitting.suspicions import suspect_seams
from hood.assets.formats.mesh_file import mesh_suffixes, read_mesh_file
from hood.assets.garment.garment import Garment, garment_of_mesh, load_garment, locate_garment
from hood.assets.garment.record import FILE, SHELLS, SMALL_PARTS, Change, Wanted, start_fitting
from hood.mesh.editing import repair
from hood.mesh.editing.quality import check_triangles

#: Changes that somebody asked for.
_ASKED = ("objects",)


def read_garment(name: str, wanted: Wanted, surface: np.ndarray, triangulate: bool) -> Garment:
    """The garment ``name``; one of a mesh file as ``wanted`` says, with ``file_numbers`` where its vertices have other numbers.

    Args:
        surface: (W, 3) m, the body that it is measured against.
        triangulate: split polygons instead of refusing them.

    Raises:
        ValueError: a file that cannot be read or simulated.
    """
    path, entry = locate_garment(name)
    stitches, wanted = None, meant_by(entry, path, wanted)
    if path.suffix.lower() not in mesh_suffixes():
        garment = load_garment(name, triangulate=triangulate)
        if garment.bound and not wanted.objects:
            return garment
    else:
        mesh = read_mesh_file(path, triangulate)
        garment, stitches = garment_of_mesh(path, mesh), mesh.stitches
        twice = repair.duplicate_faces(garment.faces)
        check_triangles(garment.rest_pos, garment.faces[~twice], str(path))
    _refuse_soup(garment)
    fitting = start_fitting(garment, stitches)
    take_objects(fitting, wanted, surface)
    mend(fitting, wanted, surface)
    check_triangles(fitting.garment.rest_pos, fitting.garment.faces, str(path))
    tell(path, fitting.changes)
    return fitting.garment


def meant_by(entry: str | None, path: Path, wanted: Wanted) -> Wanted:
    """What is asked of a file, one object of which may stand behind its name."""
    of_mesh = entry is not None and path.suffix.lower() in mesh_suffixes()
    return replace(wanted, objects=(str(entry),)) if of_mesh else wanted


def _refuse_soup(garment: Garment) -> None:
    for suspicion in suspect_seams(garment.rest_pos, garment.faces):
        if suspicion.grave:
            raise ValueError(f"garment {garment.name!r} {suspicion.sentence}")


def tell(path: Path, changes: Sequence[Change]) -> None:
    """Warn about what was done to the garment of a file: guesses as doubts, with the key that settles them."""
    name = path.stem
    for change in changes:
        if change.what in _ASKED:
            continue
        if change.fix:
            fix = change.fix.replace(FILE, str(path))
            warnings.warn(Doubt("garment", f"garment {name!r}: {change.text}; {fix}", value=change.count), stacklevel=2)
        else:
            warnings.warn(f"garment {name!r}: {change.text}", stacklevel=2)


def said(change: Mapping[str, Any], file: str) -> str:
    """A change of the garment of ``file``, as a dict, in one sentence."""
    return "; ".join(filter(None, (change["text"], change["fix"].replace(FILE, file))))


AUTO, NONE = "auto", "none"


def wanted_of(config: Settings) -> Wanted:
    """What is asked of garments' files.

    Raises:
        ConfigError: a value of the wrong kind; names the key.
    """
    require_choice(config, "shells", SHELLS)
    require_choice(config, "small_parts", SMALL_PARTS)
    weld = plain(config.weld)
    return Wanted(
        objects=tuple(map(str, objects(config).garment)),
        sew=weld != NONE,
        gap=None if weld in (AUTO, NONE) else _metres(weld),
        shells=str(config.shells),
        small_parts=str(config.small_parts),
        layered=plain(config.get("layers", AUTO)) != AUTO,
    )


def words_of(wanted: Wanted) -> list[str]:
    """The words of a command that ask for this; none for what is usual."""
    usual = Wanted()
    weld = NONE if not wanted.sew else f"{wanted.gap}"
    words = {
        "objects": None if not wanted.objects else f"objects=[{','.join(wanted.objects)}]",
        "weld": None if (wanted.sew, wanted.gap) == (usual.sew, usual.gap) else f"weld={weld}",
        "shells": None if wanted.shells == usual.shells else f"shells={wanted.shells}",
        "small_parts": None if wanted.small_parts == usual.small_parts else f"small_parts={wanted.small_parts}",
    }
    return [word for word in words.values() if word is not None]


def _metres(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (np.isfinite(value) and value >= 0):
        raise ConfigError(f"weld={value}: give a number ≥ 0 or auto")
    return float(value)

"""Garments from files, brought to cloth of one layer that hangs together; what was done is warned about."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.doubt import Doubt
from hood.assets.formats.mesh_file import mesh_suffixes, read_mesh_file
from hood.assets.garment.contents.fitting import Change, start_fitting
from hood.assets.garment.contents.sort_out import choose, mend
from hood.assets.garment.contents.wanted import FILE, Wanted
from hood.assets.garment.garment import Garment, garment_of_mesh, load_garment, locate_garment
from hood.assets.garment.suspicions import suspect_seams
from hood.mesh import repair
from hood.mesh.quality import check_triangles

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
    choose(fitting, wanted, surface)
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

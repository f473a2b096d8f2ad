"""The garment in a file that is not one tidy sheet: one way for rollouts, ``hood prepare`` and ``hood inspect``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hood.assets.contents.garments import drop_copies, tell_apart, to_one_layer
from hood.assets.contents.objects import choose_objects, leave_body_out
from hood.assets.contents.panels import sew_panels, sew_stitches
from hood.assets.contents.small_parts import let_ride
from hood.assets.fitting.alterations import drop_faces, sew
from hood.assets.fitting.placement import find_scale, possible, used
from hood.assets.garment.garment import Garment
from hood.assets.garment.record import Fitting, Wanted
from hood.mesh.editing import repair
from hood.mesh.editing.repair import find_spikes

#: Beside the median edge a gap up to this share is short: within a longer one vertices along a rim would be joined too.
_NEAR = 0.25
#: Vertices nearer than this [m] to a neighbour stand out too little to be seen.
_SPIKE = 0.05


def metres_per_unit(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray) -> float:
    """Metres per unit of a file, by the size of what it shows beside a body (W, 3) [m]; 1 where that does not say."""
    found = find_scale(used(pos, faces), surface)
    return next(iter(possible(used(pos, faces), surface)), 1.0) if found is None else found


def take_objects(fitting: Fitting, wanted: Wanted, surface: np.ndarray) -> None:
    """Leave out what is not the garment: objects that are not wanted, a body beside it, faces that are there twice.

    Args:
        surface: (W, 3) m, the body that the garment is measured against.
    """
    garment = fitting.garment
    choose_objects(fitting, wanted.objects)
    if _is_made(garment):
        return
    if not wanted.objects:
        leave_body_out(fitting, surface)
    _drop_duplicates(fitting)
    if wanted.shells == "auto":
        drop_copies(fitting)
    _keep_numbers(fitting)


def mend(fitting: Fitting, wanted: Wanted, surface: np.ndarray | None, open_edges: np.ndarray | None = None) -> None:
    """Bring what was chosen to cloth of one layer that hangs together, with what rides on it, and tell garments apart.

    Each step changes nothing of a file that has no need of it, and notes what it did. Garments that are bound, or worn
    elsewhere than they rest, and outfits have been through this.

    Args:
        surface: as of :func:`take_objects`; None: the garment is in metres.
        open_edges: vertices of the file, in any shape, that nothing is to be sewn to, such as those along a zipper.
    """
    garment = fitting.garment
    if _is_made(garment):
        return
    scale = 1.0 if surface is None else metres_per_unit(garment.rest_pos, garment.faces, surface)
    sides = np.zeros(0, dtype=np.int64) if open_edges is None else open_edges
    if wanted.sew:
        sew(fitting, None, fitting.at_present(sides))
        sew_stitches(fitting, scale)
        _drop_collapsed(fitting)
    if wanted.shells == "auto":
        to_one_layer(fitting, scale)
    if wanted.sew:
        sew_panels(fitting, wanted, scale, sides)
        _drop_collapsed(fitting)
    _tell_spikes(fitting, scale)
    let_ride(fitting, wanted, scale)
    tell_apart(fitting, wanted, scale)
    _keep_numbers(fitting)


def weld_and_mend(fitting: Fitting, wanted: Wanted, open_edges: np.ndarray) -> None:
    """:func:`mend` of a garment in metres, or of one that has been through it, for ``hood prepare``: a gap that is short beside
    the edges is that between vertices, which are welded; a longer one is that between rims."""
    edge = repair.weld_tolerance(fitting.garment.rest_pos, fitting.garment.faces) / repair.WELD_RATIO
    near = wanted.gap is not None and wanted.gap <= _NEAR * edge
    if wanted.sew:
        sew(fitting, wanted.gap if near else None, fitting.at_present(open_edges))
    mend(fitting, replace(wanted, gap=None) if near else wanted, None, open_edges)


def _is_made(garment: Garment) -> bool:
    return garment.bound or garment.piece is not None or garment.skin_pos is not None


def _keep_numbers(fitting: Fitting) -> None:
    """The garment knows its vertices by their numbers in the file, where these are others."""
    same = np.array_equal(fitting.vertex_map, np.arange(len(fitting.garment.rest_pos)))
    fitting.garment = replace(fitting.garment, file_numbers=None if same else fitting.vertex_map)


def _drop_duplicates(fitting: Fitting) -> None:
    """Faces with the vertices of another one."""
    duplicate = repair.duplicate_faces(fitting.garment.faces)
    if duplicate.any():
        drop_faces(fitting, ~duplicate)
        fitting.note("removed_duplicate_faces", int(duplicate.sum()), f"removed {int(duplicate.sum())} duplicate faces")


def _drop_collapsed(fitting: Fitting) -> None:
    """Faces two corners of which have become one vertex, or that have become another one's double."""
    faces = np.sort(fitting.garment.faces, axis=1)
    gone = (faces[:, 1:] == faces[:, :-1]).any(axis=1) | repair.duplicate_faces(faces)
    if gone.any():
        drop_faces(fitting, ~gone)


def _tell_spikes(fitting: Fitting, scale: float) -> None:
    """Vertices far out of the cloth: they are simulated as they are, for the rest shape has them."""
    spikes = find_spikes(scale * fitting.garment.rest_pos, fitting.garment.faces, _SPIKE)
    if not len(spikes.vertices):
        return
    numbers = fitting.in_file(spikes.vertices)
    count, first = len(numbers), int(numbers.argmin())
    who = f"vertex {numbers[first]} stands" if count == 1 else f"{count} vertices stand"
    by = f"by {spikes.height[first]:.2g} m" if count == 1 else f"vertex {numbers[first]} by {spikes.height[first]:.2g} m"
    text = f"{who} out of the mesh, {by}, {spikes.ratio[first]:.0f} times the edges around it"
    fitting.guess("spikes", count, text, "smooth or delete what stands out where the mesh was made")

"""``hood prepare body=MESH``: a garment repaired and placed on a mesh as it stands in its first frame.

A mesh has no skeleton of the family to bind to: the garment is written as it is worn there, which is how rollouts with the
same body take it. Its rest lengths are those of its file.

``fasten=`` of ``hood prepare``: rows of fasteners on a garment of one's own.
"""

from __future__ import annotations

import json
import shlex
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from hood.app.common import prepare_folder
from hood.app.scene.garment_files import meant_by, said, wanted_of
from hood.app.scene.garments import checked_pins, heed, names_of
from hood.app.scene.placing import AUTO, asked_keys, explain_size, find_place_on_mesh, keep_place
from hood.app.settings.compose import ConfigError, plain
from hood.app.settings.overrides import plain_word
from hood.assets.contents.sort_out import take_objects, weld_and_mend
from hood.assets.fitting import alterations
from hood.assets.fitting.suspicions import suspect_kind, suspect_place, suspect_seams
from hood.assets.garment.binding import push_out, signed_distances
from hood.assets.garment.fasteners import ROOM, fasten, with_room
from hood.assets.garment.garment import Garment, locate_garment, save_garment
from hood.assets.garment.outfit import join_garments
from hood.assets.garment.pins import pin_mask, pin_numbers
from hood.assets.garment.record import Fitting
from hood.mesh.editing.quality import check_triangles
from hood.scene.body_motion.load import NO_MOTION, MotionOptions, load_motion
from hood.scene.body_motion.mesh_motion import MeshMotion
from hood.scene.scene import dressed_scene
from hood.scene.worn import FitFigures, fit_figures


def fasten_as_asked(fitting: Fitting, config: DictConfig) -> np.ndarray:
    """Give the garment on its way the rows that the config asks for; the pairs (N, 2) along their edges, in the numbers of the
    file, which nothing joins.

    Raises:
        ConfigError: ``fasten`` is no table of rows, or the garment is one of several.
        ValueError: a row that the garment cannot have; names it.
    """
    fitting.garment, pairs = fasten(fitting.garment, _rows(config))
    return fitting.in_file(pairs)


def give_room(fitting: Fitting, pairs: np.ndarray) -> None:
    """Draw the two sides of the rows of a clean garment, and other ``pairs`` (N, 2) of its file, as far apart as cloth has to
    be; the fitting notes it."""
    present = fitting.vertex_map[pairs]
    rows = [present[(present >= 0).all(axis=1)], *(fitting.garment.fasteners or {}).values()]
    fitting.garment, moved = with_room(fitting.garment, np.concatenate(rows))
    fitting.note("drawn_apart", moved, f"drew {moved} vertices of fasteners apart: pairs are {1e3 * ROOM:g} mm from each other")


def _rows(config: DictConfig) -> dict[str, Any]:
    given = plain(config.fasten)
    if given is None:
        return {}
    if not isinstance(given, dict) or not given:
        raise ConfigError(f"fasten={given}: give rows by name, such as fasten={{front_zip: {{heights: [0.0, 0.55]}}}}")
    if len(names_of(config.garment)) > 1:
        raise ConfigError("fasten=…: prepare the garments one by one, and give hood rollout all of them")
    return given


#: Keys that say in which pose and shape of a model a garment was made: a mesh has one of each.
_OF_MODELS = {"pose": AUTO, "betas": []}


def prepare_for_mesh(config: DictConfig, names: list[str], target: Path, read: Callable[[str], Fitting]) -> int:
    """Prepare the garments ``names`` for the mesh that ``config.body`` names; ``read`` reads one as it is.

    Raises:
        ValueError: a garment that is none, or is not worn by the mesh where it is.
    """
    for key, usual in _OF_MODELS.items():
        if plain(config[key]) != usual:
            raise ConfigError(f"{key}={config[key]}: body={config.body} is a mesh, which has one pose and shape; leave it out")
    options = MotionOptions(
        fps=float(config.fps), up=str(config.body_up), num_frames=2,
        scale=None if config.body_scale is None else float(config.body_scale),
    )  # fmt: skip
    motion = load_motion(str(config.body), NO_MOTION, options)
    assert isinstance(motion, MeshMotion)
    fittings = [_fit(read(name), name, config, motion) for name in names]
    outfit = _pin(join_garments([fitting.garment for fitting in fittings]), fittings, config)
    scene = dressed_scene(outfit, motion)
    scene.start(0, thorough=True)  # refuses what a limb passes through
    figures = fit_figures(scene)
    prepare_folder(target.parent)
    save_garment(target, outfit)
    report = _report(names, fittings, outfit, figures, target)
    print(json.dumps(report, indent=1) if str(config.format) == "json" else _text(report, config))
    return 0


def _fit(fitting: Fitting, name: str, config: DictConfig, motion: MeshMotion) -> Fitting:
    """One garment on the mesh: in metres, where it fits, sewn, clean, outside the skin; where it fits nowhere, auto leaves it
    where it is, for the unit."""
    garment, surface, clearance = fitting.garment, motion.points(0), float(config.clearance)
    path, entry = locate_garment(name)
    wanted = meant_by(entry, path, wanted_of(config))
    take_objects(fitting, wanted, surface)
    garment = fitting.garment
    heed(garment.name, suspect_kind(garment.rest_pos, garment.faces, surface))
    if not clearance >= 0:
        raise ConfigError(f"clearance={config.clearance}: give a number ≥ 0")
    asked = asked_keys(config)
    found = find_place_on_mesh(garment, motion, asked)
    if found is not None and found.resized is not None:
        what, fix = explain_size(found.resized)
        warnings.warn(f"garment {garment.name!r} {what}; written as it is: {fix}", stacklevel=2)
    if found is None or found.refusal is not None:
        alterations.place(fitting, keep_place(garment, surface, asked))
    else:
        alterations.place(fitting, found.placement)
    sides = fasten_as_asked(fitting, config)
    if str(config.weld) == "none":
        heed(garment.name, suspect_seams(fitting.garment.rest_pos, fitting.garment.faces))
    weld_and_mend(fitting, wanted, sides)
    alterations.clean(fitting)
    check_triangles(fitting.garment.rest_pos, fitting.garment.faces, name)
    # What another body's weights say does not hold here: the place of a garment is where it is worn.
    fitting.garment = replace(
        fitting.garment, lbs_weights=None, shapedirs=None, bound_to=None, rest_turn=None, skin_pos=fitting.garment.worn_pos
    )
    _leave_mesh(fitting, motion, clearance)
    give_room(fitting, sides)
    return fitting


def _leave_mesh(fitting: Fitting, motion: MeshMotion, clearance: float) -> None:
    """Where the garment is worn, outside the mesh in its first frame, or in its rest pose where that is nearer; its outside
    away from it."""
    rest, pos = motion.sequence.rest, fitting.garment.worn_pos
    surfaces = [motion.points(0)] if rest is None else [motion.points(0), rest]
    dist, surface = min(
        ((signed_distances(pos, surface, motion.faces), surface) for surface in surfaces),
        key=lambda pair: float(np.median(np.abs(pair[0]))),
    )
    alterations.face_out(fitting, surface, motion.faces)
    garment = fitting.garment
    heed(garment.name, suspect_place(pos, garment.faces, surface, motion.faces))
    pushed = push_out(pos, surface, motion.faces, clearance)
    fitting.garment = replace(garment, skin_pos=np.where((dist < 0)[:, None], pushed.pos, pos))
    share = 100 * pushed.num_inside / len(pos)
    text = f"worn outside the body: {pushed.num_inside} vertices ({share:.1f}%) were inside, to {1e3 * pushed.depth:.1f} mm"
    fitting.note("pushed_out", pushed.num_inside, text, depth=pushed.depth)


def _pin(outfit: Garment, fittings: list[Fitting], config: DictConfig) -> Garment:
    if config.pins is None:
        return outfit
    given = checked_pins(plain(config.pins))
    numbers, _ = pin_numbers(given)
    if len(numbers) and any(len(fitting.vertex_map) != len(fitting.garment.rest_pos) for fitting in fittings):
        raise ConfigError("pins: vertices were joined or removed, and numbers are those of the file; pin with hood rollout")
    return replace(outfit, pinned=pin_mask(given, outfit, None))


def _report(names: list[str], fittings: list[Fitting], outfit: Garment, figures: FitFigures, target: Path) -> dict[str, Any]:
    garments = [
        {"file": name, "result": alterations.summary(one.garment), "changes": [asdict(change) for change in one.changes]}
        for name, one in zip(names, fittings, strict=True)
    ]
    return {
        "garments": garments,
        "num_vertices": len(outfit.rest_pos),
        "num_faces": len(outfit.faces),
        "num_pinned": int(outfit.pinned.sum()),
        "starts": {"first frame": asdict(figures)},
        "output": str(target),
    }


def _text(report: dict[str, Any], config: DictConfig) -> str:
    body, lines = str(config.body), []
    for part in report["garments"]:
        lines.append(f"{part['file']}:")
        lines += [f"  {said(change, part['file'])}" for change in part["changes"]] or ["  nothing to repair"]
        lines.append(f"  now {part['result']}")
    start = report["starts"]["first frame"]
    words = [plain_word("garment", report["output"]), plain_word("body", body)]
    words += [] if config.body_scale is None else [f"unit={config.body_scale:g}"]
    words += [] if str(config.body_up) == "auto" else [f"up={config.body_up}"]
    run = shlex.join(["hood", "rollout", *words])
    return "\n".join(
        [
            *lines,
            f"start in the first frame of {body}: edges stretched by at most {100 * start['stretch_max']:.1f}%, "
            f"deepest vertex {1e3 * start['depth_max']:.1f} mm",
            f"written to {report['output']}; run it with: {run}",
        ]
    )

"""Facts and problems of single files for ``hood inspect``; each problem comes with what repairs it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hood.app.common import load_stepper
from hood.app.output.frames import summarise_rate
from hood.app.scene.garment_files import meant_by, words_of
from hood.app.scene.placing import explain_unplaced, find_place, unit_alone
from hood.app.settings.overrides import plain_word
from hood.app.stepping.guarding import summarise_guard
from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.assets.contents.sort_out import mend, take_objects
from hood.assets.files.atomic import is_occupied
from hood.assets.files.library import locate
from hood.assets.files.text import read_indices
from hood.assets.fitting.fit_search import AskedFit
from hood.assets.fitting.placement import LENGTH_UNITS, size_ratio, surrounds, used
from hood.assets.fitting.suspicions import suspect_kind, suspect_sides
from hood.assets.formats.mesh_file import mesh_suffixes, read_mesh_file
from hood.assets.garment.binding import posed_body
from hood.assets.garment.garment import Garment, garment_of_mesh, load_garment, locate_garment
from hood.assets.garment.pins import opening_names
from hood.assets.garment.record import Fitting, Wanted, start_fitting
from hood.assets.motion.sequence_edit import arms_down
from hood.cli.inspect.garment import describe_made, describe_objects, describe_place, place_beside_mesh, problems_of
from hood.mesh.editing.quality import check_triangles
from hood.mesh.editing.repair import Defects, find_defects
from hood.mesh.topology import boundary_loops
from hood.rollouts.file.reader import read_published, read_rollout
from hood.rollouts.verdict.frames import worst_frame
from hood.rollouts.verdict.rule import judge_rollout
from hood.scene.body_motion.load import NO_MOTION, MotionOptions, load_motion
from hood.scene.body_motion.mesh_motion import MeshMotion
from hood.steppers import ranges

#: Openings beyond this number are torn seams: they are counted, not named.
_MOST_OPENINGS = 12
_SIMULATE_AGAIN = (
    "simulate again: with stepper=newton or refine=5 where a network went alone, with more solver.max_iterations where the "
    "solver missed its target, with a motion that does not jump there"
)


@dataclass
class Finding:
    """What one file is. ``problems`` are pairs of what is wrong and what repairs it; ``repairs`` are overrides of prepare."""

    file: str
    kind: str
    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[tuple[str, str]] = field(default_factory=list)
    repairs: list[str] = field(default_factory=list)
    wearer: list[str] = field(default_factory=list)  # overrides of prepare that name the body, where it is not the default
    refused: bool = False  # prepare would refuse it

    @property
    def command(self) -> str | None:
        """The command that repairs a garment; None where nothing needs repair, or no command can."""
        if self.refused or not self.repairs:
            return None
        words = [plain_word("garment", self.file), *self.wearer, *filter(None, dict.fromkeys(self.repairs))]
        return " ".join(["hood prepare", *map(shlex.quote, words)])

    def problem(self, what: str, fix: str, repair: str | None = None) -> None:
        """Record a problem; ``repair`` is what prepare needs to be told, "" where it does it unasked."""
        self.problems.append((what, fix))
        if repair is not None:
            self.repairs.append(repair)


def unreadable(name: str, kind: str, error: Exception) -> Finding:
    """A file that cannot be read: why is its problem."""
    sentence = " ".join(str(error).split()) or type(error).__name__
    return Finding(name, kind, problems=[(sentence.removeprefix(f"{name}: "), "")])


def inspect_garment(
    name: str,
    body: Body | MeshMotion,
    wearer: Sequence[str],
    betas: np.ndarray | None = None,
    wanted: Wanted | None = None,
) -> Finding:
    """A garment file beside ``body``: a model of shape ``betas`` in its T-pose, or a mesh in its first frame.

    ``wearer`` are the words of prepare that name this body, ``wanted`` is what is asked of a file of several things.
    """
    finding, stitches = Finding(name, "garment", wearer=list(wearer)), None
    path, entry = locate_garment(name)
    if path.suffix.lower() in mesh_suffixes():
        mesh = read_mesh_file(path, split_polygons=True)
        garment, stitches = garment_of_mesh(path, mesh), mesh.stitches
        finding.kind = "garment mesh"
        if mesh.num_polygons:
            finding.problem(f"{mesh.num_polygons} faces have more than three corners", "triangulate=true, or prepare", "")
        for note in mesh.notes:
            finding.problem(note, "export the mesh again with them on all faces")
        finding.facts["doubled vertices joined"] = mesh.num_joined
    else:
        garment = load_garment(name)
    if len(garment.faces) == 0 or not np.isfinite(garment.rest_pos).all():
        check_triangles(garment.rest_pos, garment.faces, name)
    finding.facts |= _garment_facts(garment)
    defects = find_defects(garment.rest_pos, garment.faces)
    _describe_defects(finding, defects)
    garment = _made(finding, start_fitting(garment, stitches), body, meant_by(entry, path, wanted or Wanted()))
    finding.repairs += words_of(wanted or Wanted())
    if _is_suspect(finding, garment, body):
        return finding
    if isinstance(body, MeshMotion):
        place_beside_mesh(finding, garment, body)
    elif garment.bound:
        _name_openings(finding, garment.worn_pos, garment.faces, body)
    else:
        _place_beside(finding, garment, body, np.zeros(10) if betas is None else betas)
    return finding


def _made(finding: Finding, fitting: Fitting, body: Body | MeshMotion, wanted: Wanted) -> Garment:
    """What a rollout makes of the file, told; the garment itself where it is one sheet."""
    garment = fitting.garment
    if garment.bound:
        return garment
    surface = body.points(0) if isinstance(body, MeshMotion) else body.v_template
    finding.facts |= describe_objects(garment, surface)
    take_objects(fitting, wanted, surface)
    mend(fitting, wanted, surface)
    for what, fix in problems_of(finding.file, fitting.changes):
        finding.problem(what, fix, "")
    finding.facts |= describe_made(fitting.garment)
    return fitting.garment


def _stiffer(garment: Garment) -> str | None:
    """Where the file has bindings or seams: how many vertices, and by which factors."""
    if garment.stiffness is None or (garment.stiffness == 1.0).all():
        return None
    other = garment.stiffness[garment.stiffness != 1.0]
    factors = f"{other.min():g}" if other.min() == other.max() else f"{other.min():g} to {other.max():g}"
    return f"{len(other)} vertices, {factors} times"


def _construction(garment: Garment) -> str | None:
    """How many triangles have elastic, folds and stiff seams; None where none has."""
    made = garment.construction
    counts = {
        "elastic": 0 if made.elastic is None else int((made.elastic != 1.0).any(axis=1).sum()),
        "folds": 0 if made.fold is None else int((~np.isnan(made.fold)).any(axis=1).sum()),
        "layers": 0 if made.bending is None else int((made.bending != 1.0).any(axis=1).sum()),
    }
    return ", ".join(f"{name} ({count} triangles)" for name, count in counts.items() if count) or None


def _garment_facts(garment: Garment) -> dict[str, Any]:
    return {
        "vertices": len(garment.rest_pos),
        "triangles": len(garment.faces),
        "size": np.round(np.ptp(garment.rest_pos, axis=0), 4).tolist(),
        "bound to": (garment.bound_to or "any body of its skeleton") if garment.bound else None,
        "held vertices": int(garment.pinned.sum()),
        "fasteners": ", ".join(f"{name} ({len(pairs)} pairs)" for name, pairs in (garment.fasteners or {}).items()) or None,
        "panels": ", ".join(f"{name} ({int(mask.sum())} faces)" for name, mask in (garment.panels or {}).items()) or None,
        "stiffer than the fabric": _stiffer(garment),
        "construction": _construction(garment),
        "texture coordinates": 0 if garment.uv is None else len(garment.uv),
        "hard edges": garment.normal_faces is not None,
        "vertex colours": garment.colours is not None,
        "coarse levels in the file": len(garment.coarse_edges or ()),
    }


def _is_suspect(finding: Finding, garment: Garment, body: Body | MeshMotion) -> bool:
    """Record what the garment seems to be, if that is not a garment; whether it is no use to look where it lies."""
    if garment.bound:
        return False
    surface = body.points(0) if isinstance(body, MeshMotion) else body.v_template
    found = suspect_kind(garment.rest_pos, garment.faces, surface)
    for suspicion in found:
        finding.problem(f"it {suspicion.what}", suspicion.fix)
    if any(suspicion.grave for suspicion in found):
        finding.repairs.clear()  # nothing that prepare could do
        return True
    return False


def _describe_defects(finding: Finding, defects: Defects) -> None:
    finding.facts |= {
        "components": defects.num_components,
        "openings": defects.openings,
        "edge length (least, median, greatest)": [float(f"{length:.4g}") for length in defects.edge_length],
        "edges with three or more faces": defects.non_manifold_edges,
        "slivers": defects.slivers,
    }
    for count, what, fix in (
        (defects.unwelded_vertices, "vertices lie on another one along open seams", "weld=auto joins them"),
        (defects.broken_faces, "faces have no area or repeat a vertex", "prepare removes them"),
        (defects.duplicate_faces, "faces are there twice", "prepare removes them"),
        (defects.isolated_vertices, "vertices belong to no face", "prepare removes them"),
        (defects.flipped_faces, "faces are wound against their neighbours", "prepare turns them over"),
    ):
        if count:
            finding.problem(f"{count} {what}", fix, "")
    if defects.slivers:
        finding.problem(f"{defects.slivers} faces are slivers, stiff and inaccurate", "remesh the garment where it was made")
    if defects.non_manifold_edges:
        first = ", ".join("–".join(map(str, edge)) for edge in defects.crowded_edges)
        finding.problem(
            f"{defects.non_manifold_edges} edges have three or more faces, such as those of the vertices {first}",
            "legal (a sewn-in layer); separate the layers there if they are none",
        )


def _place_beside(finding: Finding, garment: Garment, body: Body, betas: np.ndarray) -> None:
    """Units, up axis, facing, place and pose of an unbound garment: what ``hood prepare`` finds for itself."""
    found = find_place(garment, body, betas, AskedFit(), None)
    placement = found.placement if found.resized is None else found.resized.placement
    unsure = found.resized is None and found.refusal is not None
    ratio = size_ratio(used(garment.rest_pos, garment.faces), body.shaped(betas)[0])
    unit = {
        "size in body heights": float(f"{found.placement.scale * ratio:.3g}"),
        "units": LENGTH_UNITS.get(found.placement.scale, "unknown"),
    }
    place = {"up axis": placement.up, "turned by [degrees]": placement.turn, "arms below the T-pose [degrees]": placement.angle}
    finding.facts |= {
        **({f"closest place, not sure: {what}": value for what, value in unit.items()} if unsure else unit),
        "times its size it fits about alike": "its shape does not say"
        if found.sizes is None
        else np.round(found.sizes, 2).tolist(),
        **({f"closest place, not sure: {what}": value for what, value in place.items()} if unsure else place),
        "misfit on the body, 0 to 1": round(found.misfit, 3),
        "misfit of the next place, beyond": round(found.margin, 3),
    }
    if unsure:
        key = unit_alone(garment, body, betas)
        finding.refused = key is None
        finding.problem(f"no place on {body.name!r} is sure: {found.refusal}", f"prepare: {explain_unplaced(key)}", key)
        return
    describe_place(finding, found, body.name)
    posed = posed_body(body, arms_down(placement.angle), 0, betas)
    around = surrounds(placement.apply(used(garment.rest_pos, garment.faces)), posed.surface, posed.faces)
    finding.facts["distance to the skin, median [m]"] = round(around.middle, 4)
    finding.facts["vertices inside the body"] = f"{100 * around.inside:.1f}%"
    _name_openings(finding, placement.apply(garment.rest_pos), garment.faces, body)
    for suspicion in suspect_sides(placement.apply(garment.rest_pos), garment.faces, posed.surface, posed.faces):
        finding.problem(f"it {suspicion.what}", "prepare turns it", "")
    if around.inside:
        what = f"{100 * around.inside:.1f}% of its vertices are inside the body, to {1e3 * around.depth:.1f} mm"
        finding.problem(what, "prepare lets them start outside", "")


def inspect_body(name: str) -> Finding:
    """A parametric body model."""
    body = load_body(name)
    finding = Finding(name, "body model")
    defects = find_defects(body.v_template, body.faces)
    finding.facts = {
        "vertices": len(body.v_template),
        "triangles": len(body.faces),
        "joints": body.num_joints,
        "shape coefficients": body.shapedirs.shape[2],
        "height": round(float(np.ptp(body.v_template, axis=0).max()), 4),
        "openings": defects.openings,
    }
    return finding


def inspect_moving_mesh(name: str, options: MotionOptions) -> Finding:
    """A mesh that moves, or stands, as a body; what is repaired or wrong there is warned about by its reader."""
    motion = load_motion(name, NO_MOTION, options)
    assert isinstance(motion, MeshMotion)
    mesh, finding = motion.sequence, Finding(name, "moving mesh")
    defects = find_defects(mesh.verts[0].astype(np.float64), mesh.faces)
    finding.facts = {
        "vertices": mesh.verts.shape[1],
        "triangles": len(mesh.faces),
        f"frames at {mesh.fps:g} fps": mesh.num_frames,
        "frame rate of the file": "assumed" if mesh.fps_assumed else None,
        "size": np.round(np.ptp(mesh.verts[0], axis=0), 3).tolist(),
        "components": defects.num_components,
        "openings": defects.openings,
    }
    return finding


def inspect_checkpoint(name: str) -> Finding:
    """Weights of a model."""
    path = locate("weights", name)
    simulator = load_stepper(path, 30.0)
    finding = Finding(name, "checkpoint")
    finding.facts = {
        **({} if simulator.caution is None else {"caution": simulator.caution}),
        "parameters": sum(parameter.numel() for parameter in simulator.parameters()),
        "message-passing steps": len(simulator.schedule),
        **{
            key: simulator.config[key]
            for key in ("features", "output", "latent_dim", "layer_radius", "coarse_edge")
            if key in simulator.config
        },
        **ranges.describe_conditions(simulator.trained_for),
    }
    return finding


def inspect_rollout(name: str) -> Finding:
    """A simulated motion on disk."""
    data = read_rollout(Path(name))
    finding = Finding(name, "rollout")
    finding.facts = {
        "frames": len(data.cloth_pos),
        "complete": bool(data.attributes.get("complete", False)),
        "cloth vertices": data.cloth_pos.shape[1],
        "body vertices": data.body_pos.shape[1],
        **{
            key: str(data.attributes[key])
            for key in ("garment", "sequence", "checkpoint", "stepper", "store")
            if key in data.attributes
        },
    }
    if data.refined is not None:
        finding.facts["simulated cloth vertices"] = data.refined.num_coarse
    output = summarise_rate(data).get("output")
    if output is not None:
        finding.facts["simulated frames"] = f"{output['simulated_frames']} at {output['simulated_fps']:g} fps"
        finding.facts["stored at"] = f"{output['fps']:g} fps, {output['interpolated_frames']} frames interpolated"
    verdict = judge_rollout(data)
    finding.facts["sound"] = verdict.sound
    worst = worst_frame(data.step_metrics.get("strain_p99", np.zeros(0)))
    if worst is not None:
        finding.facts["worst strain p99"] = f"{worst[0]:.1%} in frame {worst[1]}"
    if not verdict.sound:
        state = "not judged" if verdict.sound is None else "unsound"
        finding.problem(f"{state}: {'; '.join(verdict.sentences)}", _SIMULATE_AGAIN)
    for doubt in verdict.doubts:
        what, _, fix = str(doubt["sentence"]).rpartition("; ")
        finding.problem(f"doubt: {what or fix}", fix if what else "")
    finding.facts |= {"not counted": list(verdict.notes)} if verdict.notes else {}
    guarded = summarise_guard(data).get("guard", {})
    if guarded.get("sentence"):
        finding.facts["guard"] = guarded["sentence"].removeprefix("guard: ")
    if not finding.facts["complete"] and guarded.get("stopped") is None:
        _tell_progress(finding, Path(name), len(data.cloth_pos), data.attributes.get("num_planned"))
    return finding


def _tell_progress(finding: Finding, path: Path, done: int, planned: Any) -> None:
    """How far an unfinished rollout is: a fact while its run goes on, else a problem."""
    frames = f"{done} frames" if planned is None else f"{done} of {int(planned)} frames"
    if is_occupied(path.parent):
        finding.facts["so far"] = f"{frames}, its run goes on"
    else:
        finding.problem(f"not finished: {frames}, and no run on this machine is writing it", "run hood rollout again")


def inspect_pickle(name: str, kind: str) -> Finding:
    """A rollout of the published code: what of it there is, and how it becomes a rollout of this one."""
    data, _ = read_published(Path(name))
    sizes = {"frames": len(data.time), "cloth vertices": data.cloth_pos.shape[1], "body vertices": data.body_pos.shape[1]}
    return Finding(name, kind, {**sizes, "metrics": sorted(data.metrics), "to use it": f"hood convert rollout={name}"})


def inspect_list(name: str) -> Finding:
    """A list of vertices to hold."""
    vertices = read_indices(Path(name))
    return Finding(name, "vertex list", {"vertices": len(vertices), "greatest": int(vertices.max(initial=-1))})


def _name_openings(finding: Finding, pos: np.ndarray, faces: np.ndarray, body: Body) -> None:
    """For each opening, longest first: its vertices, and the region (a word for pins) that it is."""
    loops = boundary_loops(faces)
    if not 0 < len(loops) <= _MOST_OPENINGS:
        return
    names = opening_names(np.stack([pos[loop].mean(axis=0) for loop in loops]), body.shaped(np.zeros(0))[1])
    if names:
        finding.facts["openings"] = [f"{len(loop)} vertices near {name}" for loop, name in zip(loops, names, strict=True)]

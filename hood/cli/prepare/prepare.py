"""``hood prepare``: a garment as it was found in, a repaired one bound to a body out; every repair is reported."""

from __future__ import annotations

import json
import shlex
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from hood.app.common import prepare_folder
from hood.app.scene.garment_files import meant_by, said, wanted_of
from hood.app.scene.garments import checked_pins, heed, names_of, shape_coefficients
from hood.app.scene.motion import check_rate
from hood.app.scene.placing import (
    AUTO,
    arm_angle,
    asked_keys,
    explain_size,
    explain_unplaced,
    find_place,
    keep_place,
    unit_alone,
)
from hood.app.settings.compose import ConfigError, load_config, plain, require_choice, shown
from hood.app.settings.overrides import plain_word
from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.assets.contents.sort_out import take_objects, weld_and_mend
from hood.assets.files.library import locate
from hood.assets.fitting import alterations
from hood.assets.fitting.placement import LENGTH_UNITS
from hood.assets.fitting.suspicions import suspect_kind
from hood.assets.formats.mesh_file import mesh_suffixes, read_mesh_file
from hood.assets.garment.binding import PosedBody, bind_garment, posed_body
from hood.assets.garment.garment import Garment, garment_of_mesh, load_garment, locate_garment, save_garment
from hood.assets.garment.outfit import join_garments
from hood.assets.garment.pins import pin_mask, pin_numbers
from hood.assets.garment.record import Fitting, start_fitting
from hood.assets.motion.animated_mesh import body_kind
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.sequence_edit import arms_down, holds_pose, read_pose
from hood.assets.motion.skeleton import UP_AXES
from hood.cli.prepare.mesh_body import fasten_as_asked, give_room, prepare_for_mesh
from hood.media.exports.sequences import write_obj
from hood.mesh.editing.quality import check_triangles
from hood.scene.scene import build_scene
from hood.scene.worn import STRETCHED, FitFigures, Worn, fit_figures, put_on

#: A start beyond these is warned about: edges stretched by this share, vertices this deep [m].
_STRETCH_LIMIT, _DEPTH_LIMIT = 0.10, 2e-3
#: A rest length counts as changed beyond this; a file may have at most this share of its edges changed.
_CHANGED, _MOST_CHANGED = 0.01, 0.01
#: Share of the edges that may be stretched where the garment is worn. Measured: 0 for garments shrunk by up to 10%, 1% to 19%
#: for those shrunk by a fifth or shifted by 10 cm.
_MOST_STRETCHED = 0.005


@dataclass(frozen=True)
class _Fitted:
    """One garment of the command, ready to be written, and what it took."""

    fitting: Fitting
    worn: Worn | None  # None: it came bound, and is worn as it was
    length_change: float  # greatest relative change of a rest length against the file
    changed_share: float  # of the edges, by more than ``_CHANGED``


def run(overrides: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    config = load_config("prepare", overrides)
    require_choice(config, "format", ("text", "json"))
    require_choice(config, "body_up", ("auto", *UP_AXES))
    check_rate(config)
    if int(config.frame) < 0:
        raise ConfigError(f"frame={config.frame}: must be at least 0, frames count from 0")
    if config.body_scale is not None and not (isinstance(config.body_scale, (int, float)) and config.body_scale > 0):
        raise ConfigError(f"body_scale={shown(config.body_scale)}: give metres per unit of the file, such as body_scale=0.01")
    if config.garment is None:
        raise ConfigError("garment is not given: hood prepare garment=shirt.obj output=shirt.npz")
    names = names_of(config.garment)
    target = _target(config, names)
    if body_kind(str(config.body)) == "mesh":
        if config.mesh is not None:
            raise ConfigError("mesh=…: is written for bodies of the SMPL family only")
        return prepare_for_mesh(config, names, target, _read)
    if config.mesh is not None:
        _mesh_target(config)
    body, betas = load_body(str(config.body)), shape_coefficients(config.betas)
    fitted = [_fit(name, config, body, betas) for name in names]
    outfit = join_garments([bind_garment(one.fitting.garment, body) for one in fitted])
    outfit = _pin(outfit, [one.fitting for one in fitted], config, body)
    starts = _starts(outfit, config, body, betas)
    prepare_folder(target.parent)
    save_garment(target, outfit)
    if config.mesh is not None:
        write_obj(_mesh_target(config), outfit)
    report = _report(names, fitted, outfit, starts, target)
    print(json.dumps(report, indent=1) if str(config.format) == "json" else _text(report, str(config.body)))
    return 0


def _target(config: DictConfig, names: list[str]) -> Path:
    if config.output is None:
        stem = "+".join(Path(name.rpartition(":")[2] if ".pkl:" in name else name).stem for name in names)
        return Path(f"{stem}_prepared.npz")
    target = Path(str(config.output)).expanduser()
    if target.suffix != ".npz":
        raise ConfigError(f"output={target}: prepared garments are .npz files")
    return target


def _mesh_target(config: DictConfig) -> Path:
    target = Path(str(config.mesh)).expanduser()
    if target.suffix != ".obj":
        raise ConfigError(f"mesh={target}: meshes are written as .obj")
    prepare_folder(target.parent)
    return target


def _fit(name: str, config: DictConfig, body: Body, betas: np.ndarray) -> _Fitted:
    """One garment, read, repaired, put on and bound."""
    path, entry = locate_garment(name)
    fitting, wanted = _read(name), meant_by(entry, path, wanted_of(config))
    take_objects(fitting, wanted, body.v_template)
    if not fitting.garment.bound:
        heed(fitting.garment.name, suspect_kind(fitting.garment.rest_pos, fitting.garment.faces, body.v_template))
    posed = _place(fitting, config, body, betas)
    sides = fasten_as_asked(fitting, config)
    weld_and_mend(fitting, wanted, sides)
    alterations.clean(fitting)
    check_triangles(fitting.garment.rest_pos, fitting.garment.faces, name)
    alterations.face_out(fitting, body.v_template if posed is None else posed.surface, body.faces)
    clearance = _number(config, "clearance", "")
    assert clearance is not None
    worn = None
    if posed is not None:
        worn = _wear(fitting, posed, clearance, bool(config.allow_misfit))
    ratios = alterations.length_ratios(fitting, betas)
    change = np.abs(ratios - 1)
    fitted = _Fitted(fitting, worn, float(change.max(initial=0.0)), float((change > _CHANGED).mean()) if len(change) else 0.0)
    pulled = any(change.what == "panels" for change in fitting.changes)
    if fitted.changed_share > _MOST_CHANGED and not pulled:
        raise ValueError(
            f"{name}: welding changes {100 * fitted.changed_share:.1f}% of the rest lengths by more than "
            f"{100 * _CHANGED:.0f}%, the most by {100 * fitted.length_change:.0f}%; give a smaller weld, "
            "metres between vertices that are one"
        )
    give_room(fitting, sides)
    return fitted


def _wear(fitting: Fitting, posed: PosedBody, clearance: float, allow_misfit: bool) -> Worn:
    """Bind the garment to the posed body where it is worn: outside the skin, settled towards the lengths of its file.

    Raises:
        ValueError: there it is stretched more than cloth is, and ``allow_misfit`` is not given.
    """
    pos = alterations.leave_body(fitting, posed, clearance)
    worn = put_on(fitting.garment, pos, posed, clearance)
    if worn.stretched_share > _MOST_STRETCHED and not allow_misfit:
        raise ValueError(
            f"{fitting.garment.name}: too small for the body, or not placed on it: outside of it "
            f"{100 * worn.stretched_share:.1f}% of the edges are stretched by more than {100 * STRETCHED:.0f}%, one by "
            f"{100 * worn.stretch_max:.0f}%; at most {100 * _MOST_STRETCHED:g}% may be; check body and betas (its size), "
            "scale, offset, up and pose, or write it all the same with allow_misfit=true"
        )
    inside = any(change.what == "pushed_out" for change in fitting.changes)
    alterations.bind(fitting, posed, worn.pos if inside else pos)
    return worn


def _read(name: str) -> Fitting:
    path, _ = locate_garment(name)
    if path.suffix.lower() not in mesh_suffixes():
        return start_fitting(load_garment(name))
    mesh = read_mesh_file(path, split_polygons=True)
    garment = garment_of_mesh(path, mesh)
    bad = ~np.isfinite(garment.rest_pos).all(axis=1)
    if bad.any() or len(garment.faces) == 0:
        check_triangles(garment.rest_pos, garment.faces, str(path))
    fitting = start_fitting(garment, mesh.stitches)
    fitting.note("split_polygons", mesh.num_polygons, f"split {mesh.num_polygons} polygons into triangles")
    fitting.note("joined", mesh.num_joined, f"joined {mesh.num_joined} vertices that {path.suffix[1:].upper()} files double")
    for note in mesh.notes:
        fitting.note("not_kept", 1, note)
    return fitting


def _place(fitting: Fitting, config: DictConfig, body: Body, betas: np.ndarray) -> PosedBody | None:
    """Bring the garment to the body; the body in the pose that the garment was made in, None for one that is bound already.

    Raises:
        ValueError: the garment fits nowhere, or in several places alike.
    """
    garment, asked = fitting.garment, asked_keys(config)
    if garment.bound:
        alterations.place(fitting, keep_place(garment, body.shaped(betas)[0], asked))
        return None
    posed = _given_pose(config, body, betas)
    found = find_place(garment, body, betas, asked, posed)
    if found.refusal is not None:
        if found.resized is not None:
            fix = "it {}: {}".format(*explain_size(found.resized))
        else:
            nothing_asked = all(value is None for value in vars(asked).values())
            fix = explain_unplaced(unit_alone(garment, body, betas) if nothing_asked and posed is None else None)
        raise ValueError(f"{garment.name}: {found.refusal}; {fix}")
    if found.resized is not None:
        what, fix = explain_size(found.resized)
        warnings.warn(f"garment {garment.name!r} {what}; written as it is: {fix}", stacklevel=2)
    alterations.place(fitting, found.placement)
    angle = found.placement.angle
    if posed is None and angle:
        text = f"made around a pose with the arms {angle:g} degrees below the T-pose's"
        fitting.note("pose", len(garment.rest_pos), text, angle=angle)
    return posed or posed_body(body, arms_down(angle), 0, betas)


def _given_pose(config: DictConfig, body: Body, betas: np.ndarray) -> PosedBody | None:
    """The body in the pose that the config names; None for auto."""
    if str(config.pose) == AUTO:
        return None
    angle = arm_angle(config.pose)
    pose = _named_pose(str(config.pose), config) if angle is None else (arms_down(angle), 0)
    return posed_body(body, *pose, betas)


def _named_pose(given: str, config: DictConfig) -> tuple[PoseSequence, int]:
    path, frame = locate("motions", given), int(config.frame)
    if holds_pose(path):
        return read_pose(path), 0
    person = None if config.person is None else str(config.person)
    sequence = load_sequence(given, fps=float(config.fps), person=person)
    if not 0 <= frame < sequence.num_frames:
        raise ConfigError(f"frame={frame}: {given} has {sequence.num_frames} frames at {float(config.fps):g} fps")
    return sequence, frame


def _pin(outfit: Garment, fittings: list[Fitting], config: DictConfig, body: Body) -> Garment:
    """The outfit with the pins asked for; numbers are those of the files, before vertices were joined or removed."""
    if config.pins is None:
        return outfit
    numbers, words = pin_numbers(checked_pins(plain(config.pins)))
    mask = pin_mask(words, outfit, body)
    starts = np.cumsum([0, *(len(fitting.garment.rest_pos) for fitting in fittings)])
    tables = [np.where(f.vertex_map < 0, -1, f.vertex_map + start) for f, start in zip(fittings, starts, strict=False)]
    present = np.concatenate(tables)
    outside = (numbers < 0) | (numbers >= len(present))
    if outside.any():
        raise ConfigError(f"pins: vertex {int(numbers[np.argmax(outside)])} of {len(present)}; they are numbered from 0")
    mask[present[numbers][present[numbers] >= 0]] = True
    return replace(outfit, pinned=mask)


def _starts(outfit: Garment, config: DictConfig, body: Body, betas: np.ndarray) -> dict[str, FitFigures]:
    """Figures of a rollout's start from the T-pose and, if it is another, from the pose of the garment."""
    poses: dict[str, tuple[PoseSequence, int]] = {"tpose": (arms_down(0.0), 0)}
    if str(config.pose) != AUTO and arm_angle(config.pose) is None:
        poses[str(config.pose)] = _named_pose(str(config.pose), config)
    return {
        name: fit_figures(build_scene(outfit, body, sequence.window(frame, frame + 1), betas=betas))
        for name, (sequence, frame) in poses.items()
    }


def _report(
    names: list[str], fitted: list[_Fitted], outfit: Garment, starts: dict[str, FitFigures], target: Path
) -> dict[str, Any]:
    return {
        "garments": [
            {
                "file": name,
                "result": alterations.summary(one.fitting.garment),
                "changes": [asdict(change) for change in one.fitting.changes],
                "rest_lengths": {"change_max": one.length_change, "changed_share": one.changed_share},
                "worn": None if one.worn is None else {key: value for key, value in vars(one.worn).items() if key != "pos"},
            }
            for name, one in zip(names, fitted, strict=True)
        ],
        "num_vertices": len(outfit.rest_pos),
        "num_faces": len(outfit.faces),
        "num_pinned": int(outfit.pinned.sum()),
        "fasteners": {name: len(pairs) for name, pairs in (outfit.fasteners or {}).items()},
        "panels": {name: int(mask.sum()) for name, mask in (outfit.panels or {}).items()},
        "starts": {name: asdict(figures) for name, figures in starts.items()},
        "output": str(target),
    }


def _text(report: dict[str, Any], body: str) -> str:
    lines = []
    for part in report["garments"]:
        lines.append(f"{part['file']}:")
        lines += [f"  {said(change, part['file'])}" for change in part["changes"]] or ["  nothing to repair"]
        lines += _length_lines(part)
        lines.append(f"  now {part['result']}")
    if report["num_pinned"]:
        lines.append(f"holds {report['num_pinned']} of {report['num_vertices']} vertices")
    lines += [f"fastens {name}: {count} pairs of vertices" for name, count in report["fasteners"].items()]
    if report["panels"]:
        lines.append("panels: " + ", ".join(f"{name} ({count} faces)" for name, count in report["panels"].items()))
    for name, start in report["starts"].items():
        lines.append(
            f"start in {name}: edges stretched by at most {100 * start['stretch_max']:.1f}%, "
            f"deepest vertex {1e3 * start['depth_max']:.1f} mm"
        )
        if start["stretch_max"] > _STRETCH_LIMIT or start["depth_max"] > _DEPTH_LIMIT:
            lines.append("  that is far from rest: check that pose, scale and body are those the garment was made for")
    words = [plain_word("garment", report["output"]), *([plain_word("body", body)] if body != "default" else [])]
    run = shlex.join(["hood", "rollout", *words])
    lines.append(f"written to {report['output']}; run it with: {run}")
    return "\n".join(lines)


def _length_lines(part: dict[str, Any]) -> list[str]:
    """What became of a garment's edges: at rest, and where it is worn."""
    rest, worn = part["rest_lengths"], part["worn"]
    factors = [change["details"]["factor"] for change in part["changes"] if change["what"] == "scaled"]
    resized = "".join(f"{factor:g} times " for factor in factors if factor not in LENGTH_UNITS)
    lines = [
        f"  rest lengths: {resized}the file's to {100 * rest['change_max']:.2f}%; {100 * rest['changed_share']:.1f}% of the "
        f"edges changed by more than {100 * _CHANGED:.0f}%"
    ]
    if worn is not None:
        lines.append(
            f"  worn outside of the body: edges stretched by at most {100 * worn['stretch_max']:.1f}%, compressed by at most "
            f"{100 * worn['compression_max']:.1f}%; {100 * worn['stretched_share']:.1f}% stretched by more than "
            f"{100 * STRETCHED:.0f}%"
        )
        if worn["stretched_share"] > _MOST_STRETCHED:
            lines.append("  it does not fit: too small for the body, or not placed on it; written as allow_misfit=true asks")
    return lines


def _number(config: DictConfig, key: str, word: str) -> float | None:
    """A number of the config; None for ``word``."""
    if str(config[key]) == word:
        return None
    try:
        value = float(config[key])
    except (TypeError, ValueError):
        value = -1.0
    if not (np.isfinite(value) and value >= 0):
        raise ConfigError(f"{key}={config[key]}: give a number ≥ 0" + (f" or {word}" if word else ""))
    return value

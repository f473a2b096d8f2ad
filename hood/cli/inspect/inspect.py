"""``hood inspect FILE …``: what files are, what is wrong with them, how to repair it, and whether they fit together.

What ``hood inspect`` says of a motion: its layout, people, frame rate, unit and up axis, and which of these are assumed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from hood.app.notices import heard
from hood.app.scene.garment_files import wanted_of
from hood.app.scene.garments import read_outfit, shape_coefficients
from hood.app.scene.motion import check_motion_options, motion_options
from hood.app.settings.compose import ConfigError, load_config, plain, require_choice
from hood.app.settings.overrides import plain_word
from hood.assets import identify as kinds
from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.assets.files.library import locate
from hood.assets.files.said import Doubt
from hood.assets.motion.animated_mesh import NO_BODY, body_kind
from hood.assets.motion.layouts.people import SeveralPeopleError
from hood.assets.motion.load import find_bearing, find_up
from hood.assets.motion.recording import Recording, read_recording
from hood.assets.motion.skeleton import UP_AXES, require_up
from hood.cli.inspect import findings
from hood.cli.inspect.findings import Finding
from hood.scene.body_motion.load import NO_MOTION, MotionOptions, load_motion
from hood.scene.body_motion.mesh_motion import MeshMotion
from hood.scene.scene import LEAD_IN, NotWornError, Scene, dressed_scene
from hood.scene.worn import fit_figures, misplacement

#: A root that moves faster [m/s] than this in one of a hundred frames is no person's.
_FASTEST = 20.0


def inspect_motion(name: str, options: MotionOptions) -> Finding:
    """A motion of joint rotations, read as a rollout with the same keys reads it."""
    path = locate("motions", name)
    require_up(options.up)
    finding = Finding(name, "motion")
    try:
        recording = read_recording(path, options.file_fps, options.person, options.trans_unit)
    except SeveralPeopleError as error:
        finding.facts = _of_people(error)
        _add(finding, path, error)
        return finding
    axis, notice = find_up(path, recording) if options.up == "auto" else (options.up, None)
    finding.facts = _facts(recording, axis, options)
    for note in (*recording.notes, *([] if notice is None else [notice])):
        _add(finding, path, note)
    doubted = any(isinstance(note, Doubt) and note.kind == "units" for note in recording.notes)
    if not doubted and float(np.quantile(_root_speed(recording), 0.99)) > _FASTEST:
        fix = "its unit or frame rate may be wrong: unit=cm or file_fps=…"
        finding.problem(f"the root moves faster than {_FASTEST:g} m/s", fix)
    return finding


def _of_people(error: SeveralPeopleError) -> dict[str, Any]:
    """What can be said of a file before one of its people is chosen."""
    return {
        "layout": error.people[0].layout.name,
        "people": [person.name for person in error.people],
    }


def _facts(recording: Recording, axis: str, options: MotionOptions) -> dict[str, Any]:
    bearing, speed = find_bearing(recording), _root_speed(recording)
    count = len(recording.poses)
    rate = f"{recording.fps:g}, assumed" if recording.fps_assumed else recording.fps
    unit = recording.unit + ("" if recording.unit_sure else ", assumed")
    unit += "" if options.trans_unit == "auto" else ", as given"
    otherwise = "is head down" if bearing.axis.lstrip("-") == recording.up.lstrip("-") else "lies"
    tested = bearing.axis if bearing.sure else f"not sure: {bearing.axis} if it stands, {recording.up} if it {otherwise}"
    return {
        "frames": count,
        "frames per second": rate,
        "seconds": round((count - 1) / recording.fps, 3),
        "single pose": count == 1,
        "layout": recording.layout,
        "body model": recording.family,
        "people": len(recording.people),
        "person": recording.person if len(recording.people) > 1 else None,
        "rotations": recording.rotations or "axis-angle vectors",
        "gender": recording.gender,
        "shape coefficients": len(recording.betas),
        "unit of the translation": unit,
        "seen from a camera": recording.camera,
        "up axis by its layout": recording.up,
        "up axis by its poses": tested,
        "up axis taken": axis if options.up == "auto" else f"{axis}, as given",
        "greatest root speed [m/s]": round(float(speed.max()), 2),
        "fingers": recording.fingers is not None,
    }


def _root_speed(recording: Recording) -> np.ndarray:
    """(N − 1,) m/s of the root; one 0 of a single pose."""
    change = np.linalg.norm(np.diff(recording.transl, axis=0), axis=1)
    return change * recording.fps if len(change) else np.zeros(1)


def _add(finding: Finding, path: Path, said: Exception) -> None:
    """Record a sentence ``file: what is so; the way out`` as a problem."""
    what, _, fix = str(said).removeprefix(f"{path}: ").removeprefix(f"{finding.file}: ").partition("; ")
    finding.problem(what, fix)


_UNREADABLE = "unreadable"
_BODIES = (kinds.BODY, kinds.MOVING_MESH)
#: Entries of a list that are printed; JSON has all.
_MOST_SHOWN = 10
#: A start beyond these does not fit: edges stretched by this share, vertices this deep [m].
_STRETCH_LIMIT, _DEPTH_LIMIT = 0.10, 2e-3


def run(arguments: Sequence[str]) -> int:
    """Run the command; returns the exit code: 0 where nothing needs repair, 1 where something does."""
    files, config = _split(arguments)
    require_choice(config, "format", ("text", "json"))
    require_choice(config, "up", ("auto", *UP_AXES))
    check_motion_options(config)
    known = [_identify(name, str(config.body)) for name in files]
    beside = next((finding.file for finding in known if finding.kind in _BODIES), str(config.body))
    if body_kind(beside) == "mesh" and beside not in files:  # what is wrong with it is told as well
        known.append(Finding(beside, kinds.MOVING_MESH))
    found = [_inspect(finding, beside, config) for finding in known]
    fit = _fit(found, beside, config)
    report = {"files": [_as_dict(finding) for finding in found], "fit": fit}
    print(json.dumps(report, indent=1) if str(config.format) == "json" else _text(found, fit))
    sound = all(not finding.problems for finding in found) and (fit is None or fit["fits"])
    return 0 if sound else 1


def _split(arguments: Sequence[str]) -> tuple[list[str], DictConfig]:
    """Files and the config: a word ``key=value`` is an override unless there is such a file, every other word a file."""
    words = ["format=json" if word == "--json" else word for word in arguments]
    overrides = [word for word in words if re.match(r"[a-z_.]+=", word) and not Path(word).exists()]
    files = [_of_folder(word) for word in words if word not in overrides]
    config = load_config("inspect", overrides)
    if any(word.startswith("-") for word in files):
        raise ConfigError(
            f"unknown option {next(w for w in files if w.startswith('-'))!r}; known are --json, {', '.join(map(str, config))}"
        )
    if not files:
        raise ConfigError("no file is given: hood inspect shirt.obj walk.npz")
    return files, config


def _of_folder(word: str) -> str:
    """The file of a rollout's folder, which the commands that take rollouts take as well; else the word."""
    file = Path(word).expanduser() / "rollout.h5"
    return str(file) if file.is_file() else word


def _identify(name: str, body: str) -> Finding:
    """What a file is; a mesh that is also given as ``body`` is one. A file that cannot be told has that for its problem."""
    try:
        kind = kinds.identify(name)
        return Finding(name, kinds.MOVING_MESH if name == body and body_kind(body) == "mesh" else kind)
    except (ValueError, OSError) as error:
        return findings.unreadable(name, _UNREADABLE, error)


def _inspect(known: Finding, beside: str, config: DictConfig) -> Finding:
    """Facts and problems of a file; one that cannot be read has that for its problem."""
    if known.kind == _UNREADABLE:
        return known
    try:
        with heard(aloud=False) as said:
            finding = _read(known.file, known.kind, beside, config)
    except (ValueError, OSError) as error:
        return findings.unreadable(known.file, known.kind, error)
    for sentence in said:
        what, separator, fix = sentence.rpartition("; ")
        finding.problem(what if separator else sentence, fix if separator else "")
    return finding


def _read(name: str, kind: str, beside: str, config: DictConfig) -> Finding:
    if kind == kinds.GARMENT:
        betas = None if config.betas is None else shape_coefficients(config.betas)
        return findings.inspect_garment(name, _body(beside, config), _wearer(beside, config), betas, wanted_of(config))
    if kind == kinds.MOVING_MESH:
        return findings.inspect_moving_mesh(name, _options(config))
    if kind == kinds.MOTION:
        return inspect_motion(name, _options(config))
    if kind == kinds.REFERENCE_ROLLOUT:
        return findings.inspect_pickle(name, kind)
    readers = {
        kinds.BODY: findings.inspect_body,
        kinds.CHECKPOINT: findings.inspect_checkpoint,
        kinds.ROLLOUT: findings.inspect_rollout,
        kinds.VERTEX_LIST: findings.inspect_list,
    }
    return readers[kind](name)


def _options(config: DictConfig) -> MotionOptions:
    """How the first frames of a motion are performed; the keys are those of ``hood rollout``."""
    return motion_options(OmegaConf.create({**plain(config), "stop": None, "loop": 1, "num_frames": 2}))


def _body(name: str, config: DictConfig) -> Body | MeshMotion:
    """What a garment is measured against: a model, or a mesh in its first frame."""
    if body_kind(name) != "mesh":
        return load_body("default" if body_kind(name) == NO_BODY else name)
    motion = load_motion(name, NO_MOTION, _options(config))
    assert isinstance(motion, MeshMotion)
    return motion


def _wearer(body: str, config: DictConfig) -> list[str]:
    """The words of ``hood prepare`` for the body that a garment is looked at beside; none for the default."""
    if body_kind(body) == "model":
        betas = [] if config.betas is None else [f"betas={plain(config.betas)}".replace(" ", "")]
        return [plain_word("body", body)] * (body != "default") + betas
    if body_kind(body) == NO_BODY:
        return []
    metres = _options(config).scale
    scale = [] if metres is None else [f"body_scale={metres:g}"]
    return [plain_word("body", body), *scale, *([f"body_up={config.up}"] if str(config.up) != "auto" else [])]


def _fit(found: list[Finding], body: str, config: DictConfig) -> dict[str, Any] | None:
    """How the garments among the files sit on the body in the motion's first frame; None without garment, or without one of
    motion and body."""
    garments = [finding.file for finding in found if finding.kind.startswith("garment")]
    motions = [finding.file for finding in found if finding.kind == kinds.MOTION]
    if not garments or not (motions or any(finding.kind in _BODIES for finding in found) or body_kind(body) == "mesh"):
        return None
    motion = NO_MOTION if body_kind(body) == "mesh" else (motions or ["stand_sway"])[0]
    names = {"garments": garments, "body": body, "motion": motion}
    try:
        with heard(aloud=False):  # what single files are warned about stands with them
            performed = load_motion(body, motion, _options(config))
            scene = dressed_scene(read_outfit(garments, performed, triangulate=True, wanted=wanted_of(config)), performed)
        misplaced = misplacement(scene, on_meshes=True)
        skinned, start = fit_figures(scene, settled=False), fit_figures(scene)
    except (ValueError, OSError) as error:
        return {**names, "fits": False, "reason": " ".join(str(error).split())}
    if misplaced is not None:
        return {**names, "fits": False, "starts": not misplaced.grave, "reason": f"the garment {misplaced.what}"}
    surface = performed.surface(0, performed.translation[0])
    height = float(surface[:, 1].max() - surface[:, 1].min()) if len(surface) else 0.0
    fits = start.stretch_max <= _STRETCH_LIMIT and start.depth_max <= _DEPTH_LIMIT
    led_in = not fits and _is_led_in(scene)
    figures = {"body_height": height, "skinned": asdict(skinned), "start": asdict(start)}
    return {**names, "fits": fits or led_in, "led_in": led_in, **figures}


def _is_led_in(scene: Scene) -> bool:
    """Whether a rollout cannot put the garment on in this pose, and lets the body move into it from the T-pose instead."""
    try:
        scene.start(0, relaxed=False, thorough=True)
    except NotWornError:
        try:
            return scene.lead_in(0) is not None
        except NotWornError:
            pass
    return False


def _as_dict(finding: Finding) -> dict[str, Any]:
    return {
        "file": finding.file,
        "kind": finding.kind,
        "facts": finding.facts,
        "problems": [{"problem": what, "fix": fix} for what, fix in finding.problems],
        "command": finding.command,
    }


def _text(found: list[Finding], fit: dict[str, Any] | None) -> str:
    lines = []
    for finding in found:
        lines.append(f"{finding.file}: {finding.kind}")
        lines += [f"  {name}: {_show(value)}" for name, value in finding.facts.items() if value not in (None, False)]
        lines += [f"  ! {what}" + (f"; {fix}" if fix else "") for what, fix in finding.problems] or ["  nothing to repair"]
        if finding.command:
            lines.append(f"  repair: {finding.command}")
    return "\n".join([*lines, *(_fit_lines(fit) if fit else [])])


def _fit_lines(fit: dict[str, Any]) -> list[str]:
    frame = "its first frame" if fit["motion"] == NO_MOTION else f"the first frame of {fit['motion']}"
    head = f"{' + '.join(fit['garments'])} on {fit['body']} in {frame}:"
    if "reason" in fit:
        return [head, f"  ! {'they do not fit' if fit.get('starts') else 'does not start'}: {fit['reason']}"]
    skinned, start = fit["skinned"], fit["start"]
    return [
        head,
        f"  body height {fit['body_height']:.2f} m, distance to the skin {1e3 * start['dist_median']:.0f} mm (median)",
        f"  skinned: {skinned['num_inside']} vertices inside to {1e3 * skinned['depth_max']:.1f} mm, "
        f"edges stretched by at most {100 * skinned['stretch_max']:.1f}%",
        f"  settled: {start['num_inside']} vertices inside to {1e3 * start['depth_max']:.1f} mm, "
        f"edges stretched by at most {100 * start['stretch_max']:.1f}%",
        f"  they fit: put on in the T-pose, from where a rollout moves the body into this pose in {LEAD_IN:g} s that it drops"
        if fit["led_in"]
        else "  they fit"
        if fit["fits"]
        else "  ! they do not fit: prepare the garment with the pose, scale and body it was made for",
    ]


def _show(value: Any) -> str:
    if not isinstance(value, (list, tuple)):
        return str(value)
    rest = [f"… and {len(value) - _MOST_SHOWN} more"] if len(value) > _MOST_SHOWN else []
    return ", ".join([*map(_show, value[:_MOST_SHOWN]), *rest]) or "none"

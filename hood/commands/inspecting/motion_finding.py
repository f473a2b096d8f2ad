"""What ``hood inspect`` says of a motion: its layout, people, frame rate, unit and up axis, and which of these are assumed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.doubt import Doubt
from hood.assets.files.library import locate
from hood.assets.motion.axes import require_up
from hood.assets.motion.layouts.people import SeveralPeopleError
from hood.assets.motion.recording import Recording, read_recording
from hood.assets.motion.up_axis import find_bearing, find_up
from hood.commands.findings import Finding
from hood.scene.load_motion import MotionOptions

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
        fix = "its unit or frame rate may be wrong: trans_unit=cm or file_fps=…"
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

"""Motion files as recorded: whatever layout they have, joint rotations, a translation in metres, and what is known of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.frame_rates import flat
from hood.assets.motion.layouts.content import MOTION_SUFFIXES, motion_suffixes, read_content
from hood.assets.motion.layouts.frame_rate import frame_rate
from hood.assets.motion.layouts.people import Person, choose
from hood.assets.motion.layouts.read import NUM_FINGER_JOINTS, Track, people_in, read_track
from hood.assets.motion.layouts.shape import subject_shape
from hood.assets.motion.skeleton import joints_about_pelvis, spread, upright
from hood.assets.motion.units import find_unit

__all__ = ["MOTION_SUFFIXES", "NUM_BODY_JOINTS", "NUM_FINGER_JOINTS", "Recording", "motion_suffixes", "read_recording"]

#: Body joints that drive a garment: pelvis to wrists. Columns 66:72 of SMPL+H poses are fingers, not SMPL's hands.
NUM_BODY_JOINTS = 22
SMPL_JOINTS = 24
#: No rotation [rad] or place [m] is farther from zero.
_LARGEST = 1e6
#: Joint rotations beyond a full turn [rad] are rare (an unwound root), and in degrees most of them are.
_FULL_TURN, _MOST_BEYOND = 2 * np.pi, 0.2
#: Models by the number of joints of their poses; poses without hands are of any.
_FAMILIES = {24: "smpl", 52: "smplh", 55: "smplx"}


@dataclass(frozen=True)
class Recording:
    """A motion in the world, at the frame rate and with the joints of its file."""

    poses: np.ndarray  # (N, 24, 3) axis-angle [rad], float64; joints 22 and 23 only of SMPL files
    fingers: np.ndarray | None  # (N, 30, 3) axis-angle [rad], of SMPL-H and SMPL-X files
    transl: np.ndarray  # (N, 3) m, float64
    fps: float
    betas: np.ndarray  # (S,) of the recorded subject, zeros where the file has none
    gender: str | None  # "neutral", "male", "female"
    family: str | None  # model that recorded it: "smpl", "smplh", "smplx"; None: the file does not tell
    up: str  # "y", "z" or "-y": the custom of the layout
    layout: str = "AMASS"  # name of the layout
    camera: bool = False  # seen from a camera, which need not be level
    people: tuple[str, ...] = ("0",)  # everyone in the file
    person: str = "0"  # who of them this is
    unit: str = "m"  # of the translation in the file
    unit_sure: bool = True  # tested by the body, or given
    fps_assumed: bool = False  # the file does not say a frame rate
    rotations: str | None = None  # how joint rotations were read that are no axis-angle vectors
    notes: tuple[UserWarning, ...] = ()  # what whoever uses it is to be told, doubts among them

    @cached_property
    def uprights(self) -> np.ndarray:
        """(M, 3): unit vectors from the feet to the head in the file's world, in M frames spread over the motion."""
        return upright(joints_about_pelvis(self.poses[spread(len(self.poses))]))


def read_recording(
    path: Path, file_fps: float | None = None, person: int | str | None = None, trans_unit: str = "auto"
) -> Recording:
    """A motion file of any published layout, told by its keys and shapes (``docs/files.md`` lists them), or of a format that a
    plugin reads. Pickles and arrays of objects are read by the restricted unpickler: nothing in them is run.

    Args:
        file_fps: frame rate [1/s] of the file, whatever it says itself.
        person: who of several people, by name or place.
        trans_unit: unit of the translation, "m", "cm" or "mm"; "auto": found from the body's steps and height.

    Raises:
        SeveralPeopleError: several people, and nobody is chosen.
        ValueError: no motion, wrong shapes, not finite, no frame rate; names file, key and fix.
    """
    people = people_in(path, read_content(path))
    chosen = choose(path, people, person)
    track = read_track(path, chosen)
    _check(path, chosen, track)
    own = {chosen.keys.get(key, key): value for key, value in chosen.fields.items()}
    rate = frame_rate(path, (own, *chosen.around), chosen.layout, file_fps, is_still=len(track.turns) == 1)
    betas, shape_doubt = subject_shape(path, chosen.fields, chosen.keys)
    poses = _body_poses(track.turns)
    unit = find_unit(path, track.transl_key, poses, track.transl, rate.fps, chosen.layout.up, trans_unit)
    notes = (rate.doubt, *track.doubts, shape_doubt, unit.note)
    return Recording(
        poses=poses,
        fingers=track.turns[:, -NUM_FINGER_JOINTS:] if track.turns.shape[1] in (52, 55) else track.fingers,
        transl=track.transl * unit.metres,
        fps=rate.fps,
        betas=betas,
        gender=_gender(chosen.fields.get("gender", chosen.fields.get("genders"))),
        family=_family(chosen, track.turns),
        up=chosen.layout.up,
        layout=chosen.layout.name,
        camera=chosen.layout.camera,
        people=tuple(each.name for each in people),
        person=chosen.name,
        unit=unit.name,
        unit_sure=unit.sure,
        fps_assumed=rate.assumed,
        rotations=track.way,
        notes=tuple(note for note in notes if note is not None),
    )


def _check(path: Path, person: Person, track: Track) -> None:
    name = " and ".join(person.keys[key] for key in person.layout.poses)
    tables = {name: track.turns.reshape(len(track.turns), -1), track.transl_key: track.transl}
    if track.fingers is not None:
        tables["the hand pose"] = track.fingers.reshape(len(track.fingers), -1)
    for key, values in tables.items():
        _require_sound(path, key, values)
    if track.way is None:
        _require_radians(path, name, track.turns)


def _require_sound(path: Path, name: str, values: np.ndarray) -> None:
    for word, bad in (("not finite", ~np.isfinite(values)), (f"beyond ±{_LARGEST:g}", np.abs(values) > _LARGEST)):
        frames = bad.any(axis=1)
        if frames.any():
            raise ValueError(f"{path}: {name} is {word} in frame {int(np.argmax(frames))}; remove or repair that frame")


def _require_radians(path: Path, name: str, turns: np.ndarray) -> None:
    angle = np.linalg.norm(turns[:, :NUM_BODY_JOINTS], axis=2)
    turned = angle[angle > 0]
    if len(turned) and float((turned > _FULL_TURN).mean()) > _MOST_BEYOND:
        raise ValueError(
            f"{path}: {name} holds degrees (half of the joint rotations are beyond {np.median(turned):.3g}, a full turn is "
            f"{_FULL_TURN:.3g}); multiply it by pi / 180"
        )


def _body_poses(turns: np.ndarray) -> np.ndarray:
    poses = np.zeros((len(turns), SMPL_JOINTS, 3))
    count = SMPL_JOINTS if turns.shape[1] == SMPL_JOINTS else NUM_BODY_JOINTS
    poses[:, :count] = turns[:, :count]
    return poses


def _gender(value: Any) -> str | None:
    text = _word(value)
    return (
        {"m": "male", "f": "female", "n": "neutral"}.get(text, text) if text in ("neutral", "male", "female", *"mfn") else None
    )


def _word(value: Any) -> str:
    """Text in lower case of a value that holds one word, as text, bytes or the text of bytes; else empty."""
    if value is None:
        return ""
    item = flat(value)
    if len(item) != 1:
        return ""
    text = item[0].decode("latin-1") if isinstance(item[0], bytes) else str(item[0])
    return text.strip().strip("b'\"").lower() if text.startswith(("b'", 'b"')) else text.strip().strip("'\"").lower()


def _family(person: Person, turns: np.ndarray) -> str | None:
    fields: Mapping[str, Any] = person.fields
    if "surfacemodeltype" in fields:
        text = _word(fields["surfacemodeltype"]).replace("-", "").replace("+", "").replace("_locked_head", "")
        return text if text in _FAMILIES.values() else None
    if person.layout.family is not None:
        return person.layout.family
    if "rootorient" in fields and "poses" not in fields:
        return "smplx" if any(key in fields for key in ("posejaw", "poseeye")) else None
    if "bodypose" in fields:
        return "smplx" if any(key in fields for key in ("jawpose", "leyepose")) else "smpl"
    return _FAMILIES.get(turns.shape[1])

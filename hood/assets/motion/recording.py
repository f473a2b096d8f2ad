"""Motion files as recorded: whatever layout they have, joint rotations, a translation in metres, and what is known of them.

The frame rate of a motion, under every key and in every form in which files say it; a doubt where none does.

The shape of a recorded subject: one row of coefficients, or what rows of every frame have in common.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hood.assets.files.said import Doubt
from hood.assets.files.text import flat, parse_rate, rates_in
from hood.assets.motion.layouts.content import MOTION_SUFFIXES, VIDEO_FPS, MotionLayout, motion_suffixes, read_content
from hood.assets.motion.layouts.people import Person, choose_person
from hood.assets.motion.layouts.read import NUM_FINGER_JOINTS, Track, numbers, people_in, read_track
from hood.assets.motion.skeleton import find_unit, joints_about_pelvis, spread, upright

#: Rates [1/s] that are taken from a file.
_SLOWEST, _FASTEST = 0.1, 1e5


class Rate(NamedTuple):
    """A frame rate [1/s]. ``assumed``: neither the file nor the caller says it; ``doubt``: about it, where it counts."""

    fps: float
    assumed: bool = False
    doubt: Doubt | None = None


def frame_rate(
    path: Path, sources: Sequence[Mapping[str, Any]], layout: MotionLayout, given: float | None, is_still: bool = False
) -> Rate:
    """The frame rate of a motion, and the doubt where it is assumed or said twice.

    Args:
        sources: what the file holds of the person, and the dicts in which that stands, which may say it as well.
        given: by the caller, instead of what the file says.
        is_still: a single pose, which is held at any rate: none need be said.

    Raises:
        ValueError: no number, out of range, or not there in a layout that has it; names file, key and fix.
    """
    if given is not None:
        if not _SLOWEST <= given <= _FASTEST:
            raise ValueError(f"{path}: file_fps={given}; give the file's frames per second, 0.1 to 100000")
        return Rate(float(given))
    found = [(key, _rate(path, key, value)) for source in sources for key, value in rates_in(source)]
    if found:
        key, rate = found[0]
        other = next(((name, value) for name, value in found if abs(value / rate - 1.0) > 1e-3), None)
        if other is None:
            return Rate(rate)
        said = f"{path}: says {key}={rate:g} and {other[0]}={other[1]:g}; {rate:g} is taken, file_fps={other[1]:g} is the other"
        return Rate(rate, doubt=Doubt("frame_rate", said, value=rate, unit="fps"))
    if is_still:
        return Rate(layout.fps or VIDEO_FPS, assumed=True)
    if layout.fps is None:
        raise ValueError(f"{path}: no mocap_framerate: add it (frames per second) to the file, or pass file_fps=…")
    said = f"{path}: says no frame rate, {layout.fps:g} fps are assumed ({_reason(layout)}); file_fps=… gives the right one"
    return Rate(layout.fps, assumed=True, doubt=Doubt("frame_rate", said, value=layout.fps, unit="fps"))


def _rate(path: Path, key: str, value: Any) -> float:
    rate = parse_rate(value)
    if not _SLOWEST <= rate <= _FASTEST:
        raise ValueError(
            f"{path}: {key} is {' '.join(str(value).split())[:40]}; it must be a positive number of frames per "
            "second (0.1 to 100000; file_fps=… overrides it)"
        )
    return rate


def _reason(layout: MotionLayout) -> str:
    return f"as in {layout.name} files" if layout.name[0].isupper() or layout.name[0].isdigit() else "as in most videos"


_KEYS = ("betas", "shape", "smplbetas", "smplshape", "predshape", "predbetas", "shapes", "beta", "smplbeta")
#: Rows within this of the first are the same shape, written with less precision.
_SAME = 1e-3
#: Estimates of one person differ by less than this from frame to frame: standard deviation of the coefficient that varies most.
_VARIES = 0.5
_LARGEST_COEFFICIENT = 1e3


def subject_shape(path: Path, fields: Mapping[str, Any], keys: Mapping[str, str]) -> tuple[np.ndarray, Doubt | None]:
    """(S,) coefficients, zeros where the file has none; a doubt where they are the mean of estimates of every frame.

    Raises:
        ValueError: no numbers, or rows of different people; names the file, the key and the frame.
    """
    key = next((key for key in _KEYS if key in fields), None)
    if key is None:
        return np.zeros(10), None
    name = keys[key]
    table = np.asarray(numbers(path, name, fields[key]))
    scalar = table.ndim == 0
    rows = table.ndim > 2 or (table.ndim == 2 and table.shape[-1] > 1)
    table = table.reshape(-1, table.shape[-1]) if rows else table.reshape(-1)
    if table.size == 0 or scalar or not (np.abs(table) <= _LARGEST_COEFFICIENT).all():
        raise ValueError(f"{path}: {name} has shape {table.shape} or absurd values; give (S,) finite shape coefficients")
    if table.ndim == 1:
        return table, None
    return _common(path, name, table)


def _common(path: Path, name: str, table: np.ndarray) -> tuple[np.ndarray, Doubt | None]:
    changed = np.abs(table - table[0]).max(axis=1)
    if changed.max() <= _SAME:
        return table[0], None
    spread = float(table.std(axis=0).max())
    if spread > _VARIES:
        raise ValueError(
            f"{path}: {name} changes in frame {int(np.argmax(changed > _SAME))}; a body keeps one shape, keep one row of them, "
            f"{name} = {name}.mean(axis=0)"
        )
    said = f"{path}: {name} varies by {spread:.2g} (standard deviation over frames); its mean is taken, betas=[…] gives a shape"
    return table.mean(axis=0), Doubt("shape", said, value=spread)


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
    chosen = choose_person(path, people, person)
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

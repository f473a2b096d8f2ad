"""Rotations, translation and fingers of a person, whatever layout the file has."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hood.assets.files.said import Doubt
from hood.assets.files.text import flat
from hood.assets.motion.layouts.content import CAMERA_TRANSL, WORLD_TRANSL, Unread, counts_of
from hood.assets.motion.layouts.foreign import are_weights, is_like_motion, unknown_motion, unplaced
from hood.assets.motion.layouts.people import Person, find_people, gather_frames
from hood.assets.motion.layouts.rotations import TRANSPOSED, Turns, as_turns, to_vectors
from hood.assets.motion.skeleton import slerp

NUM_FINGER_JOINTS = 30  # 15 a side, left first
#: Columns of Motion-X: global orientation, body, hands, jaw, expression and face shape (left out), translation, betas.
_MOTION_X = 322
_MOTION_X_PARTS = {"root_orient": (0, 3), "pose_body": (3, 66), "pose_hand": (66, 156), "pose_jaw": (156, 159),
                   "trans": (309, 312), "betas": (312, 322)}  # fmt: skip
#: Keys that say in which frames of a video a person is seen.
FRAME_IDS = ("frameids", "frameid", "frame", "frames", "reorganizeidx")
#: Dicts within each other that are looked into.
_DEEPEST = 4
#: More frames than this come out of no recording that lacks some.
_MOST_FRAMES = 1_000_000


class Track(NamedTuple):
    """A person's motion as the file has it, in the units of the file."""

    turns: np.ndarray  # (N, J, 3) rad; J = 22, 24, 52 or 55
    transl: np.ndarray  # (N, 3)
    fingers: np.ndarray | None  # (N, 30, 3) rad
    transl_key: str
    way: str | None  # how rotations were read that are no axis-angle vectors
    doubts: tuple[Doubt, ...] = ()  # how its rotations are arranged, frames that are missing


def people_in(path: Path, content: Any) -> list[Person]:
    """Everyone whose motion a file holds.

    Raises:
        ValueError: there is nobody; says what the file holds, and what to write instead.
    """
    people = _found(path, content)
    if not people:
        raise ValueError(unknown_motion(path, content))
    return people


def is_of_motion(path: Path, content: Any) -> bool:
    """Whether a file's content is a motion, or something that is given for one: joint positions, tables of features."""
    if are_weights(content):
        return False
    try:
        return bool(_found(path, content)) or is_like_motion(content)
    except ValueError:  # several people in a frame
        return True


def _found(path: Path, content: Any) -> list[Person]:
    return find_people(gather_frames(path, _with_motion_x(content)))


def _with_motion_x(content: Any, depth: int = 0) -> Any:
    """``content`` with the tables of Motion-X in it as dicts."""
    if isinstance(content, np.ndarray) and content.ndim == 3 and len(content) == 1:
        content = content[0]
    if isinstance(content, np.ndarray) and content.ndim == 2 and content.shape[1] == _MOTION_X and content.dtype.kind == "f":
        return {"motionx": {key: content[:, slice(*columns)] for key, columns in _MOTION_X_PARTS.items()}}
    if isinstance(content, dict) and depth < _DEEPEST:
        return {key: _with_motion_x(value, depth + 1) for key, value in content.items()}
    return content


def read_track(path: Path, person: Person) -> Track:
    """The joint rotations and the translation of ``person``.

    Raises:
        ValueError: wrong shapes or kinds of values, or no translation; names file, key and fix.
    """
    name = " and ".join(person.keys[key] for key in person.layout.poses)
    parts = [_part(path, person, key) for key in person.layout.poses]
    if len({len(part.values) for part in parts}) > 1:
        raise ValueError(f"{path}: {name} have {[len(part.values) for part in parts]} frames; they must agree")
    if len(parts) == 2 and parts[1].joints[0] == 0:  # the root stands twice
        parts[1] = Turns(parts[1].values[:, 1:], parts[1].joints[1:])
    turns, way = to_vectors(path, name, parts)
    transl, transl_key = _translation(path, person, len(turns))
    if len(turns) != len(transl):
        raise ValueError(f"{path}: {name} has {len(turns)} frames, {transl_key} has shape {transl.shape}; they must agree")
    track = Track(turns, transl, _hands(path, person, len(turns)), transl_key, way, _about_way(path, name, way))
    return _filled(path, person, track)


def translation_key(person: Person) -> str | None:
    """The squeezed key of a person's translation."""
    keys = (*person.layout.transl, *WORLD_TRANSL, *CAMERA_TRANSL)
    return next((key for key in keys if isinstance(person.fields.get(key), (np.ndarray, list))), None)


def numbers(path: Path, key: str, value: Any) -> np.ndarray:
    """``value`` as an array of float64.

    Raises:
        ValueError: no numbers, or rows of several lengths; names file and key.
    """
    if isinstance(value, Unread):
        raise ValueError(f"{path}: {key} {value.reason}")
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{path}: {key} holds rows of different shapes; all frames must have the same") from error
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{path}: {key} holds {array.dtype} values; it must hold numbers")
    return array.astype(np.float64)


def _part(path: Path, person: Person, key: str) -> Turns:
    array = numbers(path, person.keys[key], person.fields[key])
    if person.layout.name == "MDM" and array.ndim == 3 and array.shape[1] == 6:
        array = array[:24].transpose(2, 0, 1)  # joints, numbers, frames
    counts, first = counts_of(key)
    return as_turns(path, person.keys[key], array, counts, first)


def _about_way(path: Path, key: str, way: str | None) -> tuple[Doubt, ...]:
    if way is None or not way.endswith(TRANSPOSED):
        return ()
    said = (
        f"{path}: by the matrices of {key} knees and elbows bend backwards, and they are read transposed; save poses as "
        "axis-angle vectors [rad] where that is wrong"
    )
    return (Doubt("layout", said),)


def _translation(path: Path, person: Person, num_frames: int) -> tuple[np.ndarray, str]:
    key = translation_key(person)
    if key is None:
        raise ValueError(unplaced(path, person))
    name = person.keys[key]
    array = numbers(path, name, person.fields[key])
    if person.layout.name == "MDM" and array.shape == (3, num_frames):
        array = array.T
    shape = tuple(size for size in array.shape if size != 1) if array.ndim != 2 else array.shape
    if not (shape == (3,) or (len(shape) == 2 and shape[1] == 3)):
        raise ValueError(f"{path}: {name} has shape {array.shape}; it must be (N, 3)")
    transl = array.reshape(-1, 3)
    if person.layout.scaling:
        scaling = numbers(path, person.keys[person.layout.scaling], person.fields[person.layout.scaling]).reshape(-1)
        if len(scaling) not in (1, len(transl)) or not (scaling > 0).all():
            raise ValueError(
                f"{path}: {person.keys[person.layout.scaling]} has shape {scaling.shape}; it must be one number above 0"
            )
        transl = transl / scaling[:, None]
    return transl, name


def _hands(path: Path, person: Person, num_frames: int) -> np.ndarray | None:
    """(N, 30, 3): fingers that stand beside the body's poses."""
    key = next((key for key in ("posehand", "handpose") if key in person.fields), None)
    if key is not None:
        hand = numbers(path, person.keys[key], person.fields[key])
    else:
        sides = [person.fields.get(key) for key in ("lefthandpose", "righthandpose")]
        if any(side is None for side in sides):
            return None
        pair = [numbers(path, "left_hand_pose and right_hand_pose", side) for side in sides]
        if any(side.size != 45 * num_frames for side in pair):
            return None  # coefficients of a hand model
        key, hand = "lefthandpose", np.concatenate([side.reshape(num_frames, 45) for side in pair], axis=1)
    count, rest = divmod(hand.size, NUM_FINGER_JOINTS * 3)
    if rest:
        raise ValueError(f"{path}: {person.keys[key]} has shape {hand.shape}; it must be (N, {NUM_FINGER_JOINTS * 3})")
    if count != num_frames:
        raise ValueError(f"{path}: {person.keys[key]} has {count} frames, the body has {num_frames}; they must agree")
    return hand.reshape(num_frames, NUM_FINGER_JOINTS, 3)


# ---- frames in which the person was not seen ----------------------------------------------------------------------------


def _filled(path: Path, person: Person, track: Track) -> Track:
    """The track with a frame for every number between the first and the last at which the person is seen."""
    key = next((key for key in FRAME_IDS if key in person.fields), None)
    seen = flat(person.fields[key]) if key is not None else np.zeros(0)
    if len(seen) != len(track.turns) or len(seen) < 2 or seen.dtype.kind not in "iuf" or not (np.diff(seen) > 0).all():
        return track
    count = int(seen[-1] - seen[0]) + 1
    if count == len(seen) or count > _MOST_FRAMES:
        return track
    missing = sorted(set(range(count)) - {int(number - seen[0]) for number in seen})
    said = (
        f"{path}: {len(missing)} of {count} frames are missing by its {person.keys[str(key)]}, and are interpolated; "
        "start and stop keep a part without them"
    )
    doubt = Doubt("jump", said, tuple(missing[:100]), float(len(missing)), "frames")
    times, wanted = seen.astype(np.float64), np.arange(count) + float(seen[0])
    fingers = None if track.fingers is None else slerp(track.fingers, times, wanted)
    transl = np.stack([np.interp(wanted, times, track.transl[:, axis]) for axis in range(3)], axis=1)
    return track._replace(
        turns=slerp(track.turns, times, wanted), transl=transl, fingers=fingers, doubts=(*track.doubts, doubt)
    )

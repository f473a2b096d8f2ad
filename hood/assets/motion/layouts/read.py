"""Rotations, translation and fingers of a person, whatever layout the file has.

Sentences for what looks like a motion, or is mistaken for one, and is not read: what it is, and what to write instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hood.assets.files.guarded import listed
from hood.assets.files.said import Doubt
from hood.assets.files.text import flat, squeezed
from hood.assets.motion.layouts.content import CAMERA_TRANSL, WORLD_TRANSL, Unread, counts_of
from hood.assets.motion.layouts.people import Person, find_people, gather_frames
from hood.assets.motion.layouts.rotations import TRANSPOSED, Turns, as_turns, to_vectors
from hood.assets.motion.skeleton import PARENTS, slerp

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


#: Bones keep their length: it varies by less than this share where triples are places of joints.
_RIGID = 0.03
_WRITE = "np.savez('m.npz', poses=…, trans=…, mocap_framerate=…)"
_NO_BODY = (
    "joint positions are not read, and rotations do not follow from them alone; fit SMPL to them (SMPLify, or the fitting of "
    "the program that made them) and give its poses (N, 72) and trans (N, 3)"
)
#: Widths of tables of features, by the data sets they are from.
_FEATURES = {263: "HumanML3D", 251: "KIT-ML"}
_WEIGHTS = ("statedict", "modelstatedict", "optimizer", "pytorchlightningversion", "epoch")


def unknown_motion(path: Path, content: Any) -> str:
    """The sentence for content in which no layout is found."""
    if isinstance(content, np.ndarray):
        return f"{path}: {_bare(content)}"
    if not isinstance(content, Mapping):
        return f"{path}: holds a {type(content).__name__}, not a motion; it must be a dict of arrays"
    keys = {squeezed(key): key for key in content}
    if are_weights(content):
        return f"{path}: holds the weights of a network, not a motion; pass checkpoint={path}"
    if "vtemplate" in keys:
        return f"{path}: holds a body model, not a motion; pass body={path}"
    if "verts" in keys or "vertices" in keys:
        return f"{path}: holds a mesh, not joint rotations; a moving mesh is a body: pass body={path}"
    if {"rh", "th"} <= set(keys):
        return _about_origin(path)
    if {"motion", "lengths"} <= set(keys):
        return (
            f"{path}: the results of MDM are joint positions, which are not read; its visualize.render_mesh writes a file "
            "…_smpl_params.npy for each, which is"
        )
    if any(_is_positions(squeezed(key), value) for key, value in _tables(content)):
        return f"{path}: {_NO_BODY}"
    unread = next((f"{key} {value.reason}" for key, value in content.items() if isinstance(value, Unread)), None)
    found = listed(sorted(content))
    if unread is not None:
        return f"{path}: no motion among {found}, and {unread}"
    return (
        f"{path}: not an AMASS motion: neither 'poses' nor 'root_orient' and 'pose_body' inside "
        f"(found {found}); or give 'body_pose', 'global_orient' and 'transl'"
    )


def is_like_motion(content: Any) -> bool:
    """Whether content in which no layout is found is given for a motion: arrays without keys, joint positions."""
    if isinstance(content, list):
        return len(content) > 0 and is_like_motion(content[0])
    if not isinstance(content, Mapping):
        return isinstance(content, np.ndarray)
    keys = {squeezed(key) for key in content}
    return {"rh", "th"} <= keys or any(_is_positions(squeezed(key), value) for key, value in _tables(content))


def unplaced(path: Path, person: Person) -> str:
    """The sentence for poses without a translation."""
    if {"rh", "th"} <= set(person.keys):
        return _about_origin(path)
    head = f"{path}: not an AMASS motion: key 'trans' is missing"
    if {"predcam", "origcam", "cam"} & set(person.keys):
        return (
            f"{head}; the poses of an image estimator (VIBE, SPIN, PyMAF) come with a camera that has no metres: add trans "
            "(N, 3) [m], zeros to stay in place, and save both in one file"
        )
    return f"{head} (found {listed(sorted(person.keys.values()))}); add trans (N, 3) in metres, zeros to stay in place"


def _about_origin(path: Path) -> str:
    return (
        f"{path}: the layout of EasyMocap and ZJU-MoCap (Rh, Th), which turns about the origin, not the pelvis, is not read; "
        "write global_orient=Rh, body_pose=poses[:, 3:] and transl=Th + (R(Rh) - 1) @ J0, J0 the pelvis at rest"
    )


def _bare(array: np.ndarray) -> str:
    """What an array without keys is, and how to write it."""
    shape, width = array.shape, array.shape[-1] if array.ndim else 0
    if array.ndim == 2 and width in _FEATURES:
        return (
            f"{_FEATURES[width]} features {shape} are not read: they hold joint positions and velocities, no rotations that a "
            "body can perform; give the AMASS file that they were made from, or fit SMPL to the recovered joints"
        )
    if array.ndim >= 3 and width == 3 and _are_places(array):
        return f"an array of joint positions {shape}: {_NO_BODY}"
    if array.dtype.kind in "iuf" and array.ndim >= 2 and (width in (66, 72, 156, 165) or array.ndim >= 3):
        return (
            f"an array {shape} without keys says neither where the body is nor how fast it moves; if it holds joint rotations, "
            f"write them with a translation: {_WRITE}"
        )
    return f"an array {shape} of {array.dtype} is no motion; write its joint rotations and translation by key: {_WRITE}"


def _are_places(array: np.ndarray) -> bool:
    """Whether triples (N, J, 3) are places: bones between neighbours then have one length in all frames."""
    joints = array.reshape(-1, *array.shape[-2:]).astype(np.float64)
    count = min(joints.shape[1], len(PARENTS))
    if joints.shape[1] < 15 or not np.isfinite(joints).all():
        return joints.shape[1] >= 15
    bones = np.stack([joints[:, j] - joints[:, PARENTS[j]] for j in range(1, count)], axis=1)
    length = np.linalg.norm(bones, axis=2)
    return bool(np.median(length.std(axis=0) / np.maximum(length.mean(axis=0), 1e-9)) < _RIGID and length.mean() > 0)


def _is_positions(key: str, value: Any) -> bool:
    names = ("joints", "joints3d", "jointpositions", "keypoints3d", "kp3d", "j3d", "positions", "motion", "motions")
    return key in names and isinstance(value, np.ndarray) and value.ndim >= 3


def are_weights(content: Any) -> bool:
    """Whether content is what training writes: a dict of tables whose names are paths of modules."""
    if not isinstance(content, Mapping):
        return False
    if any(squeezed(key) in _WEIGHTS for key in content):
        return True
    names = [key for key, value in _tables(content) if "." in key]
    return len(names) > 3 and any(name.endswith(("weight", "bias")) for name in names)


def _tables(content: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, np.ndarray]]:
    for key, value in content.items():
        if isinstance(value, np.ndarray):
            yield key, value
        elif isinstance(value, Mapping) and depth < 2:
            yield from _tables(value, depth + 1)

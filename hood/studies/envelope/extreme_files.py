"""Extreme motions for the stability map: a standing body that jumps, spins, falls, or bends too far.

Writes the input files of the stability map: extreme motions and garments, and broken files.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.body.load import load_body
from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import locate, unknown
from hood.assets.garment.garment import load_garment, save_garment
from hood.studies.envelope.extreme_garments import FAULTS

_Array = np.ndarray

#: Seconds from standing into a pose.
_BLEND = 1.0
#: Lengths of the default body [m] from hip to knee and from knee to ankle, and how far its shins lean in a crouch [degrees].
_THIGH, _SHIN, _LEAN = 0.40, 0.42, 20.0
#: Rows of the joints in a pose.
_HIPS, _KNEES, _SPINE, _SHOULDERS, _ELBOWS = (1, 2), (4, 5), 3, (16, 17), (18, 19)


def _rest(poses: _Array, trans: _Array, time: _Array, amount: float) -> tuple[_Array, _Array]:
    return poses, trans


def _teleport(poses: _Array, trans: _Array, time: _Array, metres: float) -> tuple[_Array, _Array]:
    """All at once, sideways."""
    return poses, trans + metres * (time[:, None] > 0) * [1.0, 0.0, 0.0]


def _turn(poses: _Array, trans: _Array, time: _Array, degrees: float) -> tuple[_Array, _Array]:
    """All at once, about the upright axis."""
    return _turned(poses, np.radians(degrees) * (time[:, None] > 0) * [0.0, 0.0, 1.0]), trans


def _spin(poses: _Array, trans: _Array, time: _Array, rate: float) -> tuple[_Array, _Array]:
    """About the upright axis."""
    return _turned(poses, 2.0 * np.pi * rate * time[:, None] * [0.0, 0.0, 1.0]), trans


def _stop(poses: _Array, trans: _Array, time: _Array, g: float) -> tuple[_Array, _Array]:
    """From 3 m/s within the time that so many g take."""
    speed = 3.0
    slowing = speed / (9.81 * g)
    since = np.clip(time - 0.5, 0.0, slowing)
    way = speed * np.minimum(time, 0.5) + speed * since - 0.5 * speed / slowing * since**2
    return poses, trans + way[:, None] * [1.0, 0.0, 0.0]


def _fall(poses: _Array, trans: _Array, time: _Array, metres: float) -> tuple[_Array, _Array]:
    """Freely, then it stands at once."""
    return poses, trans - np.minimum(0.5 * 9.81 * time**2, metres)[:, None] * [0.0, 0.0, 1.0]


def _offset(poses: _Array, trans: _Array, time: _Array, metres: float) -> tuple[_Array, _Array]:
    """A slow walk far from the origin."""
    return poses, trans + [metres, metres, 0.0] + 0.5 * time[:, None] * [1.0, 0.0, 0.0]


def _through(poses: _Array, trans: _Array, time: _Array, degrees: float) -> tuple[_Array, _Array]:
    """The left arm, so far below the T-pose that it passes through the trunk."""
    return _bent(poses, time, {_SHOULDERS[0]: _vector(z=-degrees), _ELBOWS[0]: _vector()}), trans


def _crossed(poses: _Array, trans: _Array, time: _Array, degrees: float) -> tuple[_Array, _Array]:
    """Both arms in front of the chest, turned inwards so far from the T-pose, through each other."""
    left, right = _SHOULDERS
    arms = {left: _vector(y=-degrees), right: _vector(y=degrees)}
    return _bent(poses, time, arms | {_ELBOWS[0]: _vector(y=-60.0), _ELBOWS[1]: _vector(y=60.0)}), trans


def _crouch(poses: _Array, trans: _Array, time: _Array, degrees: float) -> tuple[_Array, _Array]:
    """Hips bent by so many degrees, the pelvis lowered so that the feet stay on the ground."""
    joints = {joint: _vector(x=-degrees) for joint in _HIPS} | {joint: _vector(x=degrees + _LEAN) for joint in _KNEES}
    high = _THIGH * np.cos(np.radians(degrees)) + _SHIN * np.cos(np.radians(_LEAN))
    down = (_THIGH + _SHIN - high) * _share(time)
    return _bent(poses, time, joints | {_SPINE: _vector(x=20.0)}), trans - down[:, None] * [0.0, 0.0, 1.0]


def _split(poses: _Array, trans: _Array, time: _Array, degrees: float) -> tuple[_Array, _Array]:
    """Both legs sideways, each by so many degrees."""
    left, right = _HIPS
    return _bent(poses, time, {left: _vector(z=degrees), right: _vector(z=-degrees)}), trans


def _reach(poses: _Array, trans: _Array, time: _Array, degrees: float) -> tuple[_Array, _Array]:
    """Both arms, so far above the T-pose."""
    left, right = _SHOULDERS
    return _bent(poses, time, {left: _vector(z=degrees), right: _vector(z=-degrees)}), trans


def _handstand(poses: _Array, trans: _Array, time: _Array, degrees: float) -> tuple[_Array, _Array]:
    """Over the head by so many degrees, arms stretched out."""
    poses, trans = _reach(poses, trans, time, 80.0)
    return _turned(poses, np.radians(degrees) * _share(time)[:, None] * [1.0, 0.0, 0.0]), trans


#: By name: of poses (T, 3·J) [rad], translations (T, 3) [m], z up, the time (T,) [s] since something happens, and an amount.
MOTIONS: Mapping[str, Callable[[_Array, _Array, _Array, float], tuple[_Array, _Array]]] = {
    "rest": _rest, "teleport": _teleport, "turn": _turn, "spin": _spin, "stop": _stop, "fall": _fall, "offset": _offset,
    "through": _through, "crossed": _crossed, "crouch": _crouch, "split": _split, "reach": _reach, "handstand": _handstand,
}  # fmt: skip


def _turned(poses: _Array, turn: _Array) -> _Array:
    """Poses of a body that is turned by rotation vectors (T, 3) in the world."""
    root = Rotation.from_rotvec(turn) * Rotation.from_rotvec(poses[:, :3])
    return np.column_stack([root.as_rotvec(), poses[:, 3:]])


def _bent(poses: _Array, time: _Array, joints: Mapping[int, _Array]) -> _Array:
    """Poses with ``joints`` bent from where they are into rotations (3,), at first and at last without speed."""
    poses = poses.copy()
    for joint, vector in joints.items():
        columns = slice(3 * joint, 3 * joint + 3)
        before = Rotation.from_rotvec(poses[:, columns])
        way = (before.inv() * Rotation.from_rotvec(vector)).as_rotvec()
        poses[:, columns] = (before * Rotation.from_rotvec(_share(time)[:, None] * way)).as_rotvec()
    return poses


def _share(time: _Array) -> _Array:
    """Of the way into a pose, (T,)."""
    done = np.clip(time / _BLEND, 0.0, 1.0)
    return np.asarray(done * done * (3.0 - 2.0 * done))


def _vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> _Array:
    """Rotation vector [rad] from degrees; x to the body's left, y up, z to the front."""
    return np.radians([x, y, z])


#: Frames per second, and seconds of standing before anything happens.
FPS, CALM = 60.0, 0.5
#: Values that no array may hold, and files that are none.
_VALUES = {"nan": np.nan, "inf": np.inf}
_FILES = {"empty": 0.0, "cut": 0.5}  # the share that is left of it
#: Faces that no garment may have.
_FACES = {"beyond": 10**6, "negative": -1}


def write_motion(path: Path, name: str, seconds: float) -> None:
    """Write the motion ``name`` as an AMASS file of so many seconds, after half a second of standing.

    Amounts: ``teleport:0.5`` (m), ``turn:90`` (degrees at once), ``spin:2`` (turns per second), ``stop:10`` (g), ``fall:2``
    (m), ``offset:1000`` (m), ``rest``; poses taken within a second, in degrees: ``through:130``, ``crossed:110``,
    ``crouch:110``, ``split:45``, ``reach:80``, ``handstand:180``. Broken ones: ``nan:poses`` (an entry of an array),
    ``inf:trans``, ``empty``, ``cut``.

    Raises:
        ValueError: there is no such motion.
    """
    kind, _, amount = name.partition(":")
    if kind not in (*MOTIONS, *_VALUES, *_FILES):
        raise ValueError(unknown("motion", kind, (*MOTIONS, *_VALUES, *_FILES)))
    with np.load(locate("motions", "stand_sway"), allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    count = round(seconds * FPS) + 1
    poses, trans = (np.repeat(arrays[key][:1], count, axis=0).astype(np.float64) for key in ("poses", "trans"))
    if kind in MOTIONS:
        time = np.maximum(np.arange(count) / FPS - CALM, 0.0)
        poses, trans = MOTIONS[kind](poses, trans, time, float(amount or 0.0))
    arrays |= {"poses": poses, "trans": trans, "mocap_framerate": np.array(FPS)}
    _write(path, kind, amount, arrays)


def write_garment(path: Path, garment: str, name: str) -> None:
    """Write an embedded garment with a fault.

    Amounts: ``size:0.5`` (factor), ``slivers:100`` (length over height of ten faces), ``duplicates:20`` (vertices 1 µm
    apart), ``flipped:30`` (faces), ``isolated:10`` (vertices), ``irregular:0.5`` (share of the way that vertices are moved),
    ``components:10``, ``remesh:300`` (vertices), ``subdivide:1`` (times), ``sheet:2`` (m above the head). Broken:
    ``nan:rest_pos`` (an entry of an array), ``inf:uv``, ``faces:beyond``, ``faces:negative``, ``empty``, ``cut``.

    Raises:
        ValueError: there is no such fault.
    """
    kind, _, amount = name.partition(":")
    if kind not in (*FAULTS, *_VALUES, *_FILES, "faces"):
        raise ValueError(unknown("fault", kind, (*FAULTS, *_VALUES, *_FILES, "faces")))
    whole = load_garment(garment)
    if kind in FAULTS:
        save_garment(path, FAULTS[kind](whole, float(amount or 0.0), np.random.default_rng(0)))
        return
    save_garment(path, whole)
    with np.load(path, allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    if kind == "faces":
        arrays["faces"][len(arrays["faces"]) // 2, 1] = _FACES[amount]
    _write(path, kind, amount, arrays)


def write_still_body(path: Path) -> None:
    """Write the default body in T-pose as an OBJ mesh."""
    body = load_body()
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in body.v_template]
    lines += [f"f {a} {b} {c}" for a, b, c in body.faces + 1]
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _write(path: Path, kind: str, where: str, arrays: dict[str, np.ndarray]) -> None:
    """Write ``arrays``, with a value that one of them may not hold, or not all of the file, where ``kind`` says so."""
    if kind in _VALUES:
        broken = arrays[where].astype(np.float64)
        broken.reshape(-1)[broken.size // 2] = _VALUES[kind]
        arrays = arrays | {where: broken}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    whole = content.getvalue()
    write_atomically(path, whole[: round(len(whole) * _FILES.get(kind, 1.0))])

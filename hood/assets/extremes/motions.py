"""Extreme motions for the stability map: a standing body that jumps, spins, falls, or bends too far."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

Array = np.ndarray

#: Seconds from standing into a pose.
_BLEND = 1.0
#: Lengths of the default body [m] from hip to knee and from knee to ankle, and how far its shins lean in a crouch [degrees].
_THIGH, _SHIN, _LEAN = 0.40, 0.42, 20.0
#: Rows of the joints in a pose.
_HIPS, _KNEES, _SPINE, _SHOULDERS, _ELBOWS = (1, 2), (4, 5), 3, (16, 17), (18, 19)


def _rest(poses: Array, trans: Array, time: Array, amount: float) -> tuple[Array, Array]:
    return poses, trans


def _teleport(poses: Array, trans: Array, time: Array, metres: float) -> tuple[Array, Array]:
    """All at once, sideways."""
    return poses, trans + metres * (time[:, None] > 0) * [1.0, 0.0, 0.0]


def _turn(poses: Array, trans: Array, time: Array, degrees: float) -> tuple[Array, Array]:
    """All at once, about the upright axis."""
    return _turned(poses, np.radians(degrees) * (time[:, None] > 0) * [0.0, 0.0, 1.0]), trans


def _spin(poses: Array, trans: Array, time: Array, rate: float) -> tuple[Array, Array]:
    """About the upright axis."""
    return _turned(poses, 2.0 * np.pi * rate * time[:, None] * [0.0, 0.0, 1.0]), trans


def _stop(poses: Array, trans: Array, time: Array, g: float) -> tuple[Array, Array]:
    """From 3 m/s within the time that so many g take."""
    speed = 3.0
    slowing = speed / (9.81 * g)
    since = np.clip(time - 0.5, 0.0, slowing)
    way = speed * np.minimum(time, 0.5) + speed * since - 0.5 * speed / slowing * since**2
    return poses, trans + way[:, None] * [1.0, 0.0, 0.0]


def _fall(poses: Array, trans: Array, time: Array, metres: float) -> tuple[Array, Array]:
    """Freely, then it stands at once."""
    return poses, trans - np.minimum(0.5 * 9.81 * time**2, metres)[:, None] * [0.0, 0.0, 1.0]


def _offset(poses: Array, trans: Array, time: Array, metres: float) -> tuple[Array, Array]:
    """A slow walk far from the origin."""
    return poses, trans + [metres, metres, 0.0] + 0.5 * time[:, None] * [1.0, 0.0, 0.0]


def _through(poses: Array, trans: Array, time: Array, degrees: float) -> tuple[Array, Array]:
    """The left arm, so far below the T-pose that it passes through the trunk."""
    return _bent(poses, time, {_SHOULDERS[0]: _vector(z=-degrees), _ELBOWS[0]: _vector()}), trans


def _crossed(poses: Array, trans: Array, time: Array, degrees: float) -> tuple[Array, Array]:
    """Both arms in front of the chest, turned inwards so far from the T-pose, through each other."""
    left, right = _SHOULDERS
    arms = {left: _vector(y=-degrees), right: _vector(y=degrees)}
    return _bent(poses, time, arms | {_ELBOWS[0]: _vector(y=-60.0), _ELBOWS[1]: _vector(y=60.0)}), trans


def _crouch(poses: Array, trans: Array, time: Array, degrees: float) -> tuple[Array, Array]:
    """Hips bent by so many degrees, the pelvis lowered so that the feet stay on the ground."""
    joints = {joint: _vector(x=-degrees) for joint in _HIPS} | {joint: _vector(x=degrees + _LEAN) for joint in _KNEES}
    high = _THIGH * np.cos(np.radians(degrees)) + _SHIN * np.cos(np.radians(_LEAN))
    down = (_THIGH + _SHIN - high) * _share(time)
    return _bent(poses, time, joints | {_SPINE: _vector(x=20.0)}), trans - down[:, None] * [0.0, 0.0, 1.0]


def _split(poses: Array, trans: Array, time: Array, degrees: float) -> tuple[Array, Array]:
    """Both legs sideways, each by so many degrees."""
    left, right = _HIPS
    return _bent(poses, time, {left: _vector(z=degrees), right: _vector(z=-degrees)}), trans


def _reach(poses: Array, trans: Array, time: Array, degrees: float) -> tuple[Array, Array]:
    """Both arms, so far above the T-pose."""
    left, right = _SHOULDERS
    return _bent(poses, time, {left: _vector(z=degrees), right: _vector(z=-degrees)}), trans


def _handstand(poses: Array, trans: Array, time: Array, degrees: float) -> tuple[Array, Array]:
    """Over the head by so many degrees, arms stretched out."""
    poses, trans = _reach(poses, trans, time, 80.0)
    return _turned(poses, np.radians(degrees) * _share(time)[:, None] * [1.0, 0.0, 0.0]), trans


#: By name: of poses (T, 3·J) [rad], translations (T, 3) [m], z up, the time (T,) [s] since something happens, and an amount.
MOTIONS: Mapping[str, Callable[[Array, Array, Array, float], tuple[Array, Array]]] = {
    "rest": _rest, "teleport": _teleport, "turn": _turn, "spin": _spin, "stop": _stop, "fall": _fall, "offset": _offset,
    "through": _through, "crossed": _crossed, "crouch": _crouch, "split": _split, "reach": _reach, "handstand": _handstand,
}  # fmt: skip


def _turned(poses: Array, turn: Array) -> Array:
    """Poses of a body that is turned by rotation vectors (T, 3) in the world."""
    root = Rotation.from_rotvec(turn) * Rotation.from_rotvec(poses[:, :3])
    return np.column_stack([root.as_rotvec(), poses[:, 3:]])


def _bent(poses: Array, time: Array, joints: Mapping[int, Array]) -> Array:
    """Poses with ``joints`` bent from where they are into rotations (3,), at first and at last without speed."""
    poses = poses.copy()
    for joint, vector in joints.items():
        columns = slice(3 * joint, 3 * joint + 3)
        before = Rotation.from_rotvec(poses[:, columns])
        way = (before.inv() * Rotation.from_rotvec(vector)).as_rotvec()
        poses[:, columns] = (before * Rotation.from_rotvec(_share(time)[:, None] * way)).as_rotvec()
    return poses


def _share(time: Array) -> Array:
    """Of the way into a pose, (T,)."""
    done = np.clip(time / _BLEND, 0.0, 1.0)
    return np.asarray(done * done * (3.0 - 2.0 * done))


def _vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Array:
    """Rotation vector [rad] from degrees; x to the body's left, y up, z to the front."""
    return np.radians([x, y, z])

"""From the MakeHuman rest pose to the SMPL T-pose, one constant world rotation per joint."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Direction = Array | tuple[float, float, float]

JOINT_NAMES = (
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 "
    "left_foot right_foot neck left_collar right_collar head left_shoulder right_shoulder left_elbow "
    "right_elbow left_wrist right_wrist left_hand right_hand"
).split()
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)

# Directions of the left limbs in the T-pose (x left, y up, z forward): straight, slightly drooping arms,
# feet apart.
_TARGETS = {
    "shoulder": (0.2553, -0.0156, -0.0229),
    "elbow": (0.2657, 0.0127, -0.0074),
    "wrist": (1.0, -0.05, 0.0),
    "hip": (0.085, -1.0, 0.01),
    "knee": (0.0, -1.0, -0.06),
}
COLLAR_SHARE = 0.12  # the part of the arm's raise that the collar bone takes


def _frame(primary: Direction, secondary: Direction) -> Array:
    """Rotation matrix with columns `primary`, the part of `secondary` normal to it, their cross product."""
    first = np.asarray(primary, dtype=float)
    first = first / np.linalg.norm(first)
    second = np.asarray(secondary, dtype=float) - np.dot(secondary, first) * first
    second = second / np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def tpose_rotations(joints: Array, index_finger: Array, little_finger: Array) -> Array:
    """World rotations (24,3,3) that carry the left-right symmetric rest `joints` (24,3) into the T-pose.

    `index_finger` and `little_finger` (3,) are the left finger roots: they fix the palm, which faces down.
    The elbow's flexion axis becomes vertical, as in SMPL.
    """
    index = {name: i for i, name in enumerate(JOINT_NAMES)}
    names = ("shoulder", "elbow", "wrist", "hand", "hip", "knee", "ankle")
    left = {name: joints[index["left_" + name]] for name in names}
    upper, fore = left["elbow"] - left["shoulder"], left["wrist"] - left["elbow"]
    flexion = np.cross(upper, fore)
    down = (0.0, -1.0, 0.0)
    turn = {
        "shoulder": _frame(_TARGETS["shoulder"], down) @ _frame(upper, flexion).T,
        "wrist": _frame(_TARGETS["wrist"], (0.0, 0.0, 1.0))
        @ _frame(left["hand"] - left["wrist"], index_finger - little_finger).T,
        "hip": _swing(left["knee"] - left["hip"], _TARGETS["hip"]),
        "knee": _swing(left["ankle"] - left["knee"], _TARGETS["knee"]),
    }
    elbow = _frame(_TARGETS["elbow"], down) @ _frame(fore, flexion).T
    # Half of the pronation happens in the forearm; otherwise the wrist would wring like a towel.
    turn["elbow"] = _rotation_power(_twist(turn["wrist"] @ elbow.T, _TARGETS["elbow"]), 0.5) @ elbow
    turn["collar"] = _rotation_power(turn["shoulder"], COLLAR_SHARE)
    turn["hand"] = turn["wrist"]
    mirror = np.diag([-1.0, 1.0, 1.0])
    world = np.tile(np.eye(3), (len(JOINT_NAMES), 1, 1))
    for name, rotation in turn.items():
        world[index["left_" + name]] = rotation
        world[index["right_" + name]] = mirror @ rotation @ mirror
    return world


def _swing(source: Direction, target: Direction) -> Array:
    """Smallest rotation from direction `source` to direction `target`."""
    axis = np.cross(source, target)
    return _frame(target, np.cross(axis, target)) @ _frame(source, np.cross(axis, source)).T


def _twist(rotation: Array, axis: Direction) -> Array:
    """The part of `rotation` about `axis`."""
    direction = np.asarray(axis) / np.linalg.norm(axis)
    quat = Rotation.from_matrix(rotation).as_quat()
    return np.asarray(Rotation.from_quat([*(direction * (quat[:3] @ direction)), quat[3]]).as_matrix())


def _rotation_power(rotation: Array, share: float) -> Array:
    return np.asarray(Rotation.from_rotvec(share * Rotation.from_matrix(rotation).as_rotvec()).as_matrix())


def apply_tpose(rotations: Array, verts: Array, joints: Array, weights: Array) -> tuple[Array, Array]:
    """Skin `verts` (..., V, 3) and `joints` (..., 24, 3) by constant rotations: linear in both arguments."""
    posed = np.array(joints)
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            posed[..., joint, :] = (
                posed[..., parent, :] + (joints[..., joint, :] - joints[..., parent, :]) @ rotations[parent].T
            )
    offset = posed - np.einsum("jab,...jb->...ja", rotations, joints)
    blended = np.einsum("vj,jab->vab", weights, rotations)
    skinned = np.einsum("vab,...vb->...va", blended, verts) + np.einsum("vj,...ja->...va", weights, offset)
    return skinned, posed

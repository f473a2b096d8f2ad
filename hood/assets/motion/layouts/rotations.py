"""Joint rotations as axis-angle vectors, from matrices, quaternions and the six numbers of two matrix rows or columns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.motion.skeleton import ELBOWS, KNEES

#: Numbers of one rotation → what they are.
_KINDS = {3: "axis-angle vectors", 4: "quaternions", 6: "6D rotations", 9: "rotation matrices"}
#: Joints that hardly turn in anyone: spine, feet, neck, collars, head.
_STEADY = (3, 6, 9, 10, 11, 12, 13, 14, 15)
#: The median turn [rad] of these joints is below the first in the right order of a quaternion, beyond the second in the wrong.
_SMALL, _LARGE = 0.7, 1.2
#: Knees and elbows bend one way: share of their turning that does so, by the right reading of a matrix. Where they turn by less
#: than the second [rad] on average, they are straight and tell nothing.
_ONE_WAY, _STRAIGHT = 0.5, 0.05
#: How matrices are read in which they bend backwards.
TRANSPOSED = "transposed by the joints"
#: Matrices and quaternions of half precision are off unit length by so much.
_UNIT = 2e-2
#: Ways to arrange two vectors in six numbers, from how (3, 3) matrices begin: two rows, two columns, and those interleaved.
_SIX = ("two rows", "two columns", "two columns, interleaved")


class Turns(NamedTuple):
    """Rotations of some joints as a file has them: (N, J, C), C numbers each."""

    values: np.ndarray
    joints: tuple[int, ...]  # J numbers in SMPL's order

    @property
    def kind(self) -> str:
        return _KINDS[self.values.shape[2]]


def as_turns(path: Path, key: str, array: np.ndarray, counts: Sequence[int], first: int) -> Turns:
    """Rotations under ``key``, of one of ``counts`` joints from the joint ``first`` on; a pose alone is one frame.

    Raises:
        ValueError: an array that is none of the shapes; names file, key and shapes.
    """
    if array.size == 0:
        raise ValueError(f"{path}: {key} has no frames (its shape is {array.shape}); give at least one")
    for count in counts:
        for per in _KINDS:
            found = _split(array, count, per)
            if found is not None:
                return Turns(found, tuple(range(first, first + count)))
    allowed = " or ".join(f"(N, {3 * count})" for count in counts)
    raise ValueError(
        f"{path}: {key} has shape {array.shape}; it must be {allowed}, or as many joints as matrices, quaternions or 6D"
    )


def _split(array: np.ndarray, count: int, per: int) -> np.ndarray | None:
    """(N, J, C) of an array of frames, or of one alone, where joints and numbers stand apart or not; None for other shapes."""
    cells = [(count, per), (count * per,)] + [(count, 3, 3)] * (per == 9) + [(3, 3)] * (per == 9 and count == 1)
    if count == 1 and per == 3 and array.shape[-2:] == (3, 3) and _are_matrices(array.reshape(-1, 3, 3)):
        return None  # three numbers of three frames would look the same
    for cell in cells:
        frames = array.shape[: max(array.ndim - len(cell), 0)]
        if array.shape[len(frames) :] == cell and math.prod(frames) == max(frames, default=1) > 0:
            return array.reshape(-1, count, per)
    return None


def to_vectors(path: Path, key: str, parts: Sequence[Turns]) -> tuple[np.ndarray, str | None]:
    """(N, J, 3) rad: the parts side by side as axis-angle vectors, and how they were read where that is not plain.

    Raises:
        ValueError: numbers that are no rotations, or of which the skeleton does not tell the order; names the ways out.
    """
    joints = [joint for part in parts for joint in part.joints]
    ways = {part.kind: _ways(path, key, part) for part in parts}
    kind = max(parts, key=lambda part: len(part.joints)).kind  # what the body tells holds for the root, which tells nothing
    if any(len(found) > 1 for other, found in ways.items() if other != kind):
        raise ValueError(f"{path}: {key} mix {' and '.join(ways)}; save all of them as axis-angle vectors [rad]")
    read = {way: _read(parts, kind, way) for way in ways[kind]}
    if len(read) == 1:
        way, vectors = next(iter(read.items()))
        if kind == _KINDS[9] and _bends(joints, vectors) < -_ONE_WAY:
            return _read(parts, kind, TRANSPOSED), f"{kind}, {TRANSPOSED}"
        return vectors, None if kind == _KINDS[3] else way if way == kind else f"{kind}, {way}"
    for way, vectors in read.items():
        if all(_is_better(joints, vectors, other, kind) for name, other in read.items() if name != way):
            return vectors, f"{kind}, {way} by the joints"
    raise ValueError(f"{path}: {key} holds {kind}, and {_OPEN[kind]}")


_OPEN = {
    _KINDS[4]: (
        "neither w first nor w last makes a plain pose of them; save poses as axis-angle vectors, scipy's "
        "Rotation.from_quat(q[..., [1, 2, 3, 0]]).as_rotvec() where w is first"
    ),
    _KINDS[6]: (
        "knees and elbows do not tell whether they are rows or columns of the matrices; save poses as axis-angle vectors, "
        "scipy's Rotation.from_matrix(…).as_rotvec()"
    ),
}


def _ways(path: Path, key: str, part: Turns) -> list[str]:
    """How the numbers of a part can be read, without a look at the skeleton."""
    if part.kind == _KINDS[3]:
        return [part.kind]
    values = part.values.reshape(-1, part.values.shape[2])
    if part.kind == _KINDS[9]:
        ways = [part.kind] if _are_matrices(values.reshape(-1, 3, 3)) else []
    elif part.kind == _KINDS[4]:
        ways = ["w first", "w last"] if _near(np.linalg.norm(values, axis=1), 1.0) else []
    else:
        ways = _six_ways(values)
    if not ways:
        raise ValueError(
            f"{path}: {key} has the shape of {part.kind} and does not hold any; save poses as axis-angle vectors [rad]"
        )
    return ways


def _six_ways(values: np.ndarray) -> list[str]:
    """Networks write six numbers that are near two unit vectors at right angles, not exactly."""

    def off(pair: np.ndarray) -> float:
        lengths = np.abs(np.linalg.norm(pair, axis=2) - 1.0).max(axis=1)
        return float(np.median(lengths + np.abs((pair[:, 0] * pair[:, 1]).sum(axis=1))))

    apart, woven = off(values.reshape(-1, 2, 3)), off(values.reshape(-1, 3, 2).transpose(0, 2, 1))
    if min(apart, woven) > 0.3:
        return []
    # At rest both arrangements hold unit vectors: (1, 0, 0, 1, 0, 0) against (1, 0, 0, 0, 1, 0) still differ.
    return [_SIX[2]] if woven < apart else list(_SIX[:2])


def _read(parts: Sequence[Turns], kind: str, way: str) -> np.ndarray:
    return np.concatenate([_vectors(part, way if part.kind == kind else part.kind) for part in parts], axis=1)


def _vectors(part: Turns, way: str) -> np.ndarray:
    """(N, J, 3) rad."""
    flat = part.values.reshape(-1, part.values.shape[2])
    if part.kind == _KINDS[3]:
        return part.values
    if part.kind == _KINDS[9]:
        found = Rotation.from_matrix(_nearest(flat.reshape(-1, 3, 3)))
        found = found.inv() if way == TRANSPOSED else found
    elif part.kind == _KINDS[4]:
        found = Rotation.from_quat(flat[:, [1, 2, 3, 0]] if way == "w first" else flat)
    else:
        pair = flat.reshape(-1, 3, 2).transpose(0, 2, 1) if way == _SIX[2] else flat.reshape(-1, 2, 3)
        rows = _complete(pair)
        found = Rotation.from_matrix(rows if way == _SIX[0] else rows.transpose(0, 2, 1))
    return np.asarray(found.as_rotvec()).reshape(*part.values.shape[:2], 3)


def _complete(pair: np.ndarray) -> np.ndarray:
    """(M, 3, 3): rows by Gram-Schmidt from pairs (M, 2, 3), after Zhou et al. 2019."""
    first = pair[:, 0] / np.linalg.norm(pair[:, 0], axis=1, keepdims=True)
    second = pair[:, 1] - (first * pair[:, 1]).sum(axis=1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _nearest(matrices: np.ndarray) -> np.ndarray:
    """The rotations nearest to (M, 3, 3) that are rotations up to rounding."""
    left, _, right = np.linalg.svd(matrices)
    return left @ right


def _are_matrices(own: np.ndarray) -> bool:
    return _near(own @ own.transpose(0, 2, 1), np.eye(3)) and bool((np.linalg.det(own) > 0).all())


def _near(values: np.ndarray, wanted: np.ndarray | float) -> bool:
    return bool(np.abs(values - wanted).max(initial=0.0) < _UNIT)


def _is_better(joints: list[int], one: np.ndarray, other: np.ndarray, kind: str) -> bool:
    if kind == _KINDS[4]:
        return _steadiness(joints, one) < _SMALL and _steadiness(joints, other) > _LARGE
    return _bends(joints, one) > _ONE_WAY and _bends(joints, other) < -_ONE_WAY


def _steadiness(joints: list[int], vectors: np.ndarray) -> float:
    """Median turn [rad] of the joints that hardly turn in anyone."""
    chosen = [joints.index(joint) for joint in _STEADY if joint in joints]
    return float(np.median(np.linalg.norm(vectors[:, chosen], axis=2))) if chosen else np.pi


def _bends(joints: list[int], vectors: np.ndarray) -> float:
    """1 where knees and elbows bend as they do, −1 where all bend backwards; near 0 where they are straight or not there."""
    hinges = [(KNEES[0], 0, 1.0), (KNEES[1], 0, 1.0), (ELBOWS[0], 1, -1.0), (ELBOWS[1], 1, 1.0)]
    own = [(joints.index(joint), axis, sign) for joint, axis, sign in hinges if joint in joints]
    bent = sum(sign * vectors[:, place, axis].sum() for place, axis, sign in own)
    turned = sum(np.linalg.norm(vectors[:, place], axis=1).sum() for place, _, _ in own)
    return float(bent / max(turned, _STRAIGHT * len(own) * len(vectors), 1e-9))

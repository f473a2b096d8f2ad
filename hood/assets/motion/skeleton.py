"""The joints of a recorded motion in its file's world, by the skeleton of the embedded body.

Rotations of axis-angle vectors, of any array, and between two of them.

The unit of a translation: the one in which planted feet stand still, or in which the feet are on the floor.

The axes that can point up in a file, and the turn that makes y of each.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hood.assets.files.said import Doubt

#: The turn (3, 3) that makes y of an axis which points up in a file, by the axis. Row 1 is the axis itself; z (AMASS) goes
#: (x, y, z) → (x, z, -y), and -y, of cameras, (x, -y, -z).
UP_AXES = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "x": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "-y": np.diag([1.0, -1.0, -1.0]),
    "-z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-x": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
Z_UP_TO_Y_UP = UP_AXES["z"]


def require_up(up: str) -> None:
    """Raise ValueError unless ``up`` is an axis of :data:`UP_AXES` or "auto"."""
    if up not in (*UP_AXES, "auto"):
        raise ValueError(f"up={up}: give z (AMASS), y, x, -y (cameras), -z, -x or auto, the axis that points up in the file")


def from_vectors(vectors: np.ndarray) -> Rotation:
    """The rotations of vectors (M, 3) or (3,) [rad]. Arrays that cannot be written to, such as broadcast ones, are copied:
    scipy refuses them."""
    return Rotation.from_rotvec(np.require(vectors, np.float64, "W"))


def slerp(turns: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(T, J, 3) rad: axis-angle vectors at the times ``target`` (T,) of those (N, J, 3) at the times ``source`` (N,)."""
    result = np.zeros((len(target), *turns.shape[1:]))
    for joint in range(turns.shape[1]):
        if np.any(turns[:, joint]):
            result[:, joint] = Slerp(source, from_vectors(turns[:, joint]))(target).as_rotvec()
    return result


PELVIS, HEAD = 0, 15
FEET, HANDS = (7, 8, 10, 11), (20, 21, 22, 23)
KNEES, ELBOWS = (4, 5), (18, 19)  # left, right
#: The joint above each joint of SMPL; -1 for the pelvis.
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
#: Time [s] over which speeds are taken.
_SPAN = 0.08
#: (24, 3) m: the joints of the embedded body in its T-pose, y up, z forward. The pelvis of SMPL's own lies 0.3 m lower against
#: its origin: heights against a floor at 0 are known to that.
_REST = np.array([
    [0, 0.097, 0.014], [0.112, 0.081, 0.005], [-0.112, 0.081, 0.005], [0, 0.177, -0.025], [0.146, -0.31, 0.009],
    [-0.146, -0.31, 0.009], [0, 0.248, -0.011], [0.145, -0.745, -0.017], [-0.145, -0.745, -0.017], [0, 0.329, -0.014],
    [0.155, -0.796, 0.125], [-0.155, -0.796, 0.125], [0, 0.641, 0.015], [0.024, 0.565, 0.03], [-0.023, 0.565, 0.03],
    [0, 0.74, 0.049], [0.177, 0.559, 0.024], [-0.177, 0.559, 0.024], [0.438, 0.543, 0], [-0.438, 0.543, 0],
    [0.672, 0.554, -0.006], [-0.672, 0.554, -0.006], [0.773, 0.549, -0.006], [-0.773, 0.549, -0.006],
])  # fmt: skip


def joints_about_pelvis(poses: np.ndarray) -> np.ndarray:
    """(N, 24, 3) m: places of the joints less that of the pelvis, for poses (N, 24, 3) [rad] in the file's world."""
    local = from_vectors(poses.reshape(-1, 3)).as_matrix().reshape(len(poses), len(PARENTS), 3, 3)
    turn, place = local.copy(), np.zeros((len(poses), len(PARENTS), 3))
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            continue
        turn[:, joint] = turn[:, parent] @ local[:, joint]
        place[:, joint] = place[:, parent] + turn[:, parent] @ (_REST[joint] - _REST[parent])
    return place


def upright(joints: np.ndarray) -> np.ndarray:
    """(N, 3): the unit vector from the feet to the head, of joints (N, 24, 3)."""
    along = joints[:, HEAD] - joints[:, FEET].mean(axis=1)
    return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)


def spread(num_frames: int, most: int = 1000) -> np.ndarray:
    """Up to ``most`` frames, evenly over a motion: what most of them show is what most of its frames show."""
    return np.unique(np.linspace(0, num_frames - 1, min(most, num_frames)).round().astype(np.int64))


def some_frames(num_frames: int, fps: float, span: float = _SPAN, most: int = 400) -> tuple[np.ndarray, int]:
    """Up to ``most`` frames spread over a motion, and how many frames later to look again: about ``span`` [s], so that a speed
    is more than noise. None of a single frame."""
    step = min(max(round(span * fps), 1), max(num_frames - 1, 0))
    if step == 0:
        return np.zeros(0, np.int64), 0
    return np.unique(np.linspace(0, num_frames - 1 - step, most).astype(np.int64)), step


#: Metres by unit.
TRANSLATION_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_WORDS = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
#: Planted feet are slower by this factor in the right unit than in every other, where they move at all [m/s] there.
_SLOWER, _MOVES = 0.4, 0.005
#: Times [s] over which speeds are taken: a runner's foot is planted for the first, and estimates are noisy over it.
_SPANS = (0.08, 0.25)
#: The lowest joint is so near to a floor at 0 [m]: pelvis and soles of other bodies lie elsewhere by as much.
_NEAR_FLOOR = 0.35
#: And so far above in metres [m] that no floor is meant: a translation of that height is in another unit.
_FAR = 20.0
#: A person's root moves no faster [m/s]; and a planted foot slides no faster, where it would stand still in another unit.
_FASTEST, _FAST_FEET = 15.0, 0.15
#: Share of the steps that count: recordings that are cut jump in some.
_MOSTLY = 0.9


class Unit(NamedTuple):
    """The unit of a translation; ``note`` is what the user is told: nothing, a fact or a doubt."""

    name: str
    note: UserWarning | None = None
    sure: bool = True  # by the user's word, or tested

    @property
    def metres(self) -> float:
        return TRANSLATION_UNITS[self.name]


def find_unit(path: Path, key: str, poses: np.ndarray, transl: np.ndarray, fps: float, up: str, given: str = "auto") -> Unit:
    """The unit of ``transl`` (N, 3) under ``key`` for a body in ``poses`` (N, 24, 3) [rad].

    Args:
        up: custom of the layout, for heights over a floor at 0.
        given: the user's word, "m", "cm" or "mm"; "auto": metres unless the body's steps or its height say another unit.

    Raises:
        ValueError: another word.
    """
    if given != "auto":
        if given not in TRANSLATION_UNITS:
            raise ValueError(
                f"unit={given}: give {', '.join(TRANSLATION_UNITS)} or auto, the unit of the translation in the file"
            )
        return Unit(given)
    spans = [_feet_speeds(poses, transl, fps, span) for span in _SPANS]
    by_steps = next(filter(None, map(_by_steps, spans)), None)
    speeds, found = spans[0], by_steps or _by_floor(poses, transl)
    if found == "m":
        return Unit("m")
    if found is None and not _is_suspect(speeds, transl, fps):
        return Unit("m", sure=_stands_on_floor(poses, transl, up))
    if found is not None:
        why = "its feet stand still only so" if by_steps else "its feet are on the floor only so"
        said = f"{path}: {key} is in {_WORDS[found]}, {why}; it is taken so (unit=m takes it as metres)"
        return Unit(found, UserWarning(said))
    fastest = float(np.quantile(_root_speed(transl, fps), _MOSTLY)) if len(transl) > 1 else 0.0
    far = np.ptp(transl, axis=0).max()
    said = (
        f"{path}: {key} may not be in metres (the body moves at {fastest:.3g} m/s, {far:.3g} m far), and is taken so; "
        "unit=cm or mm converts it (data.trans_unit in hood train), unit=m says that it is right"
    )
    return Unit("m", Doubt("units", said, value=fastest, unit="m/s"), sure=False)


def _feet_speeds(poses: np.ndarray, transl: np.ndarray, fps: float, span: float) -> dict[str, float]:
    """Median speed [m/s] of the slower foot, by unit of the translation, and without any ("none"); empty for a single frame."""
    first, step = some_frames(len(poses), fps, span)
    if not len(first):
        return {}
    change = joints_about_pelvis(poses[first + step])[:, FEET] - joints_about_pelvis(poses[first])[:, FEET]
    shift = (transl[first + step] - transl[first])[:, None]
    seconds = step / fps
    return {
        name: float(np.median(np.linalg.norm(change + metres * shift, axis=2).min(axis=1))) / seconds
        for name, metres in {**TRANSLATION_UNITS, "none": 0.0}.items()
    }


def _by_steps(speeds: dict[str, float]) -> str | None:
    """The unit in which the planted foot is still, where it moves in all others and if the body were not moved at all: feet
    of somebody who is carried are still in the smallest unit, and tell nothing."""
    if not speeds:
        return None
    best = min(TRANSLATION_UNITS, key=lambda name: speeds[name])
    others = [speed for name, speed in speeds.items() if name != best]
    return best if all(speed > _MOVES and speeds[best] < _SLOWER * speed for speed in others) else None


def _by_floor(poses: np.ndarray, transl: np.ndarray) -> str | None:
    """The unit that puts the feet on a floor at 0, along whichever axis they are mostly the lowest, where metres put them far
    from there."""
    chosen = spread(len(poses), 100)
    joints = joints_about_pelvis(poses[chosen])
    found = set()
    for column in range(3):
        height, lowest = transl[chosen, column], joints[:, :, column].argmin(axis=1)
        if np.isin(lowest, FEET).mean() < _MOSTLY:
            continue
        low = {name: metres * height + joints[:, :, column].min(axis=1) for name, metres in TRANSLATION_UNITS.items()}
        if abs(float(np.median(low["m"]))) < _FAR:
            continue
        found |= {name for name, value in low.items() if np.quantile(np.abs(value), 0.8) < _NEAR_FLOOR}
    return found.pop() if len(found) == 1 else None


def _stands_on_floor(poses: np.ndarray, transl: np.ndarray, up: str) -> bool:
    """Whether the lowest joint is near a floor at 0 with a translation in metres that lifts the pelvis."""
    axis, chosen = UP_AXES[up][1], spread(len(poses), 100)
    height = transl[chosen] @ axis
    low = height + (joints_about_pelvis(poses[chosen]) @ axis).min(axis=1)
    return bool(np.median(np.abs(low)) < _NEAR_FLOOR < np.median(height))


def _is_suspect(speeds: dict[str, float], transl: np.ndarray, fps: float) -> bool:
    """Whether metres are hardly right: the body flies, or its feet are fast although they would not be in another unit."""
    if not speeds:
        return float(np.abs(transl).max()) > 50.0 * _FAR
    flies = float(np.quantile(_root_speed(transl, fps), _MOSTLY)) > _FASTEST
    return flies or (speeds["m"] > _FAST_FEET and speeds["cm"] < _SLOWER * speeds["m"])


def _root_speed(transl: np.ndarray, fps: float) -> np.ndarray:
    return np.linalg.norm(np.diff(transl, axis=0), axis=1) * fps

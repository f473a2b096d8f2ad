"""The unit of a translation: the one in which planted feet stand still, or in which the feet are on the floor."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from hood.assets.files.doubt import Doubt
from hood.assets.motion.axes import UP_AXES
from hood.assets.motion.skeleton import FEET, joints_about_pelvis, some_frames, spread

#: Metres by unit.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
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
        return UNITS[self.name]


def find_unit(path: Path, key: str, poses: np.ndarray, transl: np.ndarray, fps: float, up: str, given: str = "auto") -> Unit:
    """The unit of ``transl`` (N, 3) under ``key`` for a body in ``poses`` (N, 24, 3) [rad].

    Args:
        up: custom of the layout, for heights over a floor at 0.
        given: the user's word, "m", "cm" or "mm"; "auto": metres unless the body's steps or its height say another unit.

    Raises:
        ValueError: another word.
    """
    if given != "auto":
        if given not in UNITS:
            raise ValueError(f"trans_unit={given}: give {', '.join(UNITS)} or auto, the unit of the translation in the file")
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
        said = f"{path}: {key} is in {_WORDS[found]}, {why}; it is taken so (trans_unit=m takes it as metres)"
        return Unit(found, UserWarning(said))
    fastest = float(np.quantile(_root_speed(transl, fps), _MOSTLY)) if len(transl) > 1 else 0.0
    far = np.ptp(transl, axis=0).max()
    said = (
        f"{path}: {key} may not be in metres (the body moves at {fastest:.3g} m/s, {far:.3g} m far), and is taken so; "
        "trans_unit=cm or mm converts it, trans_unit=m says that it is right"
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
        for name, metres in {**UNITS, "none": 0.0}.items()
    }


def _by_steps(speeds: dict[str, float]) -> str | None:
    """The unit in which the planted foot is still, where it moves in all others and if the body were not moved at all: feet
    of somebody who is carried are still in the smallest unit, and tell nothing."""
    if not speeds:
        return None
    best = min(UNITS, key=lambda name: speeds[name])
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
        low = {name: metres * height + joints[:, :, column].min(axis=1) for name, metres in UNITS.items()}
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

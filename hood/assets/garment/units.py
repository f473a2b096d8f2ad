"""The unit of length of a garment file, guessed from its size beside the body."""

from __future__ import annotations

import numpy as np

#: Metres per unit of files, by name.
UNITS = {1.0: "metres", 0.1: "decimetres", 0.0254: "inches", 0.01: "centimetres", 0.001: "millimetres"}
#: Metres per unit of the file that are tried when metres do not fit.
_FACTORS = {0.01: "centimetres", 0.001: "millimetres"}
#: Diagonals taken as they are, in body heights: from a baby's sock to a bridal train.
_POSSIBLE = (0.05, 3.0)
#: Diagonals that other units may give: one decade, from a sock to a wide dress, so that one unit fits at most.
_USUAL = (0.13, 1.3)


def size_ratio(pos: np.ndarray, body_pos: np.ndarray) -> float:
    """Diagonal of the garment's box over the body's largest extent."""
    return float(np.linalg.norm(np.ptp(pos, axis=0)) / max(np.ptp(body_pos, axis=0).max(), 1e-12))


def used(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The vertices (V', 3) that belong to faces: strays say nothing about a garment's size."""
    return pos[np.unique(faces)]


def find_scale(pos: np.ndarray, body_pos: np.ndarray) -> float | None:
    """Factor to metres of a garment ``pos`` (V, 3) made for a body ``body_pos`` (W, 3): 1, 0.01 or 0.001; None: none fits.

    1 whenever the size is possible as it is; where the garment lies plays no role.
    """
    ratio = size_ratio(pos, body_pos)
    if _POSSIBLE[0] <= ratio <= _POSSIBLE[1]:
        return 1.0
    return next((factor for factor in _FACTORS if _USUAL[0] <= ratio * factor < _USUAL[1]), None)


def possible(pos: np.ndarray, body_pos: np.ndarray) -> list[float]:
    """Units in which a garment ``pos`` (V, 3) has a usual size beside ``body_pos`` (W, 3); where none, a possible one."""
    ratio = size_ratio(pos, body_pos)
    usual = [unit for unit in UNITS if _USUAL[0] <= ratio * unit < _USUAL[1]]
    return usual or [unit for unit in UNITS if _POSSIBLE[0] <= ratio * unit <= _POSSIBLE[1]]


def require_metres(pos: np.ndarray, body_pos: np.ndarray, name: str) -> None:
    """Refuse a garment whose size shows that it is not in metres.

    Raises:
        ValueError: naming the units that it may be in, and the command that brings it to metres.
    """
    if find_scale(pos, body_pos) == 1.0:
        return
    size = f"garment {name!r} is {size_ratio(pos, body_pos):.3g} times the body's height"
    fitting = possible(pos, body_pos)
    if not fitting:
        raise ValueError(f"{size}; scale it to metres, hood prepare garment=… scale=FACTOR")
    if len(fitting) > 1:
        units = " or ".join(f"{UNITS[unit]} (scale={unit:g})" for unit in fitting)
        raise ValueError(f"{size}: it may be in {units}; hood prepare garment=… finds out which fits, hood inspect says it")
    (unit,) = fitting
    raise ValueError(
        f"{size}: it is in {UNITS[unit]}; multiply it by {unit:g}, hood prepare garment=… scale={unit:g} (or auto)"
    )

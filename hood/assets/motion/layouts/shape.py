"""The shape of a recorded subject: one row of coefficients, or what rows of every frame have in common."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.doubt import Doubt
from hood.assets.motion.layouts.read import numbers

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

"""Garments that somebody made of arrays: checked like those of files before anything is computed with them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from hood.assets.garment.garment import Garment, check_levels
from hood.assets.garment.garment_arrays import as_arrays, checked_fields
from hood.assets.material import NO_GRADIENT
from hood.mesh.quality import check_triangles
from hood.mesh.riders import Riders

#: Weights of a vertex that sum to one within this stay as they are.
_ROUNDING = 1e-9


def checked_garment(garment: Garment) -> Garment:
    """The garment with its fields as arrays of the types that they are to have; itself where they are that already.

    Lists and tensors are taken as arrays.

    Raises:
        ValueError: no garment, or one that cannot be simulated; names the garment, the field, the index and the fix.
    """
    if not isinstance(garment, Garment):
        raise ValueError(
            f"garment is of type {type(garment).__name__}; give a hood.Garment, such as hood.load_garment('tank') or of a file"
        )
    where = f"garment {str(garment.name)!r}"
    given = {field.name: getattr(garment, field.name) for field in fields(garment)}
    for key in ("rest_pos", "faces", "pinned"):
        if given[key] is None:
            raise ValueError(f"{where}: {key} is None; give rest_pos (V, 3) m, faces (F, 3) and pinned (V,)")
    arrays = {key: _array(where, key, value) for key, value in as_arrays(given).items() if key != "bound_to"}
    found = checked_fields(where, arrays)
    check_triangles(found["rest_pos"], found["faces"], where)
    changed = {key: value for key, value in found.items() if not _same(given[key], value)}
    garment = replace(garment, **changed) if changed else garment
    check_levels(garment, where)
    return garment


def _array(where: str, key: str, value: Any) -> np.ndarray:
    if getattr(value, "requires_grad", False):
        raise ValueError(f"{where}: {key}: {NO_GRADIENT}")
    value = value.detach().cpu() if hasattr(value, "detach") else value  # a tensor
    try:
        array = np.asarray(value)
    except ValueError:
        rows = ", split polygons into triangles first" if key == "faces" else ""
        raise ValueError(f"{where}: rows of {key} differ in length; give an array{rows}") from None
    if array.ndim == 0:
        raise ValueError(f"{where}: {key} is of type {type(value).__name__}; give an array")
    return array


def _same(given: Any, checked: Any) -> bool:
    """Whether a field is what it was checked to be."""
    if isinstance(checked, Mapping):
        return isinstance(given, Mapping) and all(_same(given[key], value) for key, value in checked.items())
    if isinstance(checked, Riders):
        tables = {name: table for name, table in vars(checked).items() if table is not None}
        return isinstance(given, Riders) and all(_same(getattr(given, name), table) for name, table in tables.items())
    if isinstance(checked, tuple):
        return isinstance(given, tuple) and all(map(_same, given, checked))
    if not isinstance(given, np.ndarray) or given.dtype != checked.dtype:
        return False
    return bool(np.allclose(given, checked, rtol=0.0, atol=_ROUNDING))

"""Garments in the files of the reference implementation: ``garments_dict.pkl`` with many by name, a template with one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.guarded import listed
from hood.assets.files.library import unknown
from hood.assets.garment.garment_arrays import check_rows, normalised
from hood.assets.pickles.records import load_pickle

#: Value of ``node_type`` of vertices that are held: they move with the body.
_HANDLE = 3
_SIZE_LIMIT = 2 << 30


def read_reference_garment(path: Path, name: str | None) -> dict[str, Any]:
    """Arguments of :class:`hood.assets.garment.garment.Garment` from a pickle of the reference implementation.

    ``rest_pos`` is the rest shape; ``lbs.v`` the same garment in the body's T-pose, with its weights and shape offsets.
    Pose blend offsets are passed over. Coarse edges are kept, of their first centre.

    Args:
        name: which garment of a ``garments_dict.pkl``; None where the file holds one.

    Raises:
        ValueError: refused or damaged pickle, unknown or missing name, fields that do not fit; names file and field.
    """
    content = load_pickle(path, _SIZE_LIMIT)
    if not isinstance(content, Mapping):
        raise ValueError(f"{path}: holds {type(content).__name__}; a garment file holds a dictionary")
    if "faces" in content and ("vertices" in content or "rest_pos" in content):
        if name is not None and name != path.stem:
            raise ValueError(f"{path}: holds one garment without a name; drop ':{name}'")
        return _fields(str(path), path.stem, content)
    entries = {str(key): value for key, value in content.items() if isinstance(value, Mapping) and "faces" in value}
    if not entries:
        raise ValueError(f"{path}: not a garment file: no 'rest_pos' or 'vertices' with 'faces' (found {_keys(content)})")
    if name is None and len(entries) > 1:
        raise ValueError(f"{path}: holds {len(entries)} garments; choose one, {path.name}:{min(entries)} ({_keys(entries)})")
    chosen = next(iter(entries)) if name is None else name
    if chosen not in entries:
        raise ValueError(f"{path}: {unknown('garment', chosen, sorted(entries))}")
    return _fields(f"{path}: garment {chosen!r}", chosen, entries[chosen])


def garment_names(content: Any) -> list[str]:
    """Names of the garments in the content of a ``garments_dict.pkl``; empty for anything else."""
    if not isinstance(content, Mapping) or "faces" in content:
        return []
    return sorted(str(key) for key, value in content.items() if isinstance(value, Mapping) and "faces" in value)


def _keys(content: Mapping[Any, Any]) -> str:
    return listed(sorted(map(str, content)))


def _fields(where: str, name: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    rest_pos = _table(where, "rest_pos", entry.get("rest_pos", entry.get("vertices")))
    num_vertices = len(rest_pos)
    faces = _table(where, "faces", entry["faces"])
    if not (faces == np.floor(faces)).all():
        raise ValueError(f"{where}: faces are not whole numbers; they must be vertex indices")
    fields: dict[str, Any] = {"name": name, "rest_pos": rest_pos, "faces": faces.astype(np.int64)}
    fields["pinned"] = np.zeros(num_vertices, dtype=bool)
    if entry.get("node_type") is not None:
        kinds = _reals(where, "node_type", entry["node_type"]).reshape(-1)
        check_rows(where, "pinned", kinds, num_vertices)
        fields["pinned"] = kinds == _HANDLE
    if isinstance(entry.get("lbs"), Mapping):
        fields |= _skin(where, entry["lbs"], num_vertices)
    levels = _first_centre(entry.get("coarse_edges"))
    if levels:
        tables = [_reals(where, "coarse_edges", level).astype(np.int64) for level in levels]
        if any(table.size % 2 for table in tables):
            raise ValueError(f"{where}: coarse_edges are not pairs of vertices; remove them from the file")
        fields["coarse_edges"] = tuple(table.reshape(-1, 2) for table in tables)
    return fields


def _skin(where: str, lbs: Mapping[str, Any], num_vertices: int) -> dict[str, Any]:
    names = {"v": "skin_pos", "shapedirs": "shapedirs", "lbs_weights": "lbs_weights"}
    fields = {ours: _reals(where, f"lbs.{key}", lbs[key]) for key, ours in names.items() if lbs.get(key) is not None}
    for key, value in fields.items():
        check_rows(where, key, value, num_vertices)
    if "lbs_weights" in fields:
        fields["lbs_weights"] = normalised(where, fields["lbs_weights"])
    return fields


def _first_centre(levels: Any) -> list[Any]:
    """Coarse edges by ascending level, of the first graph centre where the file lists several."""
    if not isinstance(levels, Mapping):
        return list(levels) if isinstance(levels, (list, tuple)) else []
    entries = [levels[key] for key in sorted(levels, key=str)]
    return _first_centre(entries[0]) if entries and isinstance(entries[0], Mapping) else entries


def _reals(where: str, key: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{where}: {key} is {array.dtype}; it must hold numbers")
    return array.astype(np.float64)


def _table(where: str, key: str, value: Any) -> np.ndarray:
    array = _reals(where, key, value)
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise ValueError(f"{where}: {key} has shape {array.shape}; it must be (n, 3) of finite numbers")
    return array

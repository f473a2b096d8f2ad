"""The fields of a garment ``.npz``: read and checked, and written whole."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.assets.files.guarded import check_size
from hood.assets.files.library import DATA_FOLDER, read_arrays
from hood.mesh.flat import no_triangles
from hood.mesh.parts import Riders

#: Per-vertex fields and the shape of a row; None: any size.
_ROWS: dict[str, tuple[int | None, ...]] = {
    "pinned": (),
    "lbs_weights": (None,),
    "shapedirs": (3, None),
    "skin_pos": (3,),
    "rest_turn": (3, 3),
    "colours": (3,),
    "piece": (),
    "region": (),
    "stiffness": (),
    "thickness": (),
}
_CORNERS = ("uv_faces", "normal_faces")
#: Numbers of the sides of faces, what they must be, and the test of it.
_SIDES: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "elastic": ("a share above 0, 1 for plain cloth", lambda value: np.isfinite(value) & (value > 0.0)),
    "fold": ("an angle between -π and π, NaN for no fold", lambda value: np.isnan(value) | (np.abs(value) < np.pi)),
    "bending": ("a factor above 0, 1 for plain cloth", lambda value: np.isfinite(value) & (value > 0.0)),
}
_LEVEL = "coarse_edges_"
_FASTENER = "fastener_"
_PANEL = "panel_"
_RIDER = "rider_"
_NAMES = "piece_names"
#: Tables of riders and their columns; 0: none.
_RIDERS = {"pos": 3, "faces": 3, "group": 0, "anchors": 0, "anchor_group": 0}
_SIZE_LIMIT = 2 << 30


def read_fields(path: Path) -> dict[str, Any]:
    """Arguments of :class:`hood.assets.garment.garment.Garment` from a garment ``.npz``; the name only where the file has names
    for the garments of an outfit.

    Raises:
        ValueError: a field that does not fit the others; names the file, the field and its first bad row.
    """
    check_size(path, _SIZE_LIMIT)
    arrays = read_arrays(path, ("rest_pos", "faces"), "garment")
    fields = checked_fields(str(path), arrays)
    if path.is_relative_to(DATA_FOLDER):
        fields["bound_to"] = "default"
    elif "bound_to" in arrays and arrays["bound_to"].dtype.kind == "U" and arrays["bound_to"].size == 1:
        fields["bound_to"] = str(arrays["bound_to"].reshape(-1)[0])
    names = arrays.get(_NAMES)
    if (
        names is not None
        and names.dtype.kind == "U"
        and "piece" in fields
        and len(names) == fields["piece"].max(initial=-1) + 1
    ):
        fields["name"] = "+".join(names.tolist())
    return fields


def checked_fields(where: str, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Arguments of a garment from its arrays by the names that they have in a file, see :func:`as_arrays`.

    Raises:
        ValueError: a field that does not fit the others; names ``where``, the field and its first bad row.
    """
    fields: dict[str, Any] = {
        "rest_pos": _reals(where, "rest_pos", arrays["rest_pos"]),
        "faces": _indices(where, "faces", arrays["faces"]),
    }
    if fields["rest_pos"].ndim != 2 or fields["rest_pos"].shape[1] != 3:
        raise ValueError(f"{where}: rest_pos has shape {fields['rest_pos'].shape}; give (num_vertices, 3)")
    num_vertices = len(fields["rest_pos"])
    for key in _ROWS:
        if key in arrays:
            fields[key] = _reals(where, key, arrays[key])
            check_rows(where, key, fields[key], num_vertices)
    fields["pinned"] = fields.get("pinned", np.zeros(num_vertices)).astype(bool)
    _check_stiffness(where, fields.get("stiffness"))
    for key in ("piece", "region"):
        if key in fields:
            fields[key] = fields[key].astype(np.int64)
    if "lbs_weights" in fields:
        fields["lbs_weights"] = normalised(where, fields["lbs_weights"])
    if "uv" in arrays and "uv_faces" in arrays:
        fields["uv"] = _finite(where, "uv", _reals(where, "uv", arrays["uv"]))
    for key in _CORNERS:
        if key in arrays and (key != "uv_faces" or "uv" in fields):
            fields[key] = _corner_table(where, key, arrays[key], fields)
    if "flat" in arrays:
        fields["flat"] = _flat(where, _spread_flat(where, arrays["flat"], fields), len(fields["faces"]))
    for key in _SIDES:
        if key in arrays:
            fields[key] = _sides(where, key, arrays[key], fields)
    levels = sorted((key for key in arrays if key.startswith(_LEVEL)), key=lambda key: (len(key), key))
    if levels:
        fields["coarse_edges"] = tuple(_edge_table(where, key, arrays[key]) for key in levels)
    rows = sorted(key for key in arrays if key.startswith(_FASTENER))
    if rows:
        fields["fasteners"] = {key[len(_FASTENER) :]: _edge_table(where, key, arrays[key], "fasteners") for key in rows}
        check_fasteners(where, fields["fasteners"], num_vertices)
    if f"{_RIDER}pos" in arrays:
        fields["riders"] = _riders(where, arrays, num_vertices, len(fields.get("uv", ())))
    panels = [key for key in arrays if key.startswith(_PANEL)]
    if panels:
        fields["panels"] = {key[len(_PANEL) :]: _panel(where, key, arrays[key], len(fields["faces"])) for key in panels}
    return fields


def as_arrays(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a garment by the names that they have in a file; those that are None and the name are left out."""
    tables = ("name", "coarse_edges", "fasteners", "panels", "riders", "file_numbers")
    arrays = {key: value for key, value in fields.items() if value is not None and key not in tables}
    for level, edges in enumerate(fields.get("coarse_edges") or ()):
        arrays[f"{_LEVEL}{level}"] = edges
    for name, pairs in (fields.get("fasteners") or {}).items():
        arrays[f"{_FASTENER}{name}"] = pairs
    for name, mask in (fields.get("panels") or {}).items():
        arrays[f"{_PANEL}{name}"] = mask
    if fields.get("riders") is not None:
        arrays |= {f"{_RIDER}{name}": table for name, table in vars(fields["riders"]).items() if table is not None}
    return arrays


def write_fields(path: Path, fields: dict[str, Any]) -> None:
    """Write a garment ``.npz`` that :func:`read_fields` reads back; fields that are None are left out."""
    content, arrays = io.BytesIO(), as_arrays(fields)
    names, piece = str(fields["name"]).split("+"), fields.get("piece")
    if piece is not None and len(names) == piece.max(initial=-1) + 1:
        arrays[_NAMES] = np.array(names)
    np.savez_compressed(content, **arrays)
    write_atomically(path, content.getvalue())


def check_rows(where: str, key: str, value: np.ndarray, num_vertices: int) -> None:
    """Raise ValueError unless ``value`` has one finite row of the field's shape per vertex."""
    if value.ndim == 0 or len(value) != num_vertices:
        count = len(value) if value.ndim else 0
        raise ValueError(f"{where}: {key} has {count} rows for {num_vertices} vertices; write one row per vertex")
    shape = _ROWS[key]
    if value.ndim != 1 + len(shape) or any(want not in (None, have) for want, have in zip(shape, value.shape[1:], strict=True)):
        expected = ", ".join(["V", *("n" if size is None else str(size) for size in shape)])
        raise ValueError(f"{where}: {key} has shape {value.shape}; it must be ({expected})")
    finite = np.isfinite(value).reshape(num_vertices, -1).all(axis=1)
    if not finite.all():
        raise ValueError(f"{where}: {key} of vertex {int(np.argmin(finite))} is not finite; repair it")


def check_fasteners(where: str, fasteners: Mapping[str, np.ndarray], num_vertices: int) -> None:
    """Raise ValueError unless every row of pairs (P, 2) has some, of two different vertices that there are."""
    for name, pairs in fasteners.items():
        if len(pairs) == 0:
            raise ValueError(f"{where}: fastener {name!r} has no pairs; give at least one pair of vertices, or leave it out")
        wrong = ((pairs < 0) | (pairs >= num_vertices)).any(axis=1) | (pairs[:, 0] == pairs[:, 1])
        if wrong.any():
            row = int(np.argmax(wrong))
            raise ValueError(
                f"{where}: pair {row} of fastener {name!r} is {pairs[row].tolist()}; give two different vertices below "
                f"{num_vertices}"
            )


def _finite(where: str, key: str, value: np.ndarray) -> np.ndarray:
    if not np.isfinite(value).all():
        row = int(np.argwhere(~np.isfinite(value))[0][0])
        raise ValueError(f"{where}: {key} has row {row}, which is not finite; repair it, or leave {key} out")
    return value


def _check_stiffness(where: str, stiffness: np.ndarray | None) -> None:
    if stiffness is not None and not (stiffness > 0).all():
        vertex = int(np.argmin(stiffness > 0))
        raise ValueError(
            f"{where}: stiffness of vertex {vertex} is {stiffness[vertex]}; give a factor above 0, 1 for plain cloth"
        )


def normalised(where: str, weights: np.ndarray) -> np.ndarray:
    """Skinning weights (V, J) with rows that sum to one.

    Raises:
        ValueError: a row that sums to zero or less.
    """
    total = weights.sum(axis=1, keepdims=True)
    if not (total > 0).all():
        raise ValueError(f"{where}: lbs_weights of vertex {int(np.argmin(total[:, 0] > 0))} sum to zero; repair them")
    return np.asarray(weights / total)


def _reals(where: str, key: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{where}: {key} is {array.dtype}; it must hold numbers")
    return array.astype(np.float64)


def _indices(where: str, key: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.size and not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{where}: {key} are {array.dtype}; they must be integer vertex indices")
    return array.astype(np.int64)


def _edge_table(where: str, key: str, value: Any, what: str = "coarse edges") -> np.ndarray:
    table = _indices(where, key, value)
    if table.ndim != 2 or table.shape[1] != 2:
        raise ValueError(f"{where}: {key} has shape {table.shape}; {what} are pairs of vertices (n, 2)")
    return table


def _riders(where: str, arrays: Mapping[str, np.ndarray], num_vertices: int, num_uv: int) -> Riders:
    """What rides on the cloth, with every index in range."""
    tables: dict[str, Any] = {}
    for name, width in _RIDERS.items():
        key = f"{_RIDER}{name}"
        if key not in arrays:
            raise ValueError(f"{where}: has {_RIDER}pos and no {key}; write both, or leave out all of {_RIDER}…")
        value = arrays[key]
        tables[name] = _finite(where, key, _reals(where, key, value)) if name == "pos" else _indices(where, key, value)
        if tables[name].ndim != (2 if width else 1) or (width and tables[name].shape[1] != width):
            shape = f"(n, {width})" if width else "(n,)"
            raise ValueError(f"{where}: {key} has shape {tables[name].shape}; it must be {shape}")
    if f"{_RIDER}uv_faces" in arrays and num_uv:
        tables["uv_faces"] = _indices(where, f"{_RIDER}uv_faces", arrays[f"{_RIDER}uv_faces"])
    _check_riders(where, tables, num_vertices, num_uv)
    return Riders(**tables)


def _check_riders(where: str, tables: Mapping[str, np.ndarray], num_vertices: int, num_uv: int) -> None:
    count, groups = len(tables["pos"]), int(tables["group"].max(initial=-1)) + 1
    limits = {"faces": count, "group": count, "anchors": num_vertices, "anchor_group": groups, "uv_faces": num_uv}
    for name, limit in limits.items():
        table = tables.get(name, np.zeros(0, dtype=np.int64))
        if table.min(initial=0) < 0 or table.max(initial=-1) >= limit:
            raise ValueError(f"{where}: {_RIDER}{name} holds {int(table.max(initial=0))}; give numbers from 0 to {limit - 1}")
    one_each = len(tables["group"]) == count and len(tables["anchors"]) == len(tables["anchor_group"])
    textured = "uv_faces" not in tables or tables["uv_faces"].shape == tables["faces"].shape
    if not (one_each and textured and len(np.unique(tables["anchor_group"])) == groups):
        raise ValueError(
            f"{where}: the tables {_RIDER}… do not fit each other; write a group for every rider, and anchors for every group"
        )


def _panel(where: str, key: str, value: Any, num_faces: int) -> np.ndarray:
    mask = np.asarray(value)
    if mask.dtype.kind != "b" or mask.shape != (num_faces,):
        raise ValueError(f"{where}: {key} is {mask.dtype} {mask.shape}; give one bool a face, ({num_faces},)")
    return mask


def _spread_flat(where: str, value: Any, fields: Mapping[str, Any]) -> Any:
    """Corners in the flat pattern; a single true says that the texture coordinates are they, in metres."""
    array = np.asarray(value)
    if array.dtype.kind != "b" or array.shape != ():
        return array
    if not array:
        raise ValueError(f"{where}: flat is false; give true where uv are metres of the flat pattern, or leave it out")
    if "uv_faces" not in fields:
        raise ValueError(f"{where}: flat is true without uv and uv_faces; write both, or leave flat out")
    return fields["uv"][fields["uv_faces"]]


def _flat(where: str, value: Any, num_faces: int) -> np.ndarray:
    """Corners of the faces in the flat pattern: all of a face or none, and an area."""
    flat = _reals(where, "flat", value)
    if flat.shape != (num_faces, 3, 2):
        raise ValueError(f"{where}: flat has shape {flat.shape}; give metres of every face's corners, ({num_faces}, 3, 2)")
    known = np.isfinite(flat).all(axis=(1, 2))
    area = np.abs(np.linalg.det(flat[:, 1:] - flat[:, :1]))
    bad = np.where(known, area <= 0.0, ~np.isnan(flat).all(axis=(1, 2)))
    if bad.any():
        raise ValueError(f"{where}: flat of face {int(bad.argmax())} is no triangle; repair it, or leave flat out")
    return flat


def _sides(where: str, key: str, value: Any, fields: Mapping[str, Any]) -> np.ndarray:
    """A number for every side of the faces."""
    table, faces, (rule, fits) = _reals(where, key, value), fields["faces"], _SIDES[key]
    if table.shape != faces.shape:
        raise ValueError(f"{where}: {key} has shape {table.shape}; give a number for every side of the faces, {faces.shape}")
    good = fits(table).all(axis=1)
    if good.all() and key == "elastic":
        rule, corners = "shares with which its sides still make a triangle", fields["rest_pos"][faces]
        lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2)
        if "flat" in fields:
            cut = np.roll(fields["flat"], -1, axis=1) - np.roll(fields["flat"], -2, axis=1)
            lengths = np.where(np.isnan(cut).any(axis=2), lengths, np.linalg.norm(cut, axis=2))
        good = ~no_triangles(table * lengths) | (table == 1.0).all(axis=1)
    if not good.all():
        face = int(np.argmin(good))
        raise ValueError(f"{where}: {key} of face {face} is {table[face].tolist()}; give {rule}, or leave {key} out")
    return table


def _corner_table(where: str, key: str, value: Any, fields: dict[str, Any]) -> np.ndarray:
    table = _indices(where, key, value)
    size = len(fields["uv"]) if key == "uv_faces" else table.max(initial=0) + 1
    if table.shape != fields["faces"].shape or (table < 0).any() or (table >= size).any():
        raise ValueError(f"{where}: {key} does not fit faces and uv; give one index per corner, or leave it out")
    return table

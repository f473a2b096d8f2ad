"""Stanford PLY: ASCII and binary of either byte order, polygons of any size, colours and texture coordinates."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.text import decoded_text_file
from hood.assets.formats.raw_mesh import RawMesh, Unreadable, unit_colours

_TYPES = {
    **{name: code for names, code in (
        (("char", "int8"), "i1"), (("uchar", "uint8"), "u1"), (("short", "int16"), "i2"), (("ushort", "uint16"), "u2"),
        (("int", "int32"), "i4"), (("uint", "uint32"), "u4"), (("float", "float32"), "f4"), (("double", "float64"), "f8"),
    ) for name in names}
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_HEAD_LIMIT = 1 << 16


@dataclass
class _Element:
    name: str
    count: int
    #: (name, value type, type of the length or None)
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)


#: Content of an element: a column per scalar property; (values, lengths) per list property.
_Columns = dict[str, np.ndarray | tuple[np.ndarray, np.ndarray]]


def read_ply(path: Path) -> RawMesh:
    """Vertices and faces of the file; other elements are passed over.

    Raises:
        Unreadable: a broken head, more rows announced than the file holds, or no vertices or faces.
    """
    content = _as_ascii(path.read_bytes())
    order, elements, body = _head(content)
    columns: dict[str, _Columns] = {}
    reader = _Ascii(content[body:]) if order is None else _Binary(content, body, order)
    for element in elements:
        columns[element.name] = reader.read(element)
    for name in ("vertex", "face"):
        if name not in columns:
            raise Unreadable(f"PLY without the element {name!r}")
    mesh = _mesh(columns["vertex"], columns["face"])
    ends = _scalars(columns.get("edge", {}), ("vertex1", "vertex2"))
    mesh.stitches = None if ends is None or not len(ends) else ends.astype(np.int64)
    return mesh


def _as_ascii(content: bytes) -> bytes:
    """The file as the format has it, in ASCII: a byte-order mark, and text of two bytes a letter, are other programs' doing."""
    if content.startswith(b"ply"):
        return content
    text = decoded_text_file(content)
    return text.encode("latin-1", errors="replace") if text.startswith("ply") else content


def _head(content: bytes) -> tuple[str | None, list[_Element], int]:
    match = re.search(rb"\bend_header[ \t]*\r?\n", content[:_HEAD_LIMIT])
    if not content.startswith(b"ply") or match is None:
        raise Unreadable("not a PLY file: it does not start with 'ply' … 'end_header'")
    order: str | None = None
    elements: list[_Element] = []
    for line in content[: match.start()].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            if words[1] != "ascii" and words[1] not in _ORDERS:
                raise Unreadable(f"PLY format {words[1]!r} is not known; use ascii or {' or '.join(_ORDERS)}")
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            elements.append(_Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            elements[-1].properties.append(_property(words[1:]))
        elif words and words[0] not in ("comment", "obj_info", "ply"):
            raise Unreadable(f"PLY head: line {line.strip()[:60]!r} is not readable")
    return order, elements, match.end()


def _property(words: list[str]) -> tuple[str, str, str | None]:
    types = words[1:3] if words[:1] == ["list"] else words[:1]
    if len(words) != len(types) + (2 if words[:1] == ["list"] else 1) or any(kind not in _TYPES for kind in types):
        raise Unreadable(f"PLY head: property {' '.join(words)[:60]!r} is not readable")
    codes = [_TYPES[kind] for kind in types]
    return (words[-1], codes[1], codes[0]) if len(codes) == 2 else (words[-1], codes[0], None)


class _Binary:
    """Reads elements one after the other; equally long rows at once."""

    def __init__(self, content: bytes, start: int, order: str) -> None:
        self._content, self._at, self._order = content, start, order

    def read(self, element: _Element) -> _Columns:
        lists = [p for p in element.properties if p[2] is not None]
        if not lists or element.count == 0:
            return self._uniform(element, {})
        # Most files hold triangles only: rows of the first row's length, checked afterwards.
        start = self._at
        lengths = self._first_lengths(element)
        try:
            columns = self._uniform(element, lengths)
        except Unreadable:
            columns = None
        if columns is not None and all((columns[name][1] == lengths[name]).all() for name, _, _ in lists):
            return columns
        self._at = start
        return self._one_by_one(element)

    def _dtype(self, kind: str) -> np.dtype:
        return np.dtype(self._order + kind)

    def _value(self, kind: str) -> int | float:
        dtype = self._dtype(kind)
        if self._at + dtype.itemsize > len(self._content):
            raise Unreadable("PLY ends before the rows it announces")
        value = np.frombuffer(self._content, dtype, 1, self._at)[0]
        self._at += dtype.itemsize
        return value.item()

    def _length(self, kind: str) -> int:
        length = int(self._value(kind))
        if length < 0 or self._at + length > len(self._content):
            raise Unreadable(f"PLY: a list of {length} entries does not fit into the file")
        return length

    def _first_lengths(self, element: _Element) -> dict[str, int]:
        start, lengths = self._at, {}
        for name, kind, length_kind in element.properties:
            if length_kind is not None:
                lengths[name] = self._length(length_kind)
                self._at += lengths[name] * self._dtype(kind).itemsize
            else:
                self._at += self._dtype(kind).itemsize
        self._at = start
        return lengths

    def _uniform(self, element: _Element, lengths: dict[str, int]) -> _Columns:
        fields: list[Any] = []
        for index, (name, kind, length_kind) in enumerate(element.properties):
            if length_kind is not None:
                fields.append((f"length{index}", self._dtype(length_kind), ()))
                fields.append((f"value{index}", self._dtype(kind), (lengths.get(name, 0),)))
            else:
                fields.append((f"value{index}", self._dtype(kind), ()))
        row = np.dtype(fields)
        if element.count * row.itemsize > len(self._content) - self._at:
            raise Unreadable(f"PLY announces {element.count} {element.name} rows and ends before them")
        table = np.frombuffer(self._content, row, element.count, self._at) if row.itemsize else np.zeros(0, row)
        self._at += element.count * row.itemsize
        columns: _Columns = {}
        for index, (name, _, length_kind) in enumerate(element.properties):
            values = table[f"value{index}"]
            if length_kind is None:
                columns[name] = values.astype(values.dtype.newbyteorder("="))
            else:
                columns[name] = values.reshape(-1), table[f"length{index}"].astype(np.int64)
        return columns

    def _one_by_one(self, element: _Element) -> _Columns:
        scalars: dict[str, list] = {name: [] for name, _, length in element.properties if length is None}
        values: dict[str, list] = {name: [] for name, _, length in element.properties if length is not None}
        lengths: dict[str, list] = {name: [] for name in values}
        for _ in range(element.count):
            for name, kind, length_kind in element.properties:
                if length_kind is None:
                    scalars[name].append(self._value(kind))
                    continue
                length, dtype = self._length(length_kind), self._dtype(kind)
                if self._at + length * dtype.itemsize > len(self._content):
                    raise Unreadable("PLY ends before the rows it announces")
                values[name].append(np.frombuffer(self._content, dtype, length, self._at))
                lengths[name].append(length)
                self._at += length * dtype.itemsize
        columns: _Columns = {name: np.array(column) for name, column in scalars.items()}
        for name, column in values.items():
            columns[name] = np.concatenate(column), np.array(lengths[name], dtype=np.int64)
        return columns


class _Ascii:
    """Reads elements one after the other, word by word: line ends have no meaning in the format's numbers."""

    def __init__(self, content: bytes) -> None:
        try:
            self._words = np.array(content.split(), dtype=np.float64)
        except ValueError as error:
            raise Unreadable(f"PLY: {error}") from None
        self._at = 0

    def _take(self, count: int) -> np.ndarray:
        if count < 0 or self._at + count > len(self._words):
            raise Unreadable("PLY ends before the rows it announces")
        taken = self._words[self._at : self._at + count]
        self._at += count
        return taken

    def read(self, element: _Element) -> _Columns:
        names = [name for name, _, _ in element.properties]
        if all(length is None for _, _, length in element.properties):
            table = self._take(element.count * len(names)).reshape(element.count, len(names))
            kinds = [np.dtype(kind) for _, kind, _ in element.properties]
            return {name: _cast(table[:, k], kinds[k]) for k, name in enumerate(names)}
        if element.count > len(self._words):
            raise Unreadable(f"PLY announces {element.count} {element.name} rows and ends before them")
        cells: dict[str, list[np.ndarray]] = {name: [] for name in names}
        for _ in range(element.count):
            for name, _, length_kind in element.properties:
                cells[name].append(self._take(1 if length_kind is None else int(self._take(1)[0])))
        columns: _Columns = {}
        for name, kind, length_kind in element.properties:
            flat = _cast(np.concatenate(cells[name]) if cells[name] else np.zeros(0), np.dtype(kind))
            lengths = np.array([len(cell) for cell in cells[name]], dtype=np.int64)
            columns[name] = flat if length_kind is None else (flat, lengths)
        return columns


def _cast(values: np.ndarray, kind: np.dtype) -> np.ndarray:
    if np.issubdtype(kind, np.integer) and len(values):
        limit = np.iinfo(kind)
        if not ((values >= limit.min) & (values <= limit.max)).all():
            raise Unreadable(f"PLY: a value does not fit its type {kind}")
    return values.astype(kind)


def _mesh(vertex: _Columns, face: _Columns) -> RawMesh:
    pos = _scalars(vertex, ("x", "y", "z"))
    table = face.get("vertex_indices", face.get("vertex_index"))
    if pos is None or not isinstance(table, tuple):
        raise Unreadable("PLY without x, y, z of the vertices or without the list vertex_indices of the faces")
    corners = table[0].astype(np.int64)
    mesh = RawMesh(pos.astype(np.float64), corners, table[1])
    for names in (("red", "green", "blue"), ("r", "g", "b")):
        colours = _scalars(vertex, names)
        if colours is not None:
            mesh.colours = unit_colours(colours)
    normals = _scalars(vertex, ("nx", "ny", "nz"))
    if normals is not None:
        mesh.normals, mesh.normal_corners = normals.astype(np.float64), corners
    for pair in (("s", "t"), ("u", "v"), ("texture_u", "texture_v")):
        uv = _scalars(vertex, pair)
        if uv is not None:
            mesh.uv, mesh.uv_corners = uv.astype(np.float64), corners
    texcoord = face.get("texcoord")
    if isinstance(texcoord, tuple) and (texcoord[1] == 2 * table[1]).all():
        mesh.uv, mesh.uv_corners = texcoord[0].astype(np.float64).reshape(-1, 2), np.arange(len(corners))
    return mesh


def _scalars(columns: _Columns, names: tuple[str, ...]) -> np.ndarray | None:
    """The named scalar columns side by side; None where one is missing."""
    found = [columns.get(name) for name in names]
    if any(not isinstance(column, np.ndarray) for column in found):
        return None
    return np.stack([column for column in found if isinstance(column, np.ndarray)], axis=1)

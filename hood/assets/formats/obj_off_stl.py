"""Wavefront OBJ: positions, polygons and their names, texture coordinates, normals, and colours that some programs add.

OFF and STL files, which have positions and polygons alone.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hood.assets.files.text import decoded_text_file, read_text
from hood.assets.formats.raw_mesh import RawMesh, Unreadable, named_polygons, unit_colours

#: Lines that name the polygons after them, and names that programs write for none.
_NAMED, _NAMELESS = ("o", "g", "usemtl"), ("", "default", "off", "None", "(null)")
_NEW_LINE = re.compile(r"\r\n|\n|\r")
_STL_HEAD = 84
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_obj(path: Path) -> RawMesh:
    """The polygons of all objects and groups of the file, whose names become panels; lines become stitches, points are passed
    over.

    Raises:
        Unreadable: a line that is not numbers, or an index out of range.
    """
    tables: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    corners: list[tuple[int, int, int]] = []
    counts: list[int] = []
    stitches: list[tuple[int, int]] = []
    names = _Names()
    # Not splitlines(), which also splits at signs that a name may hold.
    for number, line in enumerate(_NEW_LINE.split(read_text(path)), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            if words[0] in tables:
                tables[words[0]].append([float(word) for word in words[1:8]])
            elif words[0] == "f":
                sizes = [len(tables[key]) for key in ("v", "vt", "vn")]
                corners.extend(_corner(word, sizes) for word in words[1:])
                counts.append(len(words) - 1)
                names.add_polygon()
            elif words[0] == "l":
                ends = [_corner(word, [len(tables["v"]), len(tables["vt"]), 0])[0] for word in words[1:]]
                stitches.extend(zip(ends, ends[1:], strict=False))
            elif words[0] in _NAMED:
                names.change(words[0], words[1:])
        except ValueError:
            raise Unreadable(
                f"line {number} is not readable ({line.strip()[:60]!r}); behind {words[0]} stand numbers alone, repair or "
                f"remove the line"
            ) from None
    pos, colours = _positions(tables["v"])
    table = np.array(corners, dtype=np.int64).reshape(-1, 3)
    mesh = RawMesh(pos, table[:, 0], np.array(counts, dtype=np.int64), colours)
    mesh.stitches = np.array(stitches, dtype=np.int64).reshape(-1, 2) if stitches else None
    mesh.panels, notes = names.panels()
    mesh.notes.extend(notes)
    if tables["vt"] and (table[:, 1] >= 0).any():
        mesh.uv, mesh.uv_corners = _table(tables["vt"], "vt", 2), table[:, 1]
    if tables["vn"] and (table[:, 2] >= 0).any():
        mesh.normals, mesh.normal_corners = _table(tables["vn"], "vn", 3), table[:, 2]
    return mesh


class _Names:
    """Which objects, groups and materials each polygon of a file is of, while it is read."""

    def __init__(self) -> None:
        self._now: dict[str, tuple[str, ...]] = {}
        self._places: dict[tuple[str, ...], int] = {(): 0}
        self._place = 0
        self._of_polygons: list[int] = []

    def change(self, kind: str, words: list[str]) -> None:
        """The polygons that follow are of another object, of other groups or of another material."""
        given = words if kind == "g" else [" ".join(words)]
        self._now[kind] = tuple(name for name in given if name not in _NAMELESS)
        combination = tuple(name for names in self._now.values() for name in names)
        self._place = self._places.setdefault(combination, len(self._places))

    def add_polygon(self) -> None:
        self._of_polygons.append(self._place)

    def panels(self) -> tuple[dict[str, np.ndarray] | None, list[str]]:
        """See :func:`named_polygons`."""
        return named_polygons(list(self._places), np.array(self._of_polygons, dtype=np.int64))


def _corner(word: str, sizes: list[int]) -> tuple[int, int, int]:
    """Indices from 0 of position, texture coordinate and normal; -1 where there is none.

    Negative indices count back from the last entry so far. 0 does not exist in the format; it and others out of range
    become numbers that no table has, to be refused by the face they are in.
    """
    parts = word.split("/")
    index = [0 if text == "" else int(text) for text in (*parts, "", "")[:3]]
    place = [size + i if i < 0 else i - 1 for i, size in zip(index, sizes, strict=True)]
    for k in (1, 2):
        if k < len(parts) and parts[k] and place[k] < 0:
            place[k] = sizes[k] + abs(index[k])
    return place[0], place[1], place[2]


def _positions(rows: list[list[float]]) -> tuple[np.ndarray, np.ndarray | None]:
    for index, row in enumerate(rows):
        if len(row) < 3:
            raise Unreadable(f"vertex {index} has {len(row)} coordinates; give three")
    pos = np.array([row[:3] for row in rows], dtype=np.float64).reshape(-1, 3)
    if rows and all(len(row) >= 6 for row in rows):
        return pos, unit_colours(np.array([row[3:6] for row in rows]))
    return pos, None


def _table(rows: list[list[float]], name: str, width: int) -> np.ndarray:
    for index, row in enumerate(rows):
        if len(row) < width:
            raise Unreadable(f"{name} {index + 1} has {len(row)} numbers; give {width}")
    return np.array([row[:width] for row in rows], dtype=np.float64).reshape(-1, width)


def read_off(path: Path) -> RawMesh:
    """An ASCII OFF file; what follows the coordinates and the corners on a line (colours) is passed over.

    Raises:
        Unreadable: not an ASCII OFF file, or it ends before the rows it announces.
    """
    text = read_text(path)
    rows = [words for words in (line.split("#")[0].split() for line in text.splitlines()) if words]
    head = rows[0][0] if rows else ""
    if not head.endswith("OFF") or "BINARY" in rows[0]:
        raise Unreadable("not an ASCII OFF file: the first word is not OFF")
    rows[0] = rows[0][1:]
    rows = rows if rows[0] else rows[1:]
    num_vertices, num_faces = (int(word) for word in rows[0][:2])
    if num_vertices < 0 or num_faces < 0 or len(rows) < 1 + num_vertices + num_faces:
        raise Unreadable(f"OFF announces {num_vertices} vertices and {num_faces} faces and ends before them")
    pos = np.array([[float(word) for word in row[:3]] for row in rows[1 : 1 + num_vertices]], dtype=np.float64)
    corners: list[int] = []
    counts: list[int] = []
    for face, row in enumerate(rows[1 + num_vertices : 1 + num_vertices + num_faces]):
        count = int(row[0])
        if count < 0 or len(row) < count + 1:
            raise Unreadable(f"face {face} has fewer corners than the {count} it announces")
        corners.extend(int(word) for word in row[1 : count + 1])
        counts.append(count)
    return RawMesh(pos.reshape(-1, 3), np.array(corners, dtype=np.int64), np.array(counts, dtype=np.int64))


def read_stl(path: Path) -> RawMesh:
    """An ASCII or binary STL file: three vertices of its own per triangle.

    Raises:
        Unreadable: the file ends before the triangles it announces.
    """
    content = path.read_bytes()
    text = _text_of(content)
    if text is not None:
        points = _ascii_corners(text)
    else:
        if len(content) < _STL_HEAD:
            raise Unreadable(f"{len(content)} bytes are less than the head of an STL file")
        count = int.from_bytes(content[80:_STL_HEAD], "little")
        if count * _STL_TRIANGLE.itemsize > len(content) - _STL_HEAD:
            raise Unreadable(f"STL announces {count} triangles and ends before them")
        table = np.frombuffer(content, _STL_TRIANGLE, count, _STL_HEAD)
        points = table["corners"].reshape(-1, 3).astype(np.float64)
    return RawMesh(points, np.arange(len(points)), np.full(len(points) // 3, 3, dtype=np.int64))


def _text_of(content: bytes) -> str | None:
    """The text of an ASCII file; None of a binary one, whose head may begin with the same word."""
    head = decoded_text_file(content[:4096]).lower()
    return decoded_text_file(content) if head.startswith("solid") and "facet" in head else None


def _ascii_corners(text: str) -> np.ndarray:
    rows = [line.split() for line in text.splitlines()]
    points = [[float(word) for word in row[1:4]] for row in rows if row[:1] == ["vertex"]]
    if len(points) % 3 or any(len(point) != 3 for point in points):
        raise Unreadable(f"STL with {len(points)} corners; every triangle has three of three coordinates")
    return np.array(points, dtype=np.float64).reshape(-1, 3)

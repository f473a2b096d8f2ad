"""Readers of OFF and STL files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hood.assets.files.text import decoded_text_file, read_text
from hood.assets.formats.raw_mesh import RawMesh, Unreadable

_STL_HEAD = 84
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


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

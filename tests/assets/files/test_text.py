"""Texts are read in whatever programs write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from garment_kinds import off_text, ply_text, stl_text

from hood.assets.files.text import decoded_text_file, encoding_of, read_indices
from hood.assets.formats.mesh_file import read_mesh, read_mesh_file

_ENCODINGS = ("utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "latin-1")
_TETRAHEDRON = (
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]),
)


@pytest.mark.parametrize("encoding", _ENCODINGS)
def test_a_text_is_the_same_in_every_encoding(encoding: str) -> None:
    text = "o Röckchen\nv 1 2 3\n"
    assert decoded_text_file(text.encode(encoding)) == text


def test_bytes_that_are_not_utf8_are_read_as_windows_letters() -> None:
    assert encoding_of("Kleid für Jörg".encode("latin-1")) == "cp1252"
    assert encoding_of(b"plain") == encoding_of("Röckchen".encode()) == "utf-8"


@pytest.mark.parametrize("encoding", _ENCODINGS)
@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off", ".stl"])
def test_a_mesh_is_the_same_in_every_encoding(tmp_path: Path, suffix: str, encoding: str) -> None:
    pos, faces = _TETRAHEDRON
    # The first line is a vertex: a mark before it must not hide it, nor the unused last vertex shift the faces.
    obj = "".join(f"v {x} {y} {z}\n" for x, y, z in [*pos.tolist(), [9, 9, 9]]) + "# ü\n"
    obj += "".join(f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist())
    texts = {".obj": obj, ".ply": ply_text((pos, faces)), ".off": off_text((pos, faces)), ".stl": stl_text((pos, faces))}
    path = tmp_path / f"mesh{suffix}"
    path.write_bytes(texts[suffix].encode(encoding))
    found, table = read_mesh(path)
    assert np.array_equal(found[table], pos[faces])


def test_names_of_a_latin_1_file_keep_their_letters(tmp_path: Path) -> None:
    text = "o Ärmel\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\no Körper\nv 0 0 1\nv 1 0 1\nv 0 1 1\nf 4 5 6\n"
    (tmp_path / "two.obj").write_bytes(text.encode("latin-1"))
    assert set(read_mesh_file(tmp_path / "two.obj").panels or {}) == {"Aermel", "Koerper"}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize(("suffix", "text"), [(".txt", "1 2 # über\n3"), (".json", "[1, 2, 3]")])
def test_lists_of_vertices_are_read_in_every_encoding(tmp_path: Path, suffix: str, text: str, encoding: str) -> None:
    path = tmp_path / f"held{suffix}"
    path.write_bytes(text.encode(encoding))
    assert read_indices(path).tolist() == [1, 2, 3]

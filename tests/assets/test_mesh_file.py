"""Mesh files: what the user wrote arrives unchanged, or is refused by file, index and fix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hood.assets.mesh_file import read_mesh
from hood.testing import cylinder

SQUARE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"
HALVES = [[0, 1, 2], [1, 3, 2]]


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3\nf 2 4 3\n",
        "f 1/1 2/2 3/3\nf 2/4 4/5 3/6\n",  # a texture seam
        "f 1//1 2//1 3//1\nf 2//2 4//2 3//2\n",
        "f -4 -3 -2\nf -3 -1 -2\n",
        "usemtl a\nf 1 2 3\nusemtl b\nf 2 4 3\n",
        "o front\nf 1 2 3\ng back\nf 2 4 3  # hem\n",
        "f\t1  2\t3\r\nf 2 4 3\r\n",
    ],
)
def test_obj_keeps_vertices_and_faces_in_order(tmp_path: Path, faces: str) -> None:
    texture = "vt 0 0\nvt 1 0\nvt 0 1\nvt .2 0\nvt 1 1\nvt .2 1\nvn 0 0 1\nvn 0 1 0\n"
    pos, triangles = read_mesh(write(tmp_path / "g.obj", SQUARE + texture + faces))
    np.testing.assert_array_equal(pos, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    np.testing.assert_array_equal(triangles, HALVES)


def test_obj_keeps_isolated_vertices_and_ignores_colours(tmp_path: Path) -> None:
    text = "v 9 9 9 0.5 0.5 0.5\n" + SQUARE + "f 2 3 4\n"
    pos, triangles = read_mesh(write(tmp_path / "g.obj", text))
    assert pos.shape == (5, 3)
    np.testing.assert_array_equal(triangles, [[1, 2, 3]])


def test_triangulated_quads_cover_the_same_area(tmp_path: Path) -> None:
    pos, triangles = read_mesh(write(tmp_path / "g.obj", SQUARE + "f 1 2 4 3\n"), triangulate=True)
    corners = pos[triangles]
    area = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert (area > 0).all()
    assert area.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("suffix", ["ply", "off", "stl", "glb"])
def test_other_formats_keep_the_topology(tmp_path: Path, suffix: str) -> None:
    import trimesh

    pos, faces = cylinder(6, 3)
    trimesh.Trimesh(pos, faces, process=False).export(tmp_path / f"tube.{suffix}")
    read_pos, read_faces = read_mesh(tmp_path / f"tube.{suffix}")
    assert len(read_pos) == len(pos)
    np.testing.assert_allclose(read_pos[read_faces], pos[faces], atol=1e-6)


REFUSED = {
    "quad.obj": (SQUARE + "f 1 2 3\nf 1 2 4 3\n", ("face 1 has 4 corners", "triangulate")),
    "far.obj": (SQUARE + "f 1 2 3\nf 2 3 9\n", ("face 1 refers to vertex 9 of 4",)),
    "zero.obj": (SQUARE + "f 0 1 2\n", ("face 0 refers to vertex 0 of 4",)),
    "negative.obj": (SQUARE + "f -9 1 2\n", ("face 0",)),
    "line.obj": (SQUARE + "f 1 2\n", ("face 0 has 2 corners",)),
    "word.obj": (SQUARE + "f 1 two 3\n", ("line 5",)),
    "flat.obj": ("v 0 0\n" + SQUARE + "f 2 3 4\n", ("vertex 0 has 2 coordinates",)),
    "quad.off": ("OFF\n# made by hand\n4 1 0\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n4 0 1 3 2\n", ("triangulate",)),
    "quad.ply": (
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n4 0 1 3 2\n",
        ("1 faces are 2 triangles", "triangulate"),
    ),
    "text.ply": ("hello", ("not a readable mesh",)),
    "text.glb": ("hello", ("not a readable mesh",)),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_with_file_and_reason(tmp_path: Path, name: str) -> None:
    text, words = REFUSED[name]
    with pytest.raises(ValueError) as error:
        read_mesh(write(tmp_path / name, text))
    message = str(error.value)
    assert name in message
    assert all(word in message for word in words), message
    assert "\n" not in message

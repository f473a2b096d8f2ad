"""Mesh files: what the user wrote arrives unchanged, or is refused by file, index and fix."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from hood.assets.formats.mesh_file import read_mesh, read_mesh_file
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
        ("face 0 has 4 corners", "triangulate"),
    ),
    "text.ply": ("hello", ("not a PLY file",)),
    "text.glb": ("hello", ("not a readable glTF file",)),
    "text.off": ("hello", ("not an ASCII OFF file",)),
    "text.stl": ("hello", ("less than the head of an STL file",)),
    "huge.off": ("OFF\n4000000000 4000000000 0\n0 0 0\n", ("announces 4000000000 vertices", "ends before them")),
    "huge.ply": (
        "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n1234",
        ("announces 4000000000 vertex rows",),
    ),
    "nan.obj": (SQUARE + "vt 0 0\nvt 1 nan\nvt 0 1\nf 1/1 2/2 3/3\n", ("texture coordinate 2 is not finite",)),
    "texture.obj": (SQUARE + "vt 0 0\nf 1/1 2/9 3/1\n", ("texture coordinate 9 of 1",)),
    "binary.ply": ("ply\nformat binary_middle_endian 1.0\nend_header\n", ("binary_middle_endian",)),
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


TEXTURED = "vt 0 0\nvt 1 0\nvt 0 1\nvt .2 0\nvt 1 1\nvt .2 1\n"


def test_a_texture_seam_does_not_tear_the_mesh(tmp_path: Path) -> None:
    mesh = read_mesh_file(write(tmp_path / "g.obj", SQUARE + TEXTURED + "f 1/1 2/2 3/3\nf 2/4 4/5 3/6\n"))
    assert mesh.pos.shape == (4, 3)
    np.testing.assert_array_equal(mesh.uv_faces, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_allclose(mesh.uv[4], [1, 1])


def test_split_polygons_take_their_texture_along(tmp_path: Path) -> None:
    mesh = read_mesh_file(write(tmp_path / "g.obj", SQUARE + TEXTURED + "f 1/1 2/2 4/5 3/3\n"), split_polygons=True)
    assert mesh.num_polygons == 1
    np.testing.assert_allclose(mesh.uv[mesh.uv_faces], mesh.pos[mesh.faces][:, :, :2])


def test_texture_of_some_faces_is_left_out_and_said(tmp_path: Path) -> None:
    mesh = read_mesh_file(write(tmp_path / "g.obj", SQUARE + TEXTURED + "f 1/1 2/2 3/3\nf 2 4 3\n"))
    assert mesh.uv is None
    assert "1 of 2 triangles have no texture coordinates" in mesh.notes[0]


def test_hard_edges_are_kept_and_smooth_meshes_need_no_table(tmp_path: Path) -> None:
    normals = "vn 0 0 1\nvn 0 1 0\n"
    hard = read_mesh_file(write(tmp_path / "h.obj", SQUARE + normals + "f 1//1 2//1 3//1\nf 2//2 4//2 3//2\n"))
    assert hard.normal_faces is not None
    assert not np.isin(hard.normal_faces[0], hard.normal_faces[1]).any()
    smooth = read_mesh_file(write(tmp_path / "s.obj", SQUARE + normals + "f 1//1 2//1 3//1\nf 2//1 4//1 3//1\n"))
    assert smooth.normal_faces is None


@pytest.mark.parametrize("text", ["1 0 0", "255 0 0"])
def test_colours_of_an_obj(tmp_path: Path, text: str) -> None:
    lines = [f"{line} {text}" for line in SQUARE.split("\n")[:-1]]
    mesh = read_mesh_file(write(tmp_path / "g.obj", "\n".join(lines) + "\nf 1 2 3\n"))
    np.testing.assert_allclose(mesh.colours, [[1, 0, 0]] * 4)


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_of_mixed_polygons_with_colours(tmp_path: Path, order: str) -> None:
    """A triangle and a quad: rows of different lengths; byte order of either kind; a property to pass over."""
    head = (
        f"ply\nformat binary_{'little' if order == '<' else 'big'}_endian 1.0\ncomment made by a test\nelement vertex 5\n"
        "property double x\nproperty double y\nproperty double z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        "element face 2\nproperty float area\nproperty list uchar uint vertex_index\nend_header\n"
    )
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 2, 0)]
    body = b"".join(struct.pack(f"{order}dddBBB", *point, 255, 0, 51) for point in points)
    body += struct.pack(f"{order}fB4I", 1.0, 4, 0, 1, 2, 3) + struct.pack(f"{order}fB3I", 0.5, 3, 3, 2, 4)
    (tmp_path / "g.ply").write_bytes(head.encode() + body)
    mesh = read_mesh_file(tmp_path / "g.ply", split_polygons=True)
    np.testing.assert_allclose(mesh.pos, points)
    assert len(mesh.faces) == 3
    assert mesh.num_polygons == 1
    np.testing.assert_allclose(mesh.colours, [[1, 0, 0.2]] * 5)


def test_glb_with_texture_colours_and_placed_parts(tmp_path: Path) -> None:
    """Two meshes, one moved by its node; a vertex doubled by a texture seam is one again."""
    import trimesh

    pos = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    visual = trimesh.visual.TextureVisuals(uv=np.arange(12).reshape(6, 2) / 12)
    front = trimesh.Trimesh(pos, [[0, 1, 2], [3, 4, 5]], visual=visual, process=False)
    scene = trimesh.Scene({"front": front})
    scene.add_geometry(front.copy(), node_name="back", transform=trimesh.transformations.translation_matrix([0, 0, -2.0]))
    scene.export(tmp_path / "g.glb")
    mesh = read_mesh_file(tmp_path / "g.glb")
    assert mesh.num_joined == 4
    assert len(mesh.pos) == 8
    assert sorted(set(mesh.pos[:, 2])) == [-2, 0]
    np.testing.assert_allclose(mesh.uv[mesh.uv_faces[0]], np.arange(6).reshape(3, 2) / 12, atol=1e-6)


def test_ascii_stl(tmp_path: Path) -> None:
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 {}\nendloop\nendfacet\n"
    mesh = read_mesh_file(write(tmp_path / "g.stl", "solid s\n" + facet.format(0) + facet.format(1) + "endsolid s\n"))
    assert mesh.pos.shape == (4, 3)
    assert len(mesh.faces) == 2

"""Objects of files by their names: of glTF nodes and materials, behind a file's name, and threads between them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from garment_kinds import ply_text, write_glb, write_objects

from hood.assets.formats.mesh_file import object_alone, parts_by_name, read_mesh_file, split_object
from hood.assets.garment.garment import load_garment
from hood.assets.motion.animated_mesh import body_kind, load_mesh_sequence
from hood.testing import cylinder, grid

_SHEET, _TUBE = grid(4, 4), cylinder(8, 3, 0.1, 0.3)


def test_nodes_of_gltf_are_names(tmp_path: Path) -> None:
    mesh = read_mesh_file(write_glb(tmp_path / "two.glb", [("sheet", _SHEET), ("tube", _TUBE)]))
    assert mesh.panels is not None
    assert {name: int(mask.sum()) for name, mask in mesh.panels.items()} == {"sheet": len(_SHEET[1]), "tube": len(_TUBE[1])}
    assert read_mesh_file(write_glb(tmp_path / "one.glb", [("sheet", _SHEET)])).panels is None


def test_a_name_behind_a_file_is_that_of_an_object(tmp_path: Path) -> None:
    path = write_objects(tmp_path / "two.obj", [("Röckchen", _SHEET), ("tube", _TUBE)])
    assert split_object(f"{path}:tube") == (path, "tube")
    assert split_object(path) == (path, None)
    assert split_object("default") == (Path("default"), None)
    assert body_kind(f"{path}:tube") == "mesh"
    mesh = read_mesh_file(path)
    for name in ("Röckchen", "Roeckchen", "part_1"):
        alone = object_alone(path, mesh, name)
        np.testing.assert_allclose(alone.pos, _SHEET[0])
        assert np.array_equal(alone.faces, _SHEET[1])
    np.testing.assert_allclose(load_garment(f"{path}:tube").rest_pos, _TUBE[0], atol=1e-9)
    with pytest.raises(ValueError, match="no object, group, material or part 'hat'; there are "):
        object_alone(path, mesh, "hat")


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_one_object_of_a_file_is_a_body(tmp_path: Path, suffix: str) -> None:
    write = write_objects if suffix == ".obj" else write_glb
    path = write(tmp_path / f"two{suffix}", [("sheet", _SHEET), ("tube", _TUBE)])
    sequence = load_mesh_sequence(f"{path}:tube", scale=1)
    assert sequence.verts.shape == (1, *_TUBE[0].shape)


def test_parts_are_numbered_in_the_order_of_their_vertices() -> None:
    faces = np.concatenate([_SHEET[1], _TUBE[1] + len(_SHEET[0])])
    found = parts_by_name(len(_SHEET[0]) + len(_TUBE[0]), faces)
    assert {name: int(mask.sum()) for name, mask in found.items()} == {"part_1": len(_SHEET[1]), "part_2": len(_TUBE[1])}


def test_lines_are_threads(tmp_path: Path) -> None:
    path = write_objects(tmp_path / "two.obj", [("", _SHEET), ("", _TUBE)])
    path.write_text(path.read_text() + "l 1 17 18\nl -1 2\nl 1 999\n")
    count = len(_SHEET[0]) + len(_TUBE[0])
    stitches = read_mesh_file(path).stitches
    assert stitches is not None
    assert stitches.tolist() == [[0, 16], [16, 17], [count - 1, 1]]
    text = ply_text(_SHEET).replace("end_header", "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header")
    (tmp_path / "threads.ply").write_text(text + "3 5\n")
    threads = read_mesh_file(tmp_path / "threads.ply").stitches
    assert threads is not None
    assert threads.tolist() == [[3, 5]]

"""Exported meshes keep numbers, texture and hard edges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hood.assets.formats.mesh_file import read_mesh_file
from hood.assets.garment.garment import Garment
from hood.media.exports.sequences import corner_normals, write_obj
from hood.testing import box, sphere


def test_obj_round_trip(tmp_path: Path, garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    moved = tank.rest_pos @ np.diag([1.0, 2.0, 1.0])
    write_obj(tmp_path / "tank.obj", tank, moved)
    mesh = read_mesh_file(tmp_path / "tank.obj")
    np.testing.assert_allclose(mesh.pos, moved, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, tank.faces)
    np.testing.assert_array_equal(mesh.uv_faces, tank.uv_faces)
    np.testing.assert_allclose(mesh.uv, tank.uv, atol=1e-6)
    assert mesh.normal_faces is None


def test_hard_edges_stay_hard(tmp_path: Path) -> None:
    pos, faces = box(2)
    side = np.abs(corner_normals(pos, faces, np.arange(len(faces))[:, None].repeat(3, 1))).argmax(axis=1)
    cube = Garment("cube", pos, faces, np.zeros(len(pos), dtype=bool), normal_faces=faces + len(pos) * side[:, None])
    write_obj(tmp_path / "cube.obj", cube)
    again = read_mesh_file(tmp_path / "cube.obj")
    assert again.normal_faces is not None
    normals = corner_normals(again.pos, again.faces, again.normal_faces)[again.normal_faces]
    np.testing.assert_allclose(np.abs(normals).max(axis=2), 1.0, atol=1e-9)
    write_obj(tmp_path / "smooth.obj", replace(cube, normal_faces=None))
    assert read_mesh_file(tmp_path / "smooth.obj").normal_faces is None


def test_normals_of_a_ball_point_outward() -> None:
    pos, faces = sphere(3)
    np.testing.assert_allclose(corner_normals(pos, faces, faces), pos, atol=0.02)

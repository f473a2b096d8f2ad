"""Files of the add-on for Blender, without Blender: caches that grow, bodies, garments, the zip; they are what hood reads."""

from __future__ import annotations

import ast
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from blender import make_zip
from blender.hood_blender import axes, meshes, point_cache
from blender.hood_blender.body_file import BodyFile, is_body_file
from blender.hood_blender.fault import BakeError
from hood.assets.formats.vertex_files import read_point_cache
from hood.assets.garment.garment import load_garment
from hood.assets.motion.animated_mesh import load_mesh_sequence
from hood.testing import cylinder, sphere

NONE = np.zeros(3)


def test_a_cache_grows_by_whole_samples_and_is_one_that_hood_reads(tmp_path: Path) -> None:
    pos, faces = cylinder(8, 3, 0.2, 0.4)
    samples = np.random.default_rng(0).normal(size=(3, len(pos), 3)).astype(np.float32)
    path = tmp_path / "skirt.pc2"
    assert point_cache.read_header(path) is None
    cache = point_cache.GrowingCache(path, len(pos))
    assert point_cache.read_header(path) == (len(pos), 0)
    for count, sample in enumerate(samples, 1):
        cache.add(sample)
        assert point_cache.read_header(path) == (len(pos), count)
    assert np.array_equal(point_cache.read_samples(path, 1, 3), samples[1:])
    exported = meshes.export_mesh("skirt", pos, faces, np.zeros(len(faces), int), np.arange(len(faces)))
    meshes.write_obj(tmp_path / "skirt.obj", exported, ["skirt"])
    assert np.array_equal(read_point_cache(path).verts, samples)


def test_a_header_that_is_ahead_of_its_samples_counts_whole_ones(tmp_path: Path) -> None:
    path = tmp_path / "a.pc2"
    cache = point_cache.GrowingCache(path, 4)
    cache.add(np.zeros((4, 3)))
    content = path.read_bytes()
    path.write_bytes(content[:28] + (2).to_bytes(4, "little") + content[32:] + b"\0" * 7)
    assert point_cache.read_header(path) == (4, 1)
    path.write_bytes(b"something else of more than 32 bytes")
    with pytest.raises(ValueError, match=r"a\.pc2: not a PC2 point cache; delete it"):
        point_cache.read_header(path)


def test_a_run_that_goes_on_keeps_its_samples_until_they_come_again(tmp_path: Path) -> None:
    path = tmp_path / "a.pc2"
    first = point_cache.GrowingCache(path, 2)
    for value in (1.0, 2.0, 3.0):
        first.add(np.full((2, 3), value))
    again = point_cache.GrowingCache(path, 2, kept=3)
    again.add(np.full((2, 3), 5.0))
    assert point_cache.read_header(path) == (2, 3)
    assert point_cache.read_samples(path, 0, 3)[:, 0, 0].tolist() == [5.0, 2.0, 3.0]
    other = point_cache.GrowingCache(path, 3, kept=3)
    assert point_cache.read_header(path) == (3, 0)
    assert other.samples == 0


@pytest.mark.parametrize("halves, rate", [([], 24.0), ([1], 48.0)])
def test_a_captured_body_is_one_that_hood_reads(tmp_path: Path, halves: list[int], rate: float) -> None:
    pos, faces = sphere(1, 0.2)
    file = BodyFile(tmp_path / "capture" / "body.npz", faces)
    for frame in range(3):
        file.add(pos + [0.1 * frame * (frame == 2), 0.0, 0.0], 0.05)
    assert file.fast == [1]
    for after in halves:
        file.add_half(after, pos + [0.3, 0.0, 0.0])
    assert file.finish(24.0) == rate / 24
    assert is_body_file(file.path)
    assert [path.name for path in file.path.parent.iterdir()] == ["body.npz"]
    read = load_mesh_sequence(file.path, fps=rate, up="y", scale=1.0)
    assert len(read.verts) == (5 if halves else 3)
    if halves:
        assert np.abs(read.verts[3] - pos - [0.3, 0.0, 0.0]).max() < 1e-6
        assert np.abs(read.verts[1] - pos).max() < 1e-6
    assert np.abs(read.verts[-1] - pos - [0.2, 0.0, 0.0]).max() < 1e-6


def test_positions_go_to_hood_and_back() -> None:
    pos = np.random.default_rng(0).normal(size=(20, 3))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.random.default_rng(0).normal(size=(3, 3)), [3.0, -2.0, 1.0]
    origin = np.array([5.0, 0.0, -1.0])
    metres = axes.to_metres(pos, matrix, 0.01, origin)
    assert np.allclose(axes.to_local(metres, matrix, 0.01, origin), pos, atol=1e-9)
    assert axes.to_metres(np.array([[0.0, 0.0, 200.0]]), np.eye(4), 0.01, NONE).tolist() == [[0.0, 2.0, 0.0]]
    with pytest.raises(ValueError, match="an axis of the object is scaled to 0"):
        axes.to_local(metres, np.zeros((4, 4)), 1.0, NONE)


def test_wind_and_gravity_are_turned_and_have_the_units_of_the_scene() -> None:
    assert axes.wind_of([], 1.0) is None
    fields = [(np.array([1.0, 0.0, 0.0]), 3.0), (np.array([0.0, 2.0, 0.0]), 1.0), (np.array([0.0, 0.0, 1.0]), 0.5)]
    assert axes.wind_of(fields, 1.0) == (3.0, 0.5, -2.0)
    assert axes.gravity_of((0.0, 0.0, -9.81), True, 0.01) == 9.81
    assert axes.gravity_of((0.0, 0.0, -162.0), True, 0.01) == pytest.approx(1.62)
    assert axes.gravity_of((0.0, 0.0, -9.81), False, 1.0) == 0.0
    for wrong in ((0.0, 0.0, 9.81), (1.0, 0.0, -9.81)):
        with pytest.raises(ValueError, match=r"gravity is .*; hood takes one straight down"):
            axes.gravity_of(wrong, True, 1.0)


def export(pos: np.ndarray, faces: np.ndarray, sew: float = 0.0) -> meshes.Exported:
    return meshes.export_mesh("Shirt", pos, faces, np.zeros(len(faces), int), np.arange(len(faces)) // 2, sew)


def test_rims_are_sewn_and_blenders_vertices_are_found_again() -> None:
    """Two strips whose rims lie on each other, and a loose vertex between them."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    pos = np.concatenate([square, [[9.0, 9, 9]], square + [1.004, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [5, 6, 7], [5, 7, 8]])
    apart = export(pos, faces)
    assert len(apart.pos) == 8
    assert apart.number_of.tolist() == [0, 1, 2, 3, -1, 4, 5, 6, 7]
    sewn = export(pos, faces, sew=0.005)
    assert len(sewn.pos) == 6
    assert sewn.number_of.tolist() == [0, 1, 2, 3, -1, 1, 4, 5, 2]
    assert sewn.originals([1]) == [1, 5]
    assert sewn.polygons([2, 3]) == [1]
    assert sewn.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]]


def test_the_two_ends_of_an_edge_are_never_sewn() -> None:
    pos = np.array([[0.0, 0, 0], [0.001, 0, 0], [0.0, 1, 0]])
    assert len(export(pos, np.array([[0, 1, 2]]), sew=0.005).pos) == 3


def test_meshes_that_are_no_cloth_are_refused_by_name_and_number() -> None:
    pos = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]])
    with pytest.raises(BakeError, match="Shirt has no faces"):
        export(pos, np.zeros((0, 3), int))
    with pytest.raises(BakeError, match="Shirt: the edge between vertices 0 and 1 has 3 faces") as error:
        export(pos, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    assert error.value.vertices == [0, 1]
    with pytest.raises(BakeError, match="Shirt: face 0 has no area") as error:
        export(pos, np.array([[0, 1, 1]]))
    assert error.value.faces == [0]
    broken = pos.copy()
    broken[3, 1] = np.nan
    with pytest.raises(BakeError, match="Shirt: vertex 3 has no finite position"):
        export(broken, np.array([[0, 1, 2]]))


def test_a_garment_of_several_materials_has_parts_that_hood_finds(tmp_path: Path) -> None:
    pos, faces = cylinder(16, 5, 0.2, 0.4)
    part = (pos[faces].mean(axis=1)[:, 1] > pos[:, 1].mean()).astype(int)
    exported = meshes.export_mesh("Skirt", pos, faces, part, np.arange(len(faces)))
    names = meshes.part_names("skirt", ["Blue Silk", "Ärmel"])
    assert names == ["skirt__0_blue_silk", "skirt__1_rmel"]
    path = tmp_path / "skirt.obj"
    meshes.write_obj(path, exported, names)
    garment = load_garment(path)
    assert np.array_equal(meshes.read_obj_faces(path), faces)
    assert np.array_equal(garment.faces, faces)
    assert np.allclose(garment.rest_pos, pos, atol=1e-8)
    assert garment.panels is not None
    assert np.array_equal(garment.panels[names[1]], part == 1)


def test_names_of_files_need_no_quotes_and_are_unlike() -> None:
    assert meshes.unlike(["Shirt", "shirt.001", "Über (1)", "SHIRT", "", "Body"]) == [
        *("shirt", "shirt_001", "ber__1", "shirt_2", "garment", "body_2")
    ]


def test_the_zip_is_whole_and_always_the_same(tmp_path: Path) -> None:
    first, second = make_zip.make_zip(tmp_path / "a.zip"), make_zip.make_zip(tmp_path / "b" / "b.zip")
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as archive:
        names = archive.namelist()
        assert archive.testzip() is None
    assert {"blender_manifest.toml", "__init__.py"} <= set(names)
    assert set(names) == {path.name for path in make_zip.SOURCE.iterdir() if path.is_file()}


def test_it_imports_what_blender_has_and_nothing_else() -> None:
    """No hood, torch or h5py; bpy alone where it cannot be avoided, so that the rest is tested here."""
    with_blender = set()
    for path in make_zip.files_of():
        if path.suffix != ".py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            found = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            found += [node.module or ""] if isinstance(node, ast.ImportFrom) and node.level == 0 else []
            for name in (module.split(".")[0] for module in found):
                assert name in {*sys.stdlib_module_names, "numpy", "bpy", "bmesh"}, f"{path.name}: {name}"
                with_blender |= {path.name} if name == "bpy" else set()
    assert with_blender == {
        *("capture.py", "folders.py", "job.py", "lookup.py", "operators.py", "panel.py"),
        *("preferences.py", "properties.py", "results.py"),
    }

"""Animated glTF files against a direct evaluation: nodes, skins, morph targets, all interpolations; harmful files."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imitations import GltfWriter
from scipy.spatial.transform import Rotation

from hood.assets.formats.gltf_animation import read_gltf_animation
from hood.assets.motion.animated_mesh import load_mesh_sequence
from hood.testing import cylinder, sphere

POINTS, FACES = sphere(1, 0.5)
POINTS = POINTS.astype(np.float32)


def mesh(writer: GltfWriter, points: np.ndarray = POINTS, faces: np.ndarray = FACES, **attributes: int) -> dict[str, Any]:
    primitive = {
        "attributes": {"POSITION": writer.table(points.astype(np.float32)), **attributes},
        "indices": writer.table(faces.astype(np.uint16).reshape(-1)),
    }
    return {"primitives": [primitive], "name": "Body"}


def animation(writer: GltfWriter, node: int, path: str, times: np.ndarray, values: np.ndarray, kind: str) -> dict[str, Any]:
    sampler = {"input": writer.table(times.astype(np.float32)), "output": writer.table(values.astype(np.float32))}
    sampler["interpolation"] = kind
    return {"samplers": [sampler], "channels": [{"sampler": 0, "target": {"node": node, "path": path}}], "name": path}


def turn(axis: str, angles: np.ndarray) -> np.ndarray:
    """Quaternions (K, 4), scalar last."""
    return Rotation.from_euler(axis, angles[:, None]).as_quat()


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_animated_nodes(suffix: str, tmp_path: Path) -> None:
    """A parent that turns at 90°/s, slerped between keys, and a child that is shifted and scaled."""
    writer = GltfWriter()
    angles = np.array([0.0, 2.0, 3.0]) * np.pi / 2
    writer.document |= {
        "meshes": [mesh(writer)],
        "nodes": [{"children": [1], "name": "root"}, {"mesh": 0, "translation": [1, 0, 0], "scale": [1, 2, 1]}],
        "animations": [animation(writer, 0, "rotation", np.array([0.0, 2.0, 3.0]), turn("y", angles), "LINEAR")],
        "scenes": [{"nodes": [0]}],
    }
    scene = read_gltf_animation(writer.write(tmp_path / f"a{suffix}"), 30.0)
    assert scene.transforms is None
    assert len(scene.verts) == 91
    np.testing.assert_array_equal(scene.faces, FACES)
    for frame in (0, 17, 45, 60, 75, 90):
        expected = Rotation.from_euler("y", np.pi / 2 * frame / 30).apply(POINTS * [1, 2, 1] + [1, 0, 0])
        np.testing.assert_allclose(scene.verts[frame], expected, atol=1e-6)


def test_steps_and_splines(tmp_path: Path) -> None:
    """Steps hold their value; the spline has the keys' values and tangents."""
    times = np.array([0.0, 0.5, 1.0])
    values = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0.0]])
    tangents = np.array([[0, 3, 0], [0, 0, 1], [5, 0, 0.0]])
    spline = np.stack([tangents, values, tangents], axis=1).reshape(-1, 3)
    found = {}
    for kind, output in (("STEP", values), ("CUBICSPLINE", spline)):
        writer = GltfWriter()
        writer.document |= {
            "meshes": [mesh(writer)], "nodes": [{"mesh": 0}],
            "animations": [animation(writer, 0, "translation", times, output, kind)],
        }  # fmt: skip
        place = read_gltf_animation(writer.write(tmp_path / "a.glb"), 100.0).verts - POINTS
        found[kind] = place[:, 0]
        np.testing.assert_allclose(place, np.broadcast_to(place[:, :1], place.shape), atol=1e-6)
    np.testing.assert_allclose(found["STEP"][[0, 49, 50, 99, 100]], values[[0, 0, 1, 1, 2]], atol=1e-6)
    np.testing.assert_allclose(found["CUBICSPLINE"][[0, 50, 100]], values, atol=1e-6)
    slope = (found["CUBICSPLINE"][51] - found["CUBICSPLINE"][49]) / 0.02
    np.testing.assert_allclose(slope, tangents[1], atol=0.15)
    # Halfway of a Hermite segment: mean of the ends and an eighth of the tangents' difference times the span.
    middle = (values[0] + values[1]) / 2 + 0.5 * (tangents[0] - tangents[1]) / 8
    np.testing.assert_allclose(found["CUBICSPLINE"][25], middle, atol=1e-6)


def skinned(path: Path, weights: str = "float32") -> tuple[Path, np.ndarray, np.ndarray]:
    """A tube bent by two joints; the file, its bind pose and the weights (W, 2)."""
    points, faces = cylinder(8, 9, 0.1, 1.0)
    upper = np.clip(points[:, 1] * 2 - 0.5, 0, 1)
    shares = np.stack([1 - upper, upper], axis=1)
    writer = GltfWriter()
    joints = np.tile(np.array([1, 0, 0, 0], dtype=np.uint8), (len(points), 1))  # numbers of the skin's list
    columns = np.c_[shares[:, ::-1], np.zeros((len(points), 2))]
    if weights == "uint8":
        columns = np.round(columns * 255).astype(np.uint8)
        shares = columns[:, 1::-1] / columns.sum(axis=1, keepdims=True)
        share_table = writer.table(columns, normalized=True)
    else:
        share_table = writer.table(columns.astype(np.float32))
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 1, 3] = -0.5
    writer.document |= {
        "meshes": [mesh(writer, points, faces, JOINTS_0=writer.table(joints), WEIGHTS_0=share_table)],
        "nodes": [
            {"mesh": 0, "skin": 0, "translation": [9, 9, 9]},  # the place of a skinned mesh counts for nothing
            {"children": [2], "translation": [0, 0, 0]},
            {"translation": [0, 0.5, 0]},
        ],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": writer.table(inverse.transpose(0, 2, 1).astype(np.float32))}],
        "animations": [
            animation(writer, 2, "rotation", np.array([0.0, 1.0]), turn("z", np.array([0, np.pi / 2])), "LINEAR"),
            animation(writer, 1, "translation", np.array([0.0, 1.0]), np.array([[0, 0, 0], [0, 0, 1.0]]), "LINEAR"),
        ],
    }
    return writer.write(path), points.astype(np.float32), shares


@pytest.mark.parametrize("weights", ["float32", "uint8"])
def test_skinning(weights: str, tmp_path: Path) -> None:
    path, points, shares = skinned(tmp_path / "a.glb", weights)
    scene = read_gltf_animation(path, 20.0)
    assert scene.verts.shape == (21, len(points), 3)
    for frame in (0, 7, 20):
        bent = Rotation.from_euler("z", np.pi / 2 * frame / 20).apply(points - [0, 0.5, 0]) + [0, 0.5, 0]
        np.testing.assert_allclose(scene.verts[frame], shares[:, :1] * points + shares[:, 1:] * bent, atol=1e-6)
    # The joints that come out pose the rest pose into the same vertices.
    np.testing.assert_allclose(scene.rest, points, atol=1e-6)
    np.testing.assert_allclose(scene.weights, shares, atol=1e-6)
    blended = np.einsum("wj,tjab->twab", scene.weights, scene.transforms)
    again = np.einsum("twab,wb->twa", blended[..., :3], scene.rest) + blended[..., 3]
    np.testing.assert_allclose(again, scene.verts, atol=1e-6)


def test_the_rest_pose_is_that_of_the_nodes(tmp_path: Path) -> None:
    """An armature in centimetres, lying down and set upright by its root: rest and joints are in the world's metres."""
    path = skinned(tmp_path / "a.gltf")[0]
    plain = read_gltf_animation(path, 10.0)
    document = json.loads(path.read_text())
    lying = Rotation.from_euler("x", -90, degrees=True).as_quat().tolist()
    document["nodes"].append({"children": [1], "scale": [0.01] * 3, "rotation": lying})
    path.write_text(json.dumps(document))
    scene = read_gltf_animation(path, 10.0)
    place = 0.01 * Rotation.from_quat(lying).as_matrix()
    np.testing.assert_allclose(scene.rest, plain.rest @ place.T, atol=1e-8)
    np.testing.assert_allclose(scene.verts, plain.verts @ place.T, atol=1e-8)
    blended = np.einsum("wj,tjab->twab", scene.weights, scene.transforms)
    again = np.einsum("twab,wb->twa", blended[..., :3], scene.rest) + blended[..., 3]
    np.testing.assert_allclose(again, scene.verts, atol=1e-8)


def test_animations_are_chosen_by_name_or_number(tmp_path: Path) -> None:
    path, points, _ = skinned(tmp_path / "a.glb")
    for chosen in (1, "1", "translation"):
        scene = load_mesh_sequence(path, 10.0, animation=chosen)
        np.testing.assert_allclose(scene.verts[5], points + [0, 0, 0.5], atol=1e-6)
    with pytest.raises(ValueError, match=r"a\.glb: no animation 'run'; it has rotation, translation"):
        load_mesh_sequence(path, animation="run")
    with pytest.raises(ValueError, match="no animation 7"):
        load_mesh_sequence(path, animation=7)


def test_morph_targets_and_sparse_tables(tmp_path: Path) -> None:
    """Two shapes, the second of them stored as a few replaced rows."""
    rng = np.random.default_rng(0)
    first = rng.normal(scale=0.1, size=POINTS.shape).astype(np.float32)
    second = np.zeros_like(POINTS)
    rows = np.array([3, 8, 40], dtype=np.uint16)
    second[rows] = 0.25
    writer = GltfWriter()
    body = mesh(writer)
    sparse = {"componentType": 5126, "count": len(POINTS), "type": "VEC3"}
    sparse["sparse"] = {
        "count": 3, "indices": {"bufferView": writer.view(rows), "componentType": 5123},
        "values": {"bufferView": writer.view(second[rows])},
    }  # fmt: skip
    writer.document["accessors"].append(sparse)
    targets = [{"POSITION": writer.table(first)}, {"POSITION": len(writer.document["accessors"]) - 2}]
    body["primitives"][0]["targets"] = [targets[0], {"POSITION": writer.document["accessors"].index(sparse)}]
    amounts = np.array([[0, 1], [1, 0], [0.5, 0.5]])
    writer.document |= {
        "meshes": [body], "nodes": [{"mesh": 0}],
        "animations": [animation(writer, 0, "weights", np.array([0, 1.0, 2.0]), amounts.reshape(-1), "LINEAR")],
    }  # fmt: skip
    scene = read_gltf_animation(writer.write(tmp_path / "a.glb"), 2.0)
    for frame, (a, b) in enumerate([(0, 1), (0.5, 0.5), (1, 0), (0.75, 0.25), (0.5, 0.5)]):
        np.testing.assert_allclose(scene.verts[frame], POINTS + a * first + b * second, atol=1e-6)


def test_texture_seams_are_joined_and_parts_chosen(tmp_path: Path) -> None:
    corners = FACES.reshape(-1)
    writer = GltfWriter()
    split = mesh(writer, POINTS[corners], np.arange(len(corners)).reshape(-1, 3))
    other = mesh(writer, POINTS + 5, FACES) | {"name": "Hat"}
    writer.document |= {"meshes": [split, other], "nodes": [{"mesh": 0}, {"mesh": 1, "name": "hat node"}]}
    path = writer.write(tmp_path / "a.glb")
    whole = read_gltf_animation(path, 30.0)
    assert whole.verts.shape == (1, 84, 3)
    alone = read_gltf_animation(path, 30.0, parts=["Body"])
    np.testing.assert_array_equal(alone.verts[0][alone.faces], POINTS[FACES])
    assert alone.verts.shape[1] == 42
    with pytest.raises(ValueError, match="no part 'Shoes'; it has .*Hat"):
        read_gltf_animation(path, 30.0, parts=["Shoes"])


def test_strips_fans_and_mirrors(tmp_path: Path) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    normals = {}
    for name, mode, order, scale in (
        ("strip", 5, [0, 1, 2, 3], 1),
        ("fan", 6, [0, 1, 3, 2], 1),
        ("mirror", 5, [0, 1, 2, 3], -1),
    ):
        writer = GltfWriter()
        body = mesh(writer, square, np.array(order))
        body["primitives"][0]["mode"] = mode
        writer.document |= {"meshes": [body], "nodes": [{"mesh": 0, "scale": [scale, 1, 1]}]}
        scene = read_gltf_animation(writer.write(tmp_path / "a.glb"), 30.0)
        a, b, c = np.moveaxis(scene.verts[0][scene.faces], 1, 0)
        normals[name] = np.cross(b - a, c - a)[:, 2]
    for name, value in normals.items():
        np.testing.assert_allclose(value, 1.0, err_msg=name)


def edited(tmp_path: Path, change: Any) -> Path:
    """A sound ``.gltf`` whose document is changed."""
    path = skinned(tmp_path / "a.gltf")[0]
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    return path


HARM = {
    "outside": (lambda d: d["buffers"][0].update(uri="../secret.bin"), "outside the file's folder"),
    "absolute": (lambda d: d["buffers"][0].update(uri="/etc/passwd"), "outside the file's folder"),
    "network": (lambda d: d["buffers"][0].update(uri="https://example.org/a.bin"), "outside the file's folder"),
    "missing": (lambda d: d["buffers"][0].update(uri="b.bin"), "which is missing"),
    "compressed": (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "without mesh compression"),
    "count": (lambda d: d["accessors"][0].update(count=10**12), "accessor 0 claims 1000000000000"),
    "beyond": (lambda d: d["accessors"][0].update(count=5000), "shorter than the 5000 entries"),
    "cycle": (lambda d: d["nodes"][2].update(children=[1]), "nested without end"),
    "joint": (lambda d: d["skins"][0].update(joints=[1, 77]), "nodes 77 of 3"),
    "type": (lambda d: d["accessors"][0].update(type="VEC9"), "not a readable glTF file"),
    "list": (lambda d: d.update(nodes={}), "nodes is not a list"),
    "empty": (lambda d: d["nodes"][0].pop("mesh"), "no triangle meshes"),
    "long": (lambda d: None, "more than a million frames"),
}


@pytest.mark.parametrize("case", HARM)
def test_harmful_and_damaged_files(case: str, tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(b"\0" * 100_000)
    (tmp_path / "in").mkdir()
    path = edited(tmp_path / "in", HARM[case][0])
    with pytest.raises(ValueError, match=rf"a\.gltf: .*{HARM[case][1]}") as error:
        read_gltf_animation(path, 1e8 if case == "long" else 30.0)
    assert "\n" not in str(error.value)


def test_embedded_buffers_and_cut_files(tmp_path: Path) -> None:
    path = skinned(tmp_path / "a.gltf")[0]
    document = json.loads(path.read_text())
    content = path.with_suffix(".bin").read_bytes()
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    (tmp_path / "b.gltf").write_text(json.dumps(document))
    np.testing.assert_array_equal(read_gltf_animation(tmp_path / "b.gltf", 30.0).verts, read_gltf_animation(path, 30.0).verts)
    binary = skinned(tmp_path / "c.glb")[0]
    whole = binary.read_bytes()
    for length in (3, 15, 60, len(whole) // 2, len(whole) - 4):
        binary.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"c\.glb: "):
            read_gltf_animation(binary, 30.0)
    binary.write_bytes(whole[:4] + struct.pack("<I", 1) + whole[8:])
    with pytest.raises(ValueError, match="glTF version 1"):
        read_gltf_animation(binary, 30.0)

"""Garments from names and files, and their binding to a body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.garment.binding import bind_garment
from hood.assets.garment.garment import Garment, load_garment
from hood.mesh import topology
from hood.testing import cylinder, grid


@pytest.fixture
def arrays() -> dict[str, np.ndarray]:
    pos, faces = grid(3, 3, 0.2)
    return {"rest_pos": pos.astype(np.float32), "faces": faces.astype(np.int32)}


@pytest.mark.parametrize("name", ["tshirt", "tank", "longsleeve", "shorts", "trousers", "dress", "skirt"])
def test_embedded_garments_are_bound(name: str, garments: dict[str, Garment]) -> None:
    garment = garments[name]
    assert garment.name == name
    assert garment.bound
    assert len(garment.pinned) == len(garment.rest_pos) == len(garment.lbs_weights)
    np.testing.assert_allclose(garment.lbs_weights.sum(axis=1), 1.0, atol=1e-12)
    assert garment.faces.dtype == np.int64


def test_shape_offsets_follow_the_body(garments: dict[str, Garment], body: Body) -> None:
    """A tall body's dress: its vertices move as the skin next to them does."""
    from scipy.spatial import cKDTree

    garment, betas = garments["dress"], np.array([2.0, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    nearest = cKDTree(body.v_template).query(garment.rest_pos)[1]
    moved, skin = garment.shaped(betas) - garment.rest_pos, body.shaped(betas)[0] - body.v_template
    assert np.median(np.linalg.norm(moved - skin[nearest], axis=1)) < 0.01
    assert np.linalg.norm(moved, axis=1).max() > 0.02


def test_npz_round_trip(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    piece = np.arange(len(arrays["rest_pos"])) % 2
    stiffness = 1.0 + piece
    np.savez(tmp_path / "rag.npz", **arrays, piece=piece, stiffness=stiffness)
    garment = load_garment(tmp_path / "rag.npz")
    np.testing.assert_array_equal(garment.stiffness, stiffness)
    assert garment.name == "rag"
    np.testing.assert_array_equal(garment.piece, piece)
    assert not garment.bound
    assert not garment.pinned.any()
    np.testing.assert_array_equal(garment.faces, arrays["faces"])


def test_texture_coordinates_may_be_the_flat_pattern(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    uv = 1.1 * arrays["rest_pos"][:, [0, 2]]
    tables = {**arrays, "uv": uv, "uv_faces": arrays["faces"]}
    np.savez(tmp_path / "rag.npz", **tables, flat=True)
    np.testing.assert_array_equal(load_garment(tmp_path / "rag.npz").flat, uv.astype(np.float64)[arrays["faces"]])
    np.savez(tmp_path / "rag.npz", **tables, flat=False)
    with pytest.raises(ValueError, match="flat is false; give true"):
        load_garment(tmp_path / "rag.npz")
    np.savez(tmp_path / "rag.npz", **arrays, flat=True)
    with pytest.raises(ValueError, match="without uv and uv_faces"):
        load_garment(tmp_path / "rag.npz")


def test_mesh_file(tmp_path: Path) -> None:
    pos, faces = cylinder(6, 3)
    lines = [f"v {x} {y} {z}" for x, y, z in pos] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (tmp_path / "tube.obj").write_text("\n".join(lines))
    garment = load_garment(str(tmp_path / "tube.obj"))
    np.testing.assert_allclose(garment.rest_pos, pos)
    np.testing.assert_array_equal(garment.faces, faces)


def with_row(value: object, row: int, shape: tuple[int, ...]) -> np.ndarray:
    field = np.ones(shape)
    field[row] = value
    return field


REFUSED = {
    "NaN": (lambda a: {"rest_pos": with_row(np.nan, 4, (9, 3))}, ("vertex 4", "finite")),
    "zero area": (lambda a: {"rest_pos": a["rest_pos"] * np.array([1, 0, 0])}, ("face 0", "zero rest area")),
    "index": (lambda a: {"faces": a["faces"] + 1}, ("face", "indices must be from 0 to 8")),
    "quads": (lambda a: {"faces": np.array([[0, 1, 4, 3]])}, ("4 corners",)),
    "real faces": (lambda a: {"faces": a["faces"].astype(float)}, ("faces are float64",)),
    "repeated": (lambda a: {"faces": np.array([[0, 1, 3], [0, 0, 1]])}, ("face 1 repeats a vertex",)),
    "no faces": (lambda a: {"faces": np.zeros((0, 3), dtype=int)}, ("empty",)),
    "stiffness": (lambda a: {"stiffness": with_row(-1.0, 5, (9,))}, ("stiffness of vertex 5 is -1.0", "above 0")),
    "pins": (lambda a: {"pinned": np.zeros(4, dtype=bool)}, ("pinned has 4 rows for 9 vertices",)),
    "weights": (lambda a: {"lbs_weights": with_row(0.0, 2, (9, 24))}, ("lbs_weights of vertex 2",)),
    "shape": (lambda a: {"shapedirs": with_row(np.nan, 3, (9, 3, 10))}, ("shapedirs of vertex 3",)),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_files_name_file_index_and_reason(tmp_path: Path, arrays: dict[str, np.ndarray], case: str) -> None:
    change, words = REFUSED[case]
    np.savez(tmp_path / "torn.npz", **{**arrays, **change(arrays)})
    with pytest.raises(ValueError) as error:
        load_garment(tmp_path / "torn.npz")
    message = str(error.value)
    assert "torn.npz" in message
    assert all(word in message for word in words), message
    assert "\n" not in message


def test_quads_of_an_obj_are_split_only_on_request(tmp_path: Path) -> None:
    path = tmp_path / "quad.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    with pytest.raises(ValueError, match=r"quad\.obj: face 0 has 4 corners.*triangulate=true"):
        load_garment(path)
    assert len(load_garment(path, triangulate=True).faces) == 2


def test_unknown_format_and_missing_file(tmp_path: Path) -> None:
    (tmp_path / "g.cloth").write_text("x")
    with pytest.raises(ValueError, match=r"g\.cloth: unknown garment format '\.cloth'"):
        load_garment(tmp_path / "g.cloth")
    (tmp_path / "g.fbx").write_text("x")
    with pytest.raises(ValueError, match=r"g\.fbx: FBX files are not read; export the garment as OBJ or GLB"):
        load_garment(tmp_path / "g.fbx")
    with pytest.raises(FileNotFoundError, match=r"none\.obj: no such file"):
        load_garment(tmp_path / "none.obj")


def skin_patch(body: Body, keep: np.ndarray, offset: float = 0.0) -> tuple[Garment, np.ndarray]:
    """A garment made of the body's own skin and the body vertices it is made of."""
    faces = body.faces[keep[body.faces].all(axis=1)]
    used, local = np.unique(faces, return_inverse=True)
    pos = body.v_template[used] * (1.0 + np.array([offset, 0.0, offset]))
    return Garment("skin", pos, local.reshape(-1, 3), np.zeros(len(used), dtype=bool)), used


def test_binding_of_the_skin_itself_gives_the_bodys_weights(body: Body) -> None:
    torso = np.abs(body.v_template[:, 0]) < 0.2
    garment, used = skin_patch(body, torso & (body.v_template[:, 1] > body.v_template[:, 1].mean()))
    bound = bind_garment(garment, body)
    np.testing.assert_allclose(bound.lbs_weights.sum(axis=1), 1.0, atol=1e-9)
    assert bound.lbs_weights.min() >= 0
    difference = np.abs(bound.lbs_weights - body.weights[used])
    # The diffusion rounds off the borders between joints a little, as it should.
    assert np.median(difference.max(axis=1)) < 0.05
    assert (bound.lbs_weights.argmax(axis=1) == body.weights[used].argmax(axis=1)).mean() > 0.9
    # Shape follows as well: the patch of a larger body is the larger body's patch.
    betas = np.full(10, 0.7)
    error = np.linalg.norm(bound.shaped(betas) - body.shaped(betas)[0][used], axis=1)
    assert np.median(error) < 1e-3


def test_far_vertices_take_smooth_weights(body: Body) -> None:
    """A wide skirt hangs between the legs: the closest leg switches there, its weights must not."""
    pos, faces = cylinder(48, 24, radius=0.45, height=0.6)
    hips = body.shaped(np.zeros(10))[1][0]
    garment = Garment("tent", pos + hips - np.array([0.0, 0.6, 0.0]), faces, np.zeros(len(pos), dtype=bool))
    weights = bind_garment(garment, body).lbs_weights
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-9)
    edges = topology.unique_edges(faces)
    # The closest thigh's own weights would jump by almost one in the middle.
    assert np.abs(weights[edges[:, 0]] - weights[edges[:, 1]]).max() < 0.25


def test_bound_garments_are_left_alone(garments: dict[str, Garment], body: Body) -> None:
    assert bind_garment(garments["tank"], body) is garments["tank"]


def test_garments_of_another_body_are_bound_anew(garments: dict[str, Garment], body: Body) -> None:
    """Weights of the embedded body say nothing about a licensed one with as many joints."""
    other = replace(body, name="other", weights=np.roll(body.weights, 1, axis=1))
    bound = bind_garment(garments["tank"], other)
    assert bound.bound_to == "other"
    assert np.abs(bound.lbs_weights - garments["tank"].lbs_weights).max() > 0.5
    own = replace(garments["tank"], bound_to=None)
    assert bind_garment(own, other) is own

"""The committed default body and garments: what every user of them may rely on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from hood.assets.body.body import linear_blend_skinning
from hood.assets.body.load import load_body
from hood.assets.files.library import DATA_FOLDER, names
from hood.assets.garment.binding import posed_body
from hood.assets.garment.garment import load_garment
from hood.assets.garment.pins import MARKS
from hood.assets.motion.sequence_edit import arms_down
from hood.mesh import topology
from hood.mesh.closest_point.search import search_surface

LOOPS = {
    "tshirt": 4, "tank": 4, "longsleeve": 4, "shorts": 3, "trousers": 3, "dress": 4, "skirt": 2, "shirt": 3, "jacket": 3,
}  # fmt: skip
COUNTS = {"": (940, 1060), "4k": (4000, 5000), "12k": (11500, 12500)}
PINNED = ("shorts", "trousers", "skirt")
#: Garments that open in front, in one size: how many pairs of vertices hold them together.
OPENING = {"shirt": ("front_buttons", 11), "jacket": ("front_zip", 19)}
GARMENTS = [name + suffix for name in LOOPS for suffix in (("",) if name in OPENING else ("", "_4k", "_12k"))]
#: Garments that reach the shoulders are drafted around arms lowered by 45 degrees.
TOPS = ("tshirt", "longsleeve", "tank", "dress", "shirt", "jacket")
#: Least and greatest length [m] of the edge of a sleeve, around an arm of 0.26 and a wrist of 0.15 m.
SLEEVE_ENDS = {"tshirt": (0.33, 0.36), "longsleeve": (0.20, 0.222)}


def load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as archive:
        return {key: archive[key] for key in archive.files}


@pytest.fixture(scope="module")
def body() -> dict[str, np.ndarray]:
    return load(DATA_FOLDER / "body" / "default.npz")


@pytest.fixture(params=GARMENTS)
def garment(request: pytest.FixtureRequest) -> tuple[str, dict[str, np.ndarray]]:
    return request.param, load(DATA_FOLDER / "garments" / f"{request.param}.npz")


def face_areas(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corner = verts.astype(np.float64)[faces]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)


def distance(points: np.ndarray, verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    parts = [torch.as_tensor(np.asarray(x, dtype=np.float64)) for x in (points, verts)]
    index = torch.as_tensor(faces.astype(np.int64))
    owners = [torch.zeros(len(x), dtype=torch.int64) for x in (*parts, index)]
    return search_surface(parts[0], owners[0], parts[1], index, owners[1], owners[2]).dist.numpy()


def halfedge_counts(faces: np.ndarray) -> np.ndarray:
    """How often each directed edge occurs; 1 everywhere on a consistently oriented manifold."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(directed, axis=0, return_counts=True)[1]


def assert_no_overlap(corner: np.ndarray) -> None:
    """No middle of a triangle of ``corner`` (F, 3, 2) lies in another triangle."""
    centre = corner.mean(axis=1)
    reach = np.linalg.norm(corner - centre[:, None], axis=2).max()
    pairs = cKDTree(centre).query_pairs(reach, output_type="ndarray")
    for point, other in (pairs.T, pairs[:, ::-1].T):
        side = corner[other] - centre[point][:, None]
        ahead = np.roll(side, -1, axis=1)
        inside = (side[..., 0] * ahead[..., 1] - side[..., 1] * ahead[..., 0] > 0).all(axis=1)
        assert not inside.any()


def drafted_around(name: str, body: dict[str, np.ndarray]) -> np.ndarray:
    """Skin (6890, 3) [m] in the pose of a garment's rest shape."""
    if name.split("_")[0] not in TOPS:
        return body["v_template"]
    return posed_body(load_body(), arms_down(45.0), 0, np.zeros(10)).surface


def test_body_has_the_smpl_layout(body: dict[str, np.ndarray]) -> None:
    shapes = {
        "v_template": (6890, 3),
        "shapedirs": (6890, 3, 10),
        "posedirs": (6890, 3, 207),
        "J_regressor": (24, 6890),
        "weights": (6890, 24),
        "kintree_table": (2, 24),
        "f": (13776, 3),
    }
    assert {key: body[key].shape for key in shapes} == shapes
    assert not body["posedirs"].any()
    parents = body["kintree_table"][0]
    assert parents[0] == 4294967295
    assert (parents[1:] < np.arange(1, 24)).all()


def test_body_is_closed_oriented_outwards_and_without_degenerate_faces(body: dict[str, np.ndarray]) -> None:
    faces = body["f"].astype(np.int64)
    edges = topology.unique_edges(faces)
    assert len(topology.boundary_loops(faces)) == 0
    assert (halfedge_counts(faces) == 1).all()
    assert 6890 - len(edges) + len(faces) == 2
    assert topology.connected_components(6890, edges).max() == 0
    assert face_areas(body["v_template"], faces).min() > 1e-6
    corner = body["v_template"].astype(np.float64)[faces]
    volume = np.einsum("fa,fa->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() / 6
    assert 0.04 < volume < 0.12


def test_body_weights_and_joints(body: dict[str, np.ndarray]) -> None:
    assert body["weights"].min() >= 0
    np.testing.assert_allclose(body["weights"].sum(1), 1.0, atol=1e-5)
    np.testing.assert_allclose(body["J_regressor"].sum(1), 1.0, atol=1e-5)
    joints = body["J_regressor"] @ body["v_template"]
    left, right = joints[[1, 4, 7, 16, 18, 20]], joints[[2, 5, 8, 17, 19, 21]]
    np.testing.assert_allclose(left * [-1, 1, 1], right, atol=0.01)
    # Every bone moves the part of the surface that belongs to it.
    for joint in range(24):
        owned = body["v_template"][body["weights"].argmax(1) == joint]
        assert np.linalg.norm(owned - joints[joint], axis=1).min() < 0.12


@pytest.mark.parametrize("beta, low, high", [(-2.0, 1.45, 1.65), (0.0, 1.65, 1.80), (2.0, 1.80, 2.00)])
def test_first_shape_direction_is_height(body: dict[str, np.ndarray], beta: float, low: float, high: float) -> None:
    verts = body["v_template"] + beta * body["shapedirs"][..., 0]
    assert low < np.ptp(verts[:, 1]) < high


def test_body_loads_with_smplx(body: dict[str, np.ndarray]) -> None:
    smplx = pytest.importorskip("smplx")
    model = smplx.SMPL("", data_struct=smplx.utils.Struct(**body))
    np.testing.assert_allclose(model().vertices[0].detach().numpy(), body["v_template"], atol=1e-5)


def test_every_garment_is_there() -> None:
    assert set(GARMENTS) <= set(names("garments"))


def test_garment_is_one_manifold_with_the_right_openings(garment: tuple[str, dict[str, np.ndarray]]) -> None:
    name, arrays = garment
    base, _, size = name.partition("_")
    faces = arrays["faces"].astype(np.int64)
    num_vertices = len(arrays["rest_pos"])
    low, high = COUNTS[size]
    assert low <= num_vertices <= high
    assert (halfedge_counts(faces) == 1).all()
    assert len(topology.boundary_loops(faces)) == LOOPS[base]
    assert np.array_equal(np.unique(faces), np.arange(num_vertices))
    assert topology.connected_components(num_vertices, topology.unique_edges(faces)).max() == 0
    # A sphere with that many holes: no handles.
    assert num_vertices - len(topology.unique_edges(faces)) + len(faces) == 2 - LOOPS[base]


def test_garment_triangles_are_even(garment: tuple[str, dict[str, np.ndarray]]) -> None:
    _, arrays = garment
    verts, faces = arrays["rest_pos"].astype(np.float64), arrays["faces"].astype(np.int64)
    edges = topology.unique_edges(faces)
    length = np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1)
    relative = length / length.mean()
    assert relative.min() > 0.4
    assert relative.max() < 1.7
    assert np.mean((relative > 0.6) & (relative < 1.4)) > 0.985
    corner = verts[faces]
    cosines = []
    for k in range(3):
        a, b = corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]
        cosines.append((a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1))
    smallest = np.degrees(np.arccos(np.max(cosines, axis=0)))
    assert smallest.min() > 8
    assert np.mean(smallest > 15) > 0.995


def test_garment_is_outside_the_body_and_faces_away_from_it(
    garment: tuple[str, dict[str, np.ndarray]], body: dict[str, np.ndarray]
) -> None:
    name, arrays = garment
    verts, faces = arrays["rest_pos"].astype(np.float64), arrays["faces"].astype(np.int64)
    skin = drafted_around(name, body)
    assert distance(verts, skin, body["f"]).min() >= 0.003
    corner = verts[faces]
    centres = corner.mean(1)
    assert distance(centres, skin, body["f"]).min() >= 0.003
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    ahead = centres + 0.004 * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    near, far = (distance(points, skin, body["f"]) for points in (centres, ahead))
    assert (far > near).mean() > 0.95


@pytest.mark.parametrize("beta", [-2.0, 2.0])
def test_garment_follows_the_body_shape(
    garment: tuple[str, dict[str, np.ndarray]], body: dict[str, np.ndarray], beta: float
) -> None:
    _, arrays = garment
    for index in range(3):
        verts = arrays.get("skin_pos", arrays["rest_pos"]) + beta * arrays["shapedirs"][..., index].astype(np.float32)
        skin = body["v_template"] + beta * body["shapedirs"][..., index]
        assert (distance(verts, skin, body["f"]) > 0.001).mean() > 0.999


def test_garment_binding_and_pins(garment: tuple[str, dict[str, np.ndarray]]) -> None:
    name, arrays = garment
    weights = arrays["lbs_weights"].astype(np.float32)
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=2e-3)
    pinned = arrays["pinned"]
    assert pinned.dtype == bool
    assert pinned.any() == (name.split("_")[0] in PINNED)
    if pinned.any():
        loops = topology.boundary_loops(arrays["faces"].astype(np.int64))
        assert sum(bool(pinned[loop].any()) for loop in loops) == 1
        waist = max(loops, key=lambda loop: arrays["rest_pos"][loop, 1].mean())
        assert pinned[waist].all()
        assert pinned.mean() < 0.12


def test_garment_texture_coordinates(garment: tuple[str, dict[str, np.ndarray]]) -> None:
    name, arrays = garment
    uv, uv_faces = arrays["uv"], arrays["uv_faces"]
    assert uv_faces.shape == arrays["faces"].shape
    assert uv_faces.min() >= 0
    assert uv_faces.max() < len(uv)
    assert uv.min() >= 0
    assert uv.max() <= 1
    corner = uv.astype(np.float64)[uv_faces]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    # Panels lie side by side, flat, at one scale, none over another or over itself; legs and sleeves have their own.
    assert (area > 0).all()
    assert_no_overlap(corner)
    assert area.sum() <= 1.0
    scale = np.sqrt(area / face_areas(arrays["rest_pos"], arrays["faces"].astype(np.int64)))
    assert np.mean(np.abs(scale / np.median(scale) - 1.0) < 0.25) > 0.9
    num_panels = (
        7 if name in OPENING else 6 if name.split("_")[0] in SLEEVE_ENDS else 4 if LOOPS[name.split("_")[0]] == 3 else 2
    )
    links = np.sort(np.concatenate([uv_faces[:, [0, 1]], uv_faces[:, [1, 2]]]).astype(np.int64), axis=1)
    assert topology.connected_components(len(uv), np.unique(links, axis=0)).max() == num_panels - 1


@pytest.mark.parametrize("name", TOPS)
def test_tops_are_drafted_in_an_a_pose_and_worn_in_the_t_pose(name: str, body: dict[str, np.ndarray]) -> None:
    garment = load_garment(name)
    assert garment.skin_pos is not None
    assert garment.lbs_weights is not None
    posed = posed_body(load_body(), arms_down(45.0), 0, np.zeros(10))
    worn = linear_blend_skinning(
        *(torch.as_tensor(array) for array in (garment.skin_pos, garment.lbs_weights, posed.transforms[None]))
    )[0].numpy()
    # Skinning gives the drafted shape back but for what the T-pose needs to stay outside of the body.
    away = np.linalg.norm(worn - garment.rest_pos, axis=1)
    assert np.percentile(away, 90) < 5e-4
    assert distance(garment.skin_pos, body["v_template"], body["f"]).min() > 0.001


@pytest.mark.parametrize("size", ["", "_4k", "_12k"])
@pytest.mark.parametrize("name", SLEEVE_ENDS)
def test_sleeve_ends_go_around_the_arm_with_little_ease(name: str, size: str) -> None:
    garment = load_garment(name + size)
    lengths = []
    for loop in topology.boundary_loops(garment.faces):
        curve = garment.rest_pos[loop]
        if abs(curve[:, 0].mean()) > 0.2:
            lengths.append(np.linalg.norm(curve - np.roll(curve, 1, axis=0), axis=1).sum())
    low, high = SLEEVE_ENDS[name]
    assert len(lengths) == 2
    assert low <= min(lengths) <= max(lengths) <= high


def test_every_opening_and_the_seams_are_marked(garment: tuple[str, dict[str, np.ndarray]]) -> None:
    name, arrays = garment
    region, faces = arrays["region"], arrays["faces"].astype(np.int64)
    on_rims = np.zeros(len(region), dtype=bool)
    for loop in topology.boundary_loops(faces):
        if name in OPENING and len(loop) > 40:  # neck, front and hem are one loop: of the front nothing is marked but a seam
            assert set(np.unique(region[loop])) == {MARKS.index(mark) for mark in ("seam", "neckline", "hem")}
            on_rims[loop[region[loop] != MARKS.index("seam")]] = True
            continue
        assert len(np.unique(region[loop])) == 1
        on_rims[loop] = True
    marked = {MARKS[index] for index in np.unique(region)}
    assert {"cloth", "seam"} <= marked
    assert not on_rims[(region == MARKS.index("cloth")) | (region == MARKS.index("seam"))].any()
    assert (region[~on_rims] <= MARKS.index("seam")).all()
    if name.split("_")[0] in PINNED:
        assert "waistband" in marked
    # Seams are where panels meet: vertices that lie more than once in the plane.
    copies = np.zeros(len(region), dtype=np.int64)
    pairs = np.unique(np.stack([faces.ravel(), arrays["uv_faces"].astype(np.int64).ravel()], axis=1), axis=0)
    np.add.at(copies, pairs[:, 0], 1)
    on_rims[np.concatenate(topology.boundary_loops(faces))] = True
    np.testing.assert_array_equal(copies[~on_rims] > 1, region[~on_rims] == MARKS.index("seam"))


@pytest.mark.parametrize("name", OPENING)
def test_fronts_are_held_together_by_pairs_opposite_of_each_other(name: str) -> None:
    garment, (row, count) = load_garment(name), OPENING[name]
    assert garment.fasteners is not None
    assert {key: len(pairs) for key, pairs in garment.fasteners.items()} == {row: count}
    pairs = garment.fasteners[row]
    for pos in (garment.rest_pos, garment.skin_pos):
        assert pos is not None
        right, left = pos[pairs[:, 0]], pos[pairs[:, 1]]
        np.testing.assert_allclose(left - right, np.tile([0.004, 0.0, 0.0], (count, 1)), atol=1e-6)
        assert (left[:, 2] > 0.05).all()
    assert (np.diff(garment.rest_pos[pairs[:, 0], 1]) < 0).all()
    assert np.isin(pairs, np.concatenate(topology.boundary_loops(garment.faces))).all()
    assert len(np.unique(pairs)) == 2 * count
    assert garment.lbs_weights is not None
    np.testing.assert_array_equal(garment.lbs_weights[pairs[:, 0]], garment.lbs_weights[pairs[:, 1]])


def test_data_folder_is_small_and_free_of_pickles() -> None:
    files = [path for path in DATA_FOLDER.rglob("*") if path.is_file() and "weights" not in path.parts]
    assert sum(path.stat().st_size for path in files) < 29e6
    assert sum(path.stat().st_size for path in DATA_FOLDER.rglob("*") if path.is_file()) < 52e6
    assert {path.suffix for path in files} <= {".npz", ".json", ".md", ".txt"}

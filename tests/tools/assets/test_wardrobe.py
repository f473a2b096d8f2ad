"""The wardrobe as it is committed, and as it is rebuilt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hood.assets.body.body import Body
from hood.assets.files.library import DATA_FOLDER, names
from hood.assets.garment.binding import posed_body, signed_distances
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.motion.sequence_edit import arms_down
from hood.assets.pattern.designs import DESIGNS, draft
from hood.assets.pattern.measures import measure_body
from hood.mesh.penetration.crossing import self_crossings
from hood.mesh.topology import edge_index, unique_edges
from tools.assets.wardrobe import SIZES, WARDROBE, build_wardrobe, edge_for

EVERY = [f"{name}{ending}" for name in WARDROBE for ending in SIZES]


def test_it_is_complete_and_of_designs() -> None:
    assert set(EVERY) <= set(names("garments"))
    assert len(WARDROBE) >= 12
    assert {piece.design for piece in WARDROBE.values()} <= set(DESIGNS)
    assert sum((DATA_FOLDER / "garments" / f"{name}.npz").stat().st_size for name in EVERY) < 14e6


@pytest.mark.parametrize("name", EVERY)
def test_lengths_are_the_patterns(name: str) -> None:
    garment = load_garment(name)
    ending = name.partition("_")[2]
    assert abs(len(garment.rest_pos) / SIZES[f"_{ending}" if ending else ""] - 1.0) < 0.15
    assert garment.bound
    assert garment.flat is not None
    assert garment.uv is not None
    np.testing.assert_array_equal(garment.flat, garment.uv[garment.uv_faces])
    # Worn on the body that it was made for, it is hardly stretched.
    edges = unique_edges(garment.faces)
    worn = np.linalg.norm(garment.rest_pos[edges[:, 1]] - garment.rest_pos[edges[:, 0]], axis=1)
    sides = np.linalg.norm(np.roll(garment.flat, -1, axis=1) - garment.flat, axis=2)
    if garment.elastic is not None:
        sides *= np.roll(garment.elastic, 1, axis=1)
    number = edge_index(edges, np.stack([garment.faces, np.roll(garment.faces, -1, axis=1)], axis=2).reshape(-1, 2))
    rest = np.bincount(number, sides.ravel()) / np.bincount(number)
    assert np.quantile(worn / rest - 1.0, 0.99) < 0.25


@pytest.mark.parametrize("name", WARDROBE)
def test_nothing_passes_through_anything(name: str, body: Body) -> None:
    garment = load_garment(f"{name}_4k")
    assert len(self_crossings(garment.rest_pos, garment.faces)) == 0
    degrees = 0.0 if np.allclose(garment.rest_pos, garment.worn_pos, atol=1e-3) else 45.0
    skin = posed_body(body, arms_down(degrees), 0, np.zeros(10))
    # Legs of a body that puts on trousers stand apart, arms of one in a poncho lie lower.
    trunk = np.asarray(garment.lbs_weights)[:, [0, 3, 6, 9]].sum(axis=1) > 0.9
    assert trunk.any()
    assert signed_distances(garment.rest_pos[trunk], skin.surface, skin.faces).min() > 0.0


def triangles(faces: np.ndarray) -> set[tuple[int, ...]]:
    """The faces (F, 3), turned so that the least number comes first."""
    first = faces.argmin(axis=1)[:, None]
    return {tuple(face) for face in np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1).tolist()}


def corners(garment: Garment) -> np.ndarray:
    """Places (U, 3) at rest of the vertices of the flat pieces."""
    places = np.empty((len(garment.uv), 3))
    places[garment.uv_faces] = garment.rest_pos[garment.faces]
    return places


def test_a_garment_is_rebuilt(tmp_path: Path, body: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SIZES, "", 1000)
    monkeypatch.delitem(SIZES, "_4k")
    monkeypatch.delitem(SIZES, "_12k")
    (path,) = build_wardrobe(tmp_path, ["poncho"])
    again, shipped = load_garment(path), load_garment("poncho")
    # Processors round differently, and number vertices in another order where two are as good.
    apart, number = cKDTree(again.uv).query(shipped.uv)
    assert len(again.uv) == len(shipped.uv) == len(set(number.tolist()))
    assert apart.max() < 1e-5
    assert triangles(again.uv_faces) == triangles(number[shipped.uv_faces])
    places = [corners(garment) for garment in (again, shipped)]
    assert np.linalg.norm(places[0][number] - places[1], axis=1).max() < 0.02


def test_edges_are_as_long_as_the_number_of_vertices_asks(body: Body) -> None:
    vertices, joints = body.shaped(np.zeros(10))
    pattern = draft("pencil", measure_body(vertices, body.faces, joints))
    assert edge_for(pattern, 1000) > 1.9 * edge_for(pattern, 4000) > 1.9 * 1.6 * edge_for(pattern, 12000)

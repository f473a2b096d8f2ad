"""Subdivision: what stays, what gets nearer to a smooth surface, and a topology that is as sound as before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.assets.garment.garment import Garment
from hood.mesh.editing.repair import find_defects
from hood.mesh.editing.subdivision import Subdivision
from hood.mesh.topology import boundary_loops, unique_edges
from hood.testing import cylinder, grid, sphere


def cap() -> tuple[np.ndarray, np.ndarray]:
    """The upper third of a sphere of radius 1, with a rim that is not smooth."""
    pos, faces = sphere(2)
    return pos, faces[(pos[faces][:, :, 2] > 0.3).all(axis=1)]


@pytest.mark.parametrize("levels", [1, 2])
def test_every_face_becomes_four_and_the_surface_stays_one(levels: int) -> None:
    for pos, faces in (sphere(1), cylinder(9, 5, 0.2, 0.3), grid(4, 3, 0.1), cap()):
        finer = Subdivision(faces, pos, levels)
        assert len(finer.faces) == len(faces) * 4**levels
        assert len(np.unique(finer.faces)) == finer.num_vertices - (len(pos) - len(np.unique(faces)))
        euler = len(np.unique(faces)) - len(unique_edges(faces)) + len(faces)
        assert len(np.unique(finer.faces)) - len(unique_edges(finer.faces)) + len(finer.faces) == euler
        half = np.concatenate([finer.faces[:, [0, 1]], finer.faces[:, [1, 2]], finer.faces[:, [2, 0]]])
        assert len(np.unique(half, axis=0)) == len(half)  # every edge at most once in either direction: manifold, one winding
        assert [len(loop) for loop in boundary_loops(finer.faces)] == [len(loop) * 2**levels for loop in boundary_loops(faces)]


def test_the_mesh_itself_comes_first(garments: dict[str, Garment]) -> None:
    dress = garments["dress"]
    pos = dress.rest_pos + 0.01 * np.sin(40 * dress.rest_pos[:, [1, 2, 0]])
    finer = Subdivision(dress.faces, dress.rest_pos, 2)
    assert np.array_equal(finer.positions(pos)[: len(pos)], pos)
    assert np.array_equal(finer.positions(dress.rest_pos), finer.rest_pos)
    found, usual = find_defects(finer.rest_pos, finer.faces), find_defects(dress.rest_pos, dress.faces)
    assert found.openings == tuple(4 * count for count in usual.openings)
    assert replace(found, openings=usual.openings, edge_length=usual.edge_length) == usual


def test_what_is_flat_stays_flat_and_straight_rims_straight() -> None:
    pos, faces = grid(5, 4, 0.1)
    finer = Subdivision(faces, pos, 2)
    normal = int(np.ptp(pos, axis=0).argmin())
    assert np.abs(finer.rest_pos[:, normal] - pos[0, normal]).max() < 1e-15
    for axis in {0, 1, 2} - {normal}:  # the outline is the same: corners of the sheet stay corners
        assert finer.rest_pos[:, axis].min() == pytest.approx(pos[:, axis].min(), abs=1e-15)
        assert finer.rest_pos[:, axis].max() == pytest.approx(pos[:, axis].max(), abs=1e-15)
    on_edges = finer.rest_pos[len(pos) :][: len(unique_edges(faces))]
    np.testing.assert_allclose(Subdivision(faces, pos, 1).rest_pos[len(pos) :], on_edges)
    np.testing.assert_allclose(on_edges, pos[unique_edges(faces)].mean(axis=1), atol=1e-15)


def test_a_sphere_gets_nearer_to_the_sphere() -> None:
    pos, faces = sphere(2)
    flat = 1.0 - np.linalg.norm(pos[unique_edges(faces)].mean(axis=1), axis=1).min()
    middles = [1.0 - np.linalg.norm(pos[faces].mean(axis=1), axis=1).min()]
    for levels in (1, 2):
        finer = Subdivision(faces, pos, levels)
        assert np.abs(np.linalg.norm(finer.rest_pos, axis=1) - 1.0).max() < flat / 10
        middles.append(np.abs(np.linalg.norm(finer.rest_pos[finer.faces].mean(axis=1), axis=1) - 1.0).max())
    assert middles[1] < 0.35 * middles[0]
    assert middles[2] < 0.5 * middles[1]
    cut, some = cap()
    inner = Subdivision(some, cut, 1)
    new = np.setdiff1d(np.arange(len(cut), inner.num_vertices), np.concatenate(boundary_loops(inner.faces)))
    assert len(new) > 50
    assert np.abs(np.linalg.norm(inner.rest_pos[new], axis=1) - 1.0).max() < flat / 2


def test_a_rim_is_a_curve_of_its_own() -> None:
    """A tube's end: near its circle, and the same whatever the rest of the tube does."""
    pos, faces = cylinder(16, 5, 0.2, 0.3)
    loop = boundary_loops(faces)[0]
    finer = Subdivision(faces, pos, 1)
    new = np.setdiff1d(boundary_loops(finer.faces)[0], loop)
    axis = int(np.ptp(pos[loop], axis=0).argmin())
    plane = [at for at in range(3) if at != axis]
    centre = pos[loop][:, plane].mean(axis=0)
    radius = np.linalg.norm(finer.rest_pos[new][:, plane] - centre, axis=1)
    on = np.linalg.norm(pos[loop][:, plane] - centre, axis=1)
    assert np.abs(radius - on.mean()).max() < 0.05 * on.mean() * (1 - np.cos(np.pi / 16))
    moved = pos.copy()
    rest = np.setdiff1d(np.arange(len(pos)), loop)
    moved[rest] += np.random.default_rng(0).normal(0, 0.02, (len(rest), 3))
    assert np.array_equal(finer.positions(moved)[new], finer.positions(pos)[new])


def test_the_finer_mesh_turns_and_moves_with_the_mesh(garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    finer = Subdivision(tank.faces, tank.rest_pos, 1)
    turn, shift = Rotation.from_rotvec([0.4, -1.0, 0.2]), np.array([3.0, -2.0, 1.0])
    found = finer.positions(turn.apply(tank.rest_pos) + shift)
    np.testing.assert_allclose(found, turn.apply(finer.rest_pos) + shift, atol=1e-12)


def test_seams_of_three_faces_and_degenerate_faces_are_no_obstacle() -> None:
    pos = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0.2], [0, 0, 1], [0.5, 0, 0]], dtype=float)
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 5, 1]])  # three at one edge, and one without area
    finer = Subdivision(faces, pos, 2)
    assert np.isfinite(finer.rest_pos).all()
    assert len(finer.faces) == 64
    broken = finer.positions(np.where(np.arange(6)[:, None] == 4, np.nan, pos))
    assert np.isfinite(broken[:4]).all()


def test_values_marks_and_texture_are_carried(garments: dict[str, Garment]) -> None:
    pos, faces = grid(4, 3, 0.1)
    finer = Subdivision(faces, pos, 2)
    np.testing.assert_allclose(finer.spread(pos @ [1.0, 2.0, 3.0]), finer.rest_pos @ [1.0, 2.0, 3.0], atol=1e-14)
    assert finer.spread(pos.astype(np.float32)[:, 0]).dtype == np.float32
    pieces = np.where(pos[:, 0] > pos[:, 0].mean(), 1, 0)
    assert set(finer.marks(pieces).tolist()) == {0, 1}
    dress = garments["dress"]
    assert dress.uv is not None
    uv_faces = dress.faces if dress.uv_faces is None else dress.uv_faces
    uv, corners = Subdivision(dress.faces, dress.rest_pos, 1).texture(dress.uv, uv_faces)
    count = len(dress.faces)
    assert len(corners) == 4 * count
    for part in range(4):  # a quarter of every triangle of texture
        old, new = dress.uv[uv_faces], uv[corners[part * count : (part + 1) * count]]
        area = [np.abs(np.linalg.det(t[:, 1:] - t[:, :1])) for t in (old, new)]
        np.testing.assert_allclose(area[1], area[0] / 4, atol=1e-9)

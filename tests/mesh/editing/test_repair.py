"""Repairs undo exactly the damage they are for."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh import topology
from hood.mesh.editing import repair
from hood.mesh.editing.repair import find_defects
from hood.testing import cylinder, grid, sphere, strip


def torn_tube() -> tuple[np.ndarray, np.ndarray, int]:
    """A tube cut open along a line: the vertices of the cut are there twice."""
    pos, faces = cylinder(12, 6)
    seam = np.arange(6) * 12
    crossing = (np.isin(faces, seam).any(axis=1)) & (np.isin(faces % 12, [11]).any(axis=1))
    double = np.full(len(pos), -1)
    double[seam] = len(pos) + np.arange(6)
    faces = faces.copy()
    faces[crossing] = np.where(np.isin(faces[crossing], seam), double[faces[crossing]], faces[crossing])
    return np.concatenate([pos, pos[seam]]), faces, len(seam)


def test_welding_closes_a_torn_tube() -> None:
    pos, faces, count = torn_tube()
    assert len(topology.boundary_loops(faces)) == 1
    welded = repair.weld(pos, faces, repair.weld_tolerance(pos, faces))
    assert len(pos) - len(welded.kept) == count
    new = welded.vertex_map[faces]
    assert [len(loop) for loop in topology.boundary_loops(new)] == [12, 12]
    np.testing.assert_array_equal(pos[welded.kept][new], pos[faces])


def test_welding_leaves_layers_apart() -> None:
    """Two sheets on top of each other touch in all vertices; only their rims are boundaries, and those join."""
    pos, faces = grid(5, 5)
    both, double = np.concatenate([pos, pos]), np.concatenate([faces, faces + len(pos)])
    welded = repair.weld(both, double, 1e-6)
    rim = len(repair.boundary_vertices(faces))
    assert len(both) - len(welded.kept) == rim
    assert len(pos) - rim == 9  # inner vertices are still two each


def test_a_large_tolerance_does_not_eat_the_mesh() -> None:
    pos, faces = strip(8, length=1.0, width=0.1)
    welded = repair.weld(pos, faces, 0.11)  # beyond the width: only vertices without a common face are near enough
    assert not repair.broken_faces(pos[welded.kept], welded.vertex_map[faces]).any()


@pytest.mark.parametrize("mesh", [grid(6, 5), cylinder(), sphere(1)])
def test_flipped_faces_are_found(mesh: tuple[np.ndarray, np.ndarray]) -> None:
    _, faces = mesh
    assert not repair.flipped_faces(faces).any()
    wrong = np.zeros(len(faces), dtype=bool)
    wrong[[1, 4, 7]] = True
    damaged = faces.copy()
    damaged[wrong] = damaged[wrong][:, ::-1]
    np.testing.assert_array_equal(repair.flipped_faces(damaged), wrong)


def test_a_moebius_strip_ends() -> None:
    """It cannot be oriented; the answer is some colouring, not an endless search."""
    i = np.arange(6)
    pairs = np.stack([i, (i + 1) % 6], 1)
    top, bottom = pairs, pairs + 6
    bottom[-1], top[-1] = [11, 0], [5, 6]
    faces = np.concatenate(
        [np.stack([top[:, 0], bottom[:, 0], top[:, 1]], 1), np.stack([bottom[:, 0], bottom[:, 1], top[:, 1]], 1)]
    )
    assert repair.flipped_faces(faces).shape == (len(faces),)


def test_defects_are_counted() -> None:
    pos, faces = grid(6, 6)
    sound = find_defects(pos, faces)
    assert sound.none
    assert sound.openings == (20,)
    assert sound.num_components == 1
    pos = np.concatenate([pos, [[9.0, 9, 9]]])
    flipped = faces[3, ::-1]
    bad = np.concatenate([faces[:3], [flipped], faces[4:], faces[:2, [1, 2, 0]], [[5, 5, 7]]])
    found = find_defects(pos, bad)
    assert (found.duplicate_faces, found.broken_faces, found.isolated_vertices) == (2, 1, 1)
    assert not found.none
    assert find_defects(*torn_tube()[:2]).unwelded_vertices == 6


def test_an_edge_of_three_faces_is_reported() -> None:
    pos = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1.0]])
    found = find_defects(pos, np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert found.non_manifold_edges == 1
    assert find_defects(pos * [1, 1e-3, 1], np.array([[0, 1, 2]])).slivers == 1


def test_seams_of_a_moving_mesh_are_sewn_where_they_stay_closed() -> None:
    pos, faces = grid(4, 4, 1.0)
    soup = pos[faces].reshape(-1, 3)
    loose = np.arange(len(soup)).reshape(-1, 3)
    sewn = repair.sew_moving(np.stack([soup, soup + 1.0]), loose)
    np.testing.assert_allclose(soup[sewn], pos[faces])
    assert len(topology.boundary_loops(sewn)) == 1
    assert len(topology.unique_edges(sewn)) == len(topology.unique_edges(faces))
    apart = soup.copy()
    apart[:3] += [0.0, 0.0, 0.5]  # the first face leaves its neighbours
    opened = repair.sew_moving(np.stack([soup, apart]), loose)
    others = opened[1:]
    assert not np.isin(opened[0], others).any()

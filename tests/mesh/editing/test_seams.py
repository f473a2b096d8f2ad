"""Rims that face each other are found and sewn, whatever the spacing of their vertices."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh.editing import repair
from hood.mesh.editing.seams import Facing, along, along_corners, cut_edges, find_facing, find_rims, ways_out
from hood.mesh.parts import part_labels
from hood.testing import cylinder


def two_sheets(first: int, second: int, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Two sheets of a metre side by side, with so many vertices along the sides that face each other."""
    sheets = []
    for count in (first, second):
        u, v = np.meshgrid(np.linspace(0.0, 1.0, 5), np.linspace(0.0, 1.0, count), indexing="ij")
        sheets.append((np.stack([u, v, np.zeros_like(u)], axis=2).reshape(-1, 3), _table(5, count)))
    (one, faces), (other, table) = sheets
    return np.concatenate([one, other + [1.0 + gap, 0.0, 0.0]]), np.concatenate([faces, table + len(one)])


def _table(rows: int, columns: int) -> np.ndarray:
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    return np.concatenate([np.stack(face, axis=2).reshape(-1, 3) for face in ((a, b, c), (a, c, d))])


def sewn(pos: np.ndarray, faces: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray, Facing]:
    rims = find_rims(faces)
    facing = find_facing(pos, rims, part_labels(len(pos), faces), gap, lambda seam: True)
    cut = cut_edges(faces, len(pos), rims.face[facing.cut[:, 1]], rims.corner[facing.cut[:, 1]], facing.at)
    places = along(cut, pos)
    new = np.stack([facing.cut[:, 0], len(pos) + np.arange(len(facing.cut))], axis=1)
    merged = repair.merge(len(places), np.concatenate([facing.pairs, new]))
    return places[merged.kept], merged.vertex_map[cut.faces], facing


@pytest.mark.parametrize(("first", "second"), [(6, 6), (6, 11), (11, 6), (6, 7), (9, 16)])
@pytest.mark.parametrize("gap", [0.0, 1e-3, 5e-3])
def test_two_sheets_become_one_without_a_hole(first: int, second: int, gap: float) -> None:
    pos, faces = two_sheets(first, second, gap)
    places, table, facing = sewn(pos, faces, 6e-3)
    assert len(np.unique(part_labels(len(places), table))) == 1
    (seam,) = facing.seams
    assert seam.length == pytest.approx(1.0, abs=0.3)  # with half of the edges beyond it
    assert seam.gap == pytest.approx(gap, abs=1e-9)
    edges, times = np.unique(np.sort(table[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    assert times.max() == 2
    open_edges = places[edges[times == 1]].mean(axis=1)
    assert not ((np.abs(open_edges[:, 0] - 1.0) < 0.05) & (open_edges[:, 1] > 0.02) & (open_edges[:, 1] < 0.98)).any()
    assert not repair.broken_faces(places, table).any()
    corners = places[table]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert area.sum() == pytest.approx(2.0, abs=0.05)


def test_sheets_that_meet_in_a_corner_are_not_sewn() -> None:
    pos, faces = two_sheets(6, 6, 1e-3)
    count = len(pos) // 2
    pos[count:] += [0.0, 0.99, 0.0]
    assert find_facing(pos, find_rims(faces), part_labels(len(pos), faces), 6e-3, lambda seam: True).seams == []


@pytest.mark.parametrize(
    ("gap", "along", "least", "most"),
    [(0.0, 0.0, 0.8, 1.0), (3e-3, 0.0, 0.8, 1.0), (-3e-3, 0.0, 0.0, 0.0), (0.0, 0.01, 0.3, 0.7)],
    ids=["at each other", "apart", "over each other", "crossing"],
)
def test_sheets_that_do_not_overlap_end_in_front_of_each_other(gap: float, along: float, least: float, most: float) -> None:
    """Corners aside. The second one is 1 mm above the first, and turned by what moves its ends by ``along`` [m]."""
    pos, faces = two_sheets(30, 41, gap)
    second = slice(150, None)
    pos[second] += np.stack([along * (pos[second, 1] - 0.5), 0.0 * pos[second, 1], 1e-3 + 0.0 * pos[second, 1]], axis=1)
    (seam,) = find_facing(pos, find_rims(faces), part_labels(len(pos), faces), 6e-3, lambda seam: True).seams
    assert least <= seam.in_front <= most


def test_ways_out_lead_along_the_mesh_and_are_zero_within() -> None:
    pos, faces = cylinder(12, 5)
    ways, rims = ways_out(pos, find_rims(faces)), find_rims(faces).vertices
    axis = int(np.argmin(np.abs(ways[rims].sum(axis=0)) - np.abs(ways[rims]).sum(axis=0)))
    side = np.sign(pos[rims, axis] - pos[:, axis].mean())
    np.testing.assert_allclose(ways[rims], side[:, None] * np.eye(3)[axis], atol=1e-9)
    assert not np.delete(ways, rims, axis=0).any()


def test_a_cut_edge_carries_what_its_ends_carry() -> None:
    faces = np.array([[0, 1, 2]])
    cut = cut_edges(faces, 3, np.array([0, 0, 0]), np.array([0, 0, 1]), np.array([0.25, 0.75, 0.5]))
    pos = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    places = along(cut, pos)
    np.testing.assert_allclose(places[3:], [[0.25, 0, 0], [0.75, 0, 0], [0.5, 0.5, 0]])
    table, values = along_corners(cut, faces, pos[:, :2])
    np.testing.assert_allclose(values[table], places[cut.faces][..., :2])
    corners = places[cut.faces]
    area = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert (area > 0.0).all()
    assert area.sum() == pytest.approx(0.5)
    assert (cut.parent == 0).all()

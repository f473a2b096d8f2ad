"""Edges flipped and vertices relaxed on a flat sheet."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh import topology
from hood.mesh.editing.remeshing import flip_edges, relax


@pytest.fixture
def sheet() -> tuple[np.ndarray, np.ndarray]:
    """A flat 9 x 9 grid over [0, 1]², facing +z."""
    side = np.linspace(0, 1, 9)
    x, y = np.meshgrid(side, side, indexing="ij")
    verts = np.stack([x.ravel(), y.ravel(), np.zeros(81)], axis=1)
    at = np.arange(81).reshape(9, 9)
    low, right, up, far = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[:-1, 1:], at[1:, 1:]))
    faces = np.concatenate([np.stack([low, right, far], axis=1), np.stack([low, far, up], axis=1)])
    return verts, faces


def area(verts: np.ndarray, faces: np.ndarray) -> float:
    corner = verts[faces]
    return float(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2].sum() / 2)


def test_relax_keeps_the_plane_and_evens_out_the_triangles(sheet: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = sheet
    noise = np.zeros_like(verts)
    inner = (np.abs(verts[:, :2] - 0.5) < 0.45).all(1)
    noise[inner, :2] = np.random.default_rng(0).uniform(-0.03, 0.03, (int(inner.sum()), 2))
    edges = topology.unique_edges(faces)

    def spread(points: np.ndarray) -> float:
        return float(np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1).std())

    relaxed = relax(verts + noise, faces, 20)
    assert np.abs(relaxed[:, 2]).max() < 1e-12
    assert spread(relaxed) < spread(verts + noise)


def test_flip_edges_makes_the_grid_delaunay_and_keeps_the_winding() -> None:
    verts = np.array([[0.0, 0, 0], [1, 0.0, 0], [0.5, 0.1, 0], [0.5, -0.1, 0]])
    flipped = flip_edges(verts, np.array([[0, 1, 2], [1, 0, 3]]))
    assert {2, 3} <= set(flipped[0]) & set(flipped[1])
    assert area(verts, flipped) == pytest.approx(area(verts, np.array([[0, 1, 2], [1, 0, 3]])))
    assert area(verts, flipped[:1]) > 0

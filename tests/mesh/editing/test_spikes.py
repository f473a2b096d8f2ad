"""Thorns are found in meshes of any spacing, and nothing else is one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from garment_kinds import Mesh, clean, normals, refined

from hood.mesh.editing.repair import boundary_vertices, duplicate_faces, find_spikes
from hood.testing import grid

GARMENTS = ("tshirt", "tank", "longsleeve", "dress", "skirt", "shorts", "trousers", "jacket", "shirt")
LEAST = 0.05


def clustered(mesh: Mesh, cell: float) -> Mesh:
    """Vertices drawn together in cells of ``cell`` [m]."""
    pos, faces = mesh
    _, own = np.unique(np.floor(pos / cell).astype(int), axis=0, return_inverse=True)
    own = own.reshape(-1)
    middle = np.stack([np.bincount(own, pos[:, axis]) / np.bincount(own) for axis in range(3)], axis=1)
    table = own[faces]
    table = table[(table != np.roll(table, 1, axis=1)).all(axis=1)]
    return middle, table[~duplicate_faces(table)]


def graded(factor: float) -> Mesh:
    """A sheet whose rows and columns are ``factor`` times as wide as the ones before."""
    pos, faces = grid(9, 9, 1.0)
    steps = np.cumsum(factor ** np.arange(9))
    return np.take(steps / steps[-1], np.round(8 * (pos - pos.min(axis=0))).astype(int)), faces


def fan(sides: int, height: float) -> Mesh:
    """A disc of 10 cm radius or a pointed cap: one vertex and a rim."""
    angle = 2 * np.pi * np.arange(sides) / sides
    rim = 0.1 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    rows = np.arange(sides)
    faces = np.stack([rows, np.roll(rows, -1), np.full(sides, sides)], axis=1)
    return np.concatenate([rim, [[0.0, height, 0.0]]]), faces


@pytest.mark.parametrize("name", GARMENTS)
@pytest.mark.parametrize(
    "make", [lambda mesh: mesh, refined, lambda mesh: clustered(mesh, 0.08)], ids=["as it is", "fine", "coarse"]
)
def test_a_vertex_that_is_pulled_out_is_one_and_before_none(name: str, make: Callable[[Mesh], Mesh]) -> None:
    pos, faces = make(clean(name))
    assert len(find_spikes(pos, faces, LEAST).vertices) == 0
    inner = np.setdiff1d(np.unique(faces), boundary_vertices(faces))
    chosen = np.array([inner[len(inner) // 3], boundary_vertices(faces)[5]])
    out = pos.copy()
    out[chosen] += 1.5 * normals(pos, faces)[chosen]
    found = find_spikes(out, faces, LEAST)
    assert sorted(found.vertices) == sorted(chosen)
    assert (np.abs(found.height - 1.5) < 0.2).all()
    assert (found.ratio > 5).all()


NONE = {
    "columns twice as wide as the ones before": graded(2.0),
    "columns three times as wide": graded(3.0),
    "a sheet with corners": grid(4, 4, 1.0),
    "two triangles": grid(2, 2, 1.0),
    "a flat cap": fan(60, 0.0),
    "a cap": fan(60, 0.1),
    "a pointed hat": fan(48, 0.35),
}


@pytest.mark.parametrize("name", NONE)
def test_other_long_edges_are_none(name: str) -> None:
    assert len(find_spikes(*NONE[name], LEAST).vertices) == 0


def test_what_is_too_short_to_be_seen_is_none() -> None:
    pos, faces = grid(41, 41, 0.2)
    pos[840] += [0.0, 0.04, 0.0]
    assert len(find_spikes(pos, faces, 0.03).vertices) == 1
    assert len(find_spikes(pos, faces, LEAST).vertices) == 0

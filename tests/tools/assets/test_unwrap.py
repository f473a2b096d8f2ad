"""Panels of a garment laid flat, on shapes that are known."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from hood.mesh import topology
from hood.mesh.editing.remeshing import isotropic
from hood.testing import cylinder
from tools.assets.unwrap import flatten, panels, unwrap

Surface = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def sleeve() -> Surface:
    """An upright tube of radius 0.1 and height 0.3, open at both ends."""
    verts, faces = cylinder(36, 17, radius=0.1, height=0.3)
    return verts + [0.0, 0.05, 0.0], faces


def areas(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corner = verts[faces]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)


def test_a_sleeve_has_two_panels_that_lie_flat_without_stretch(sleeve: Surface) -> None:
    verts, faces = isotropic(*sleeve, 400)
    panel = panels(verts, faces)
    assert set(np.unique(panel)) == {0, 1}
    assert 0.45 < panel.mean() < 0.55
    facing = np.cross(verts[faces[:, 1]] - verts[faces[:, 0]], verts[faces[:, 2]] - verts[faces[:, 0]])[:, 2]
    assert facing[panel == 0].mean() > 0 > facing[panel == 1].mean()
    uv, uv_faces = unwrap(verts, faces, panel)
    flat = np.concatenate([uv, np.zeros((len(uv), 1))], axis=1).astype(np.float64)
    corner = flat[uv_faces]
    signed = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2] / 2
    assert signed.min() > 0
    scale = np.sqrt(signed / areas(verts, faces))
    assert scale.max() / scale.min() < 1.1
    assert (uv.min(), uv.max()) >= (0.0, 0.0)
    assert uv.max() <= 1.0
    assert uv[uv_faces[panel == 0], 0].max() < uv[uv_faces[panel == 1], 0].min()


def test_a_part_has_panels_of_its_own(sleeve: Surface) -> None:
    verts, faces = isotropic(*sleeve, 400)
    panel = panels(verts, faces, [verts[:, 0]])
    assert set(np.unique(panel)) == {0, 1, 2, 3}
    assert verts[faces[panel < 2], 0].mean() > 0 > verts[faces[panel >= 2], 0].mean()
    uv, uv_faces = unwrap(verts, faces, panel)
    assert topology.connected_components(len(uv), topology.unique_edges(uv_faces)).max() == 3
    ends = [(uv[uv_faces[panel == side], 0].min(), uv[uv_faces[panel == side], 0].max()) for side in range(4)]
    assert all(one[1] < other[0] for one, other in pairwise(ends))


def test_half_a_cylinder_flattens_to_its_own_rectangle() -> None:
    angle, height = np.meshgrid(np.linspace(0.0, np.pi, 13), np.linspace(0.0, 0.3, 7), indexing="ij")
    verts = np.stack([-0.1 * np.cos(angle), height, 0.1 * np.sin(angle)], axis=-1).reshape(-1, 3)
    at = np.arange(91).reshape(13, 7)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    plane = flatten(verts, faces)
    edges = topology.unique_edges(faces)
    length = np.linalg.norm(plane[edges[:, 0]] - plane[edges[:, 1]], axis=1)
    np.testing.assert_allclose(length, np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1), rtol=0.02)

"""The tailor's surface operations that need no build-time package."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh import topology
from hood.testing import cylinder
from tools.assets import remesh


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


def test_cut_keeps_exactly_the_positive_side(sheet: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = sheet
    kept, kept_faces = remesh.cut(verts, faces, 0.53 + 0.2 * verts[:, 1] - verts[:, 0])
    # A linear function is cut without error; the winding stays, so the signed area is that of the trapezium.
    assert area(kept, kept_faces) == pytest.approx(0.63)
    assert (0.53 + 0.2 * kept[:, 1] - kept[:, 0]).min() > -1e-12
    assert len(topology.boundary_loops(kept_faces)) == 1


def test_cut_through_vertices_makes_no_empty_faces(sheet: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = sheet
    kept, kept_faces = remesh.cut(verts, faces, 0.5 - verts[:, 0])
    assert area(kept, kept_faces) == pytest.approx(0.5, abs=1e-6)


def test_largest_component(sheet: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = sheet
    two = np.concatenate([verts, verts[:3] + 5.0]), np.concatenate([faces, [[81, 82, 83]]])
    kept, kept_faces = remesh.largest_component(*two)
    np.testing.assert_array_equal(kept, verts)
    np.testing.assert_array_equal(kept_faces, faces)


def test_collapse_short_removes_the_sliver(sheet: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = sheet
    squeezed = verts.copy()
    squeezed[40] = squeezed[41] - [0.0, 0.01, 0.0]
    kept, kept_faces = remesh.collapse_short(squeezed, faces, 0.5)
    assert len(kept) == 80
    assert len(kept_faces) == len(faces) - 2
    assert area(kept, kept_faces) == pytest.approx(1.0)


def test_diffuse_keeps_constants_and_damps_noise(sheet: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = sheet
    values = np.stack([np.ones(81), np.random.default_rng(1).normal(size=81)], axis=1)
    smooth = remesh.diffuse(values, verts, faces, 0.3)
    np.testing.assert_allclose(smooth[:, 0], 1.0)
    assert smooth[:, 1].std() < 0.3 * values[:, 1].std()


def test_missing_build_package_says_how_to_get_it() -> None:
    with pytest.raises(ImportError, match=r"pip install \"hood-cloth\[assets\]\""):
        remesh.require("no_such_package_anywhere")


@pytest.mark.parametrize("num_vertices", [6, 12, 40])
def test_smoothing_keeps_the_length_of_openings(num_vertices: int) -> None:
    verts, faces = cylinder(num_vertices, 3, radius=0.035, height=0.1)
    (loop, _), smooth = topology.boundary_loops(faces), remesh.smooth_loops(verts, faces, 6)
    before, after = (np.linalg.norm(pos[loop] - np.roll(pos[loop], 1, axis=0), axis=1).sum() for pos in (verts, smooth))
    assert after == pytest.approx(before, rel=0.01)

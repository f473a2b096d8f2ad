"""Modes of a surface: waves of known length, orthonormal, the same for any order of the vertices."""

from __future__ import annotations

import numpy as np
import pytest

from hood.evaluation import spectrum
from hood.evaluation.spectrum import cotangent_laplacian, surface_modes
from hood.testing import cylinder, grid


def test_linear_functions_have_no_curvature() -> None:
    """Cotangent weights are exact on the plane: inside a sheet a linear function has the Laplacian 0."""
    pos, faces = grid(7, 5, 1.0)
    stiffness, area = cotangent_laplacian(pos, faces)
    border = np.zeros(len(pos), dtype=bool)
    edges, counts = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    border[edges[counts == 1]] = True
    residual = stiffness @ (pos @ np.array([1.0, 2.0, -3.0]))
    assert np.abs(residual[~border]).max() < 1e-12
    assert np.abs(residual[border]).max() > 1e-3
    assert np.abs(stiffness @ np.ones(len(pos))).max() < 1e-12
    spans = np.ptp(pos, axis=0)
    assert area.sum() == pytest.approx(np.prod(spans[spans > 1e-9]))


def test_waves_on_a_sheet_have_their_length() -> None:
    """Free borders: cos(π x / size) is the longest wave, of length 2 size; two of them, then the product, 2 size / √2."""
    pos, faces = grid(24, 24, 1.0)
    modes = surface_modes(pos, faces)
    size = np.ptp(pos, axis=0).max()
    assert np.isinf(modes.wavelengths[0])
    assert modes.wavelengths[1:4] == pytest.approx([2 * size, 2 * size, 2**0.5 * size], rel=0.01)


def test_modes_are_orthonormal_and_complete() -> None:
    pos, faces = cylinder(10, 6)
    modes = surface_modes(pos, faces)
    gram = modes.vectors.T @ (modes.area[:, None] * modes.vectors)
    assert modes.complete
    assert gram == pytest.approx(np.eye(len(pos)), abs=1e-9)
    assert (np.diff(modes.wavelengths[1:]) <= 1e-12).all()
    values = np.random.default_rng(0).normal(size=(len(pos), 3))
    assert modes.project(values, np.ones(len(pos), dtype=bool)) == pytest.approx(values, abs=1e-9)


def test_two_components_have_two_constants_and_lone_vertices_none() -> None:
    pos, faces = grid(5, 5, 1.0)
    pair = np.concatenate([pos, [[9.0, 9.0, 9.0]], pos + 5.0])
    modes = surface_modes(pair, np.concatenate([faces, faces + len(pos) + 1]))
    assert np.isinf(modes.wavelengths).sum() == 2
    assert len(pos) not in modes.vertices
    values = np.random.default_rng(0).normal(size=(len(pair), 3))
    assert (modes.project(values, modes.wavelengths > 0)[len(pos)] == 0).all()


def test_the_longest_alone_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    pos, faces = cylinder(20, 12)
    whole = surface_modes(pos, faces)
    monkeypatch.setattr(spectrum, "DENSE_VERTICES", 10)
    monkeypatch.setattr(spectrum, "NUM_LONGEST", 15)
    part = surface_modes(pos, faces)
    assert not part.complete
    assert part.wavelengths == pytest.approx(whole.wavelengths[:15], rel=1e-6)
    gram = part.vectors.T @ (part.area[:, None] * part.vectors)
    assert gram == pytest.approx(np.eye(15), abs=1e-8)


def test_a_face_without_area_is_named() -> None:
    pos, faces = grid(3, 3, 1.0)
    faces = np.concatenate([faces, [[0, 1, 1]]])
    with pytest.raises(ValueError, match=f"face {len(faces) - 1} has no area"):
        surface_modes(pos, faces)

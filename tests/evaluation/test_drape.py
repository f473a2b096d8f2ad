"""The drape test: what shadows measure, the mesh of the sample, and cloth whose drape is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from hood.assets.material import Material, bending_length, measured
from hood.cloth.cloth import build_cloth
from hood.evaluation.drape import DISC, SAMPLE, cast_shadow, coefficient_of, drape, folds_of, sample_mesh, settled

COARSE = 0.03


def board(shear: float = 50.0, bending: float = 1e-5) -> Material:
    return measured(0.2, 2.5 * shear, 2.5 * shear, shear, bending, bending)


def test_the_mesh_is_a_ring_of_nearly_equilateral_triangles() -> None:
    pos, faces = sample_mesh(0.01)
    radius = np.hypot(pos[:, 0], pos[:, 2])
    corners = pos[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert area.sum() == pytest.approx(math.pi * (SAMPLE**2 - DISC**2), rel=0.01)
    hangs = radius[faces].max(axis=1) > DISC + 1e-9
    lengths = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2)[hangs]
    assert np.median(lengths) == pytest.approx(0.01, rel=0.05)
    assert lengths.max() / lengths.min() < 2.5
    edges, count = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    rims = radius[edges[count == 1]].reshape(-1)
    assert np.unique(count).tolist() == [1, 2]
    assert np.all((np.abs(rims - SAMPLE) < 1e-9) | (rims < DISC))


def test_the_shadow_of_a_flat_sample_is_all_of_it_and_that_of_none_the_disc() -> None:
    pos, faces = sample_mesh(0.01)
    assert coefficient_of(cast_shadow(pos, faces)) == pytest.approx(1.0, abs=0.01)
    assert coefficient_of(cast_shadow(pos, faces[:0])) == pytest.approx(0.0, abs=0.002)
    tilted = pos.copy()
    tilted[:, [0, 2]] *= 0.8  # lifted evenly into a cone, its shadow is a circle of 0.8 of the radius
    expected = ((0.8 * SAMPLE) ** 2 - DISC**2) / (SAMPLE**2 - DISC**2)
    assert coefficient_of(cast_shadow(tilted, faces)) == pytest.approx(expected, abs=0.01)


def test_a_shadow_does_not_depend_on_the_winding() -> None:
    pos, faces = sample_mesh(COARSE)
    np.testing.assert_array_equal(cast_shadow(pos, faces), cast_shadow(pos, faces[:, [0, 2, 1]]))


@pytest.mark.parametrize("count", [4, 7])
def test_folds_are_the_waves_of_the_rim(count: int) -> None:
    angle = 2 * np.pi * np.arange(90) / 90
    radius = 0.12 + 0.01 * np.cos(count * angle) + 0.002 * np.cos(11 * angle)
    assert folds_of(np.stack([radius * np.cos(angle), 0 * angle, radius * np.sin(angle)], axis=1)) == count
    assert folds_of(np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)) == 0


def test_cloth_drapes_between_nothing_and_a_board() -> None:
    stiff, soft = drape(board(5000.0, 1e-2), COARSE), drape(board(), COARSE)
    assert stiff.rest.coefficient > 0.98
    assert stiff.rest.folds == 0
    assert 0.2 < soft.rest.coefficient < 0.7
    assert 4 <= soft.rest.folds <= 10
    assert stiff.rest.reached
    assert all(state.reached for state in soft.states)
    energies = [state.energy for state in soft.states]
    assert energies == sorted(energies)
    assert energies[0] < 0 < -energies[-1]  # every state is below the flat sample


def test_the_same_fabric_gives_the_same_drape() -> None:
    first, second = drape(board(), COARSE), drape(board(), COARSE)
    np.testing.assert_array_equal(first.rest.pos, second.rest.pos)


def test_edges_out_of_bounds_are_refused() -> None:
    with pytest.raises(ValueError, match="edge=0.1: a sample is meshed with edges of 0.002 to 0.03 m"):
        drape(Material(), 0.1)


def test_a_strip_bends_by_its_bending_length() -> None:
    """Peirce 1930: a strip whose tip hangs 41.5° below its clamp overhangs by twice its bending length (0.509 of it is c)."""
    rigidity, density, edge = 1.3e-5, 0.26, 0.002
    length = bending_length(rigidity, density) / (math.cos(math.radians(20.75)) / (8 * math.tan(math.radians(41.5)))) ** (1 / 3)
    height = edge * math.sqrt(3) / 2
    rows, columns = round(length / height), 8
    across, along = np.meshgrid(np.arange(columns), np.arange(rows + 1))
    place = (across + 0.5 * (along % 2)) * edge
    clamp = np.stack([np.arange(columns) * edge + 0.5 * edge, np.full(columns, -0.02 * edge)], axis=1)
    flat = np.concatenate([clamp, np.stack([place, along * length / rows], axis=-1).reshape(-1, 2)])
    faces = []
    for row in range(rows + 1):
        for column in range(columns - 1):
            a, c = row * columns + column, (row + 1) * columns + column
            shifted = row % 2 == 0  # the clamp is, and every second row of the strip
            faces += [(a, a + 1, c + 1), (a, c + 1, c)] if shifted else [(a, a + 1, c), (a + 1, c + 1, c)]
    pos = np.stack([flat[:, 0], 0 * flat[:, 0], flat[:, 1]], axis=1)
    held = flat[:, 1] < 1e-9
    material = measured(density, 250.0, 250.0, 100.0, rigidity, rigidity)
    rest, reached = settled(build_cloth(pos, np.array(faces), material, held, dtype=torch.float64), pos)
    assert reached
    tip = rest[-columns:].mean(axis=0)
    assert math.degrees(math.atan2(-tip[1], tip[2])) == pytest.approx(41.5, abs=1.5)

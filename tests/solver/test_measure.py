"""Reported measures: strain and penetration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.solver.step_figures import PENETRATION_METRICS, _quantile, edge_strain, penetration_metrics, strain_metrics
from hood.testing import grid, plane_contact

CLOTH = build_cloth(*grid(6, 6, 0.5), Material(), dtype=torch.float64)


def test_uniform_stretch_is_the_strain_of_every_edge() -> None:
    torch.testing.assert_close(edge_strain(CLOTH, 1.2 * CLOTH.rest_pos), torch.full((len(CLOTH.edges),), 0.2).double())
    assert float(edge_strain(CLOTH, 0.9 * CLOTH.rest_pos).max()) == pytest.approx(-0.1)


def test_gathered_edges_are_strained_beyond_both_of_their_lengths() -> None:
    """Two triangles that share the diagonal of a square, one cut twice as large."""
    pos = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    flat = pos[faces, :2] * np.array([1.0, 2.0])[:, None, None]
    cloth = build_cloth(pos, faces, Material(), dtype=torch.float64, flat=flat)
    for size, diagonal in ((0.9, -0.1), (1.0, 0.0), (1.5, 0.0), (2.5, 0.25)):
        strain = cloth.edge_strain(torch.as_tensor(size * pos))
        assert strain[cloth.gathered_edges].tolist() == pytest.approx([diagonal])
        known = strain_metrics(cloth, torch.as_tensor(size * pos))
        assert known["strain_max"] == pytest.approx(float(strain.abs().max()))


def test_quantiles_of_the_absolute_strain() -> None:
    pos = CLOTH.rest_pos * torch.tensor([0.7, 1.0, 1.0])
    strain = edge_strain(CLOTH, pos).abs().numpy()
    metrics = strain_metrics(CLOTH, pos)
    assert metrics["strain_p50"] == pytest.approx(np.quantile(strain, 0.5))
    assert metrics["strain_p99"] == pytest.approx(np.quantile(strain, 0.99))
    assert metrics["strain_max"] == pytest.approx(0.3)


def test_strain_is_rigidly_invariant_and_nan_when_broken() -> None:
    turn = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]).double()
    assert strain_metrics(CLOTH, CLOTH.rest_pos @ turn.T + 3.0)["strain_max"] < 1e-12
    pos = CLOTH.rest_pos.clone()
    pos[3, 1] = float("inf")
    assert all(np.isnan(value) for value in strain_metrics(CLOTH, pos).values())


def test_strain_of_positions_that_changed_in_place_is_measured_again() -> None:
    pos, faces = grid(4, 4, 0.1)
    cloth, other = (build_cloth(size * pos, faces, Material()) for size in (1.0, 0.5))
    here = torch.tensor(pos, dtype=torch.float32)
    first = strain_metrics(cloth, here)
    first["strain_p50"] = 7.0  # the caller's own
    assert strain_metrics(cloth, here)["strain_p50"] < 1e-6
    assert strain_metrics(other, here)["strain_p50"] == pytest.approx(1.0, abs=1e-5)
    here *= 1.1
    assert strain_metrics(cloth, here)["strain_p50"] == pytest.approx(0.1, abs=1e-5)
    here.numpy()[:] = 1.2 * pos  # no version of the tensor tells this
    assert strain_metrics(cloth, here)["strain_p50"] == pytest.approx(0.2, abs=1e-5)


def test_penetration_counts_vertices_deeper_than_two_millimetres() -> None:
    pos = CLOTH.rest_pos.clone()
    pos[:, 1] = 0.01
    pos[0, 1], pos[1, 1], pos[2, 1] = -0.0019, -0.0021, -0.03
    metrics = penetration_metrics(plane_contact(pos), CLOTH)
    assert metrics["penetration_count"] == 2
    assert metrics["penetration_share"] == pytest.approx(2 / 36)
    assert metrics["penetration_depth"] == pytest.approx(0.03)


def test_vertices_beyond_the_reach_of_the_contact_energy_count() -> None:
    contact = plane_contact(CLOTH.rest_pos - torch.tensor([0.0, 0.5, 0.0]).double())
    deep = replace(contact, valid=torch.zeros_like(contact.valid))
    assert penetration_metrics(deep, CLOTH)["penetration_count"] == 36
    assert penetration_metrics(deep, CLOTH)["penetration_depth"] == pytest.approx(0.5)


def test_vertices_of_no_face_do_not_count() -> None:
    mass = CLOTH.mass.clone()
    mass[:6] = 0.0
    pos = CLOTH.rest_pos - torch.tensor([0.0, 0.5, 0.0]).double()
    pos[6:, 1] = -0.003
    metrics = penetration_metrics(plane_contact(pos), replace(CLOTH, mass=mass))
    assert metrics == {"penetration_count": 30, "penetration_share": 1.0, "penetration_depth": pytest.approx(0.003)}


def test_vertices_without_any_surface_do_not_count() -> None:
    contact = plane_contact(CLOTH.rest_pos)
    nowhere = replace(contact, dist=torch.full_like(contact.dist, torch.inf))
    assert penetration_metrics(nowhere, CLOTH) == penetration_metrics(None, CLOTH) == dict.fromkeys(PENETRATION_METRICS, 0.0)


def test_depth_is_zero_outside() -> None:
    assert penetration_metrics(plane_contact(CLOTH.rest_pos + 0.1), CLOTH)["penetration_depth"] == 0.0


def test_quantiles_are_those_of_numpy():
    rng = np.random.default_rng(3)
    for count in (1, 2, 3, 101, 3000):
        values = np.sort(rng.random(count))
        for share in (0.5, 0.99, 1.0):
            assert _quantile(values, share) == pytest.approx(np.quantile(values, share), rel=1e-14)

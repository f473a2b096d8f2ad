"""The static cloth: rest quantities, and fabrics given as numbers or as fields."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.scene.cloth import build_cloth
from hood.testing import cylinder, grid


def test_masses_and_areas_of_a_square() -> None:
    cloth = build_cloth(*grid(6, 6, 0.5), Material(density=0.2), dtype=torch.float64)
    assert float(cloth.rest_area.sum()) == pytest.approx(0.25)
    assert float(cloth.mass.sum()) == pytest.approx(0.05)
    assert int(cloth.free.sum()) == 36
    # Every interior edge is a hinge.
    assert len(cloth.hinges) == len(cloth.edges) - 4 * 5


def test_constant_fields_equal_scalars() -> None:
    mesh = cylinder(8, 5)
    material = Material()
    as_fields = Material(**{name: np.full(len(mesh[0]), getattr(material, name)) for name in Material.names()})
    numbers, arrays = (build_cloth(*mesh, m, dtype=torch.float64) for m in (material, as_fields))
    for spec in fields(numbers):
        torch.testing.assert_close(getattr(arrays, spec.name), getattr(numbers, spec.name), rtol=1e-12, atol=0)


def test_piecewise_fabric_stays_on_its_side() -> None:
    pos, faces = grid(7, 4, 0.6)
    left = pos[:, 0] < 0.25
    material = Material(
        density=np.where(left, 0.1, 0.4),
        lame_mu=np.where(left, 2e4, 6e4),
        bending_stiffness=np.where(left, 1e-6, 1e-4),
    )
    cloth = build_cloth(pos, faces, material, dtype=torch.float64)
    side = torch.as_tensor(left)
    count = side[cloth.faces].sum(dim=1)
    for side_count, density, mu in ((3, 0.1, 2e4), (0, 0.4, 6e4)):
        rows = count == side_count
        assert bool(rows.any())
        assert cloth.density[rows].unique().tolist() == pytest.approx([density])
        assert cloth.lame_mu[rows].unique().tolist() == pytest.approx([mu])
    border = (count > 0) & (count < 3)
    assert bool(((cloth.density[border] > 0.1) & (cloth.density[border] < 0.4)).all())
    stiff = cloth.bending_stiffness[~side[cloth.hinges[:, :2]].any(dim=1)]
    assert stiff.unique().tolist() == pytest.approx([1e-4])
    assert cloth.vertex_fabric[:, 0].tolist() == pytest.approx(np.where(left, 2e4, 6e4).tolist())
    ends = torch.as_tensor(material.lame_mu)[cloth.edges].mean(dim=1)
    torch.testing.assert_close(cloth.edge_fabric[:, 0], ends)
    # The heavy side weighs more.
    assert float(cloth.mass[~side].sum()) > 2 * float(cloth.mass[side].sum())


def test_a_field_of_the_wrong_length_is_refused() -> None:
    with pytest.raises(ValueError, match=r"material 'density' has shape \(5,\).*\(16,\)"):
        build_cloth(*grid(4, 4), Material(density=np.full(5, 0.2)))


def test_flat_rest_forgets_the_rest_angles() -> None:
    mesh = cylinder(8, 4)
    bent, flat = (build_cloth(*mesh, Material(), flat_rest=value) for value in (False, True))
    assert float(bent.rest_angle.abs().max()) > 0.1
    assert not bool(flat.rest_angle.any())


def test_pinned_and_isolated_vertices_are_not_free() -> None:
    pos, faces = grid(3, 3, 0.2)
    pos = np.concatenate([pos, [[5.0, 5.0, 5.0]]])
    pinned = np.zeros(10, dtype=bool)
    pinned[:3] = True
    cloth = build_cloth(pos, faces, Material(), pinned)
    assert float(cloth.mass[9]) == 0.0
    assert cloth.free.tolist() == [False] * 3 + [True] * 6 + [False]


def test_rest_quantities_are_computed_in_float64() -> None:
    """A garment far from the origin keeps its areas to float32's own precision."""
    pos, faces = grid(5, 5, 0.1)
    near, far = (build_cloth(p, faces, Material()) for p in (pos, pos + 1000.0))
    for name in ("rest_area", "rest_inverse", "mass", "rest_length", "hinge_area"):
        torch.testing.assert_close(getattr(far, name), getattr(near, name), rtol=1e-6, atol=1e-6)
    assert near.mass.dtype == torch.float32


def test_cloth_is_frozen() -> None:
    cloth = build_cloth(*grid(3, 3), Material())
    with pytest.raises(AttributeError):
        cloth.num_scenes = 2  # type: ignore[misc]
    assert replace(cloth, num_scenes=2).num_scenes == 2

"""Damping of the fabric by its rates of strain and of bending."""

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.bending import Bending
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential
from hood.testing import assert_internal_energy_contract, cylinder, grid, make_problem, random_rotation

F64 = torch.float64


@pytest.mark.parametrize(
    ("term", "limits"), [(StretchDamping(0.05), {}), (BendDamping(0.05), {"flipped_flat": 0.0})], ids=["stretch", "bend"]
)
def test_contract(term, limits):
    assert_internal_energy_contract(term, **limits)


@pytest.mark.parametrize("term", [StretchDamping(0.05), BendDamping(0.05)], ids=["stretch", "bend"])
def test_a_rigid_motion_of_a_deformed_sheet_is_not_damped(term):
    rng = np.random.default_rng(0)
    pos, faces = cylinder()
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    start = cloth.rest_pos * 1.2 + 0.01 * torch.as_tensor(rng.normal(size=pos.shape))
    problem = make_problem(cloth, start)
    moved = start @ torch.as_tensor(random_rotation(rng)).T + torch.tensor([0.1, 0.2, 0.3], dtype=F64)
    bent = start + 0.01 * torch.as_tensor(rng.normal(size=pos.shape))
    assert float(term(problem, moved, moved)) < 1e-20 * max(1.0, float(term(problem, bent, bent)))


@pytest.mark.parametrize(
    ("damping", "elastic"), [(StretchDamping(0.05), Stretching()), (BendDamping(0.05), Bending())], ids=["stretch", "bend"]
)
def test_from_rest_it_is_the_elastic_energy_times_time_over_dt(damping, elastic):
    mesh = grid(5, 4, 0.4)
    cloth = build_cloth(*mesh, Material(bending_stiffness=1e-3), dtype=F64)
    problem = make_problem(cloth, dt=0.02)
    pos = cloth.rest_pos + 0.02 * torch.as_tensor(np.random.default_rng(1).normal(size=mesh[0].shape))
    assert float(damping(problem, pos, pos)) == pytest.approx(2.5 * float(elastic(problem, pos, pos)), rel=1e-12)


def test_stress_opposes_the_rate_of_strain():
    """A sheet that is stretched and goes on stretching is held back by more than its elastic force, one that returns is not."""
    cloth = build_cloth(*grid(4, 4, 0.3), Material(lame_lambda=0.0), dtype=F64)
    start = cloth.rest_pos * torch.tensor([1.1, 1.0, 1.0])
    problem, rest_edge = make_problem(cloth, start), cloth.rest_pos[:, 0] > 0.29
    for sign in (1.0, -1.0):
        pos = cloth.rest_pos * torch.tensor([1.1 + 0.02 * sign, 1.0, 1.0])
        elastic, damped = (
            float(Potential({"t": term}).gradient(problem, pos)[0][rest_edge, 0].sum())
            for term in (Stretching(), StretchDamping(0.1))
        )
        assert elastic > 0
        assert damped * sign > 0


@pytest.mark.parametrize("kind", [StretchDamping, BendDamping])
def test_bad_times_are_refused(kind):
    with pytest.raises(ValueError, match="damping: time is -1.0; give seconds >= 0, 0 for none"):
        kind(-1.0)

"""The compiled pass over contact: what the terms themselves say in torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.solver.derivatives.compiled_vertices import contact_pass
from hood.solver.derivatives.vertices import VertexForces, vertex_forces
from hood.testing import grid, make_problem, sphere

F64 = torch.float64


def over_a_ball(speed: float) -> StepProblem:
    """An uneven sheet, in and over a ball that moves, falling or rising at ``speed`` [m/s]; a vertex without faces."""
    rng = np.random.default_rng(2)
    rest, faces = grid(8, 7, 0.3)
    rest = np.concatenate([rest, [[0.1, 0.0, 0.1]]])
    cloth = build_cloth(rest, faces, Material(friction=np.linspace(0.0, 2.0, len(rest))), dtype=F64)
    noise = rng.normal(size=cloth.rest_pos.shape)
    pos = cloth.rest_pos + torch.as_tensor([-0.15, 0.1, -0.15] + 4e-3 * noise)
    vel = 0.3 * noise + [0.0, speed, 0.0]
    problem = make_problem(cloth, pos, vel, 1 / 30)
    ball, corners = (torch.as_tensor(part) for part in sphere(3, 0.1))
    scene = torch.zeros(len(ball), dtype=torch.long)
    obstacle = Obstacle(ball, ball + 2e-3, ball, corners, scene, scene.new_zeros(len(corners)), scene.bool())
    return replace(problem, step=replace(problem.step, obstacle=obstacle))


def both(potential: Potential, problem: StepProblem) -> tuple[VertexForces, VertexForces]:
    if contact_pass(problem, problem.contact) is None:
        pytest.skip("no C++ compiler")
    return vertex_forces(potential, problem, compiled=True), vertex_forces(potential, problem)


def assert_same(found: VertexForces, expected: VertexForces) -> None:
    for kind in ("walls", "grips"):
        for one, other in zip(getattr(found, kind), getattr(expected, kind), strict=True):
            for name, value in vars(other).items():
                torch.testing.assert_close(getattr(one, name), value, rtol=1e-12, atol=1e-15, equal_nan=True, msg=name)


@pytest.mark.parametrize("speed", [-1.0, 0.0, 2.0])
@pytest.mark.parametrize("reach", ["curvature", "constant"])
def test_it_says_what_the_terms_say(speed: float, reach: str) -> None:
    potential = default_potential(reach=reach)
    problem = potential.prepare(over_a_ball(speed))
    found, expected = both(potential, problem)
    assert_same(found, expected)
    assert problem.contact is not None
    held = int((found.grips[0].force > 0).sum())
    assert held < len(problem.contact.dist) - 5
    assert held > 0 or speed > 0
    assert_same(*both(potential, replace(problem, step=replace(problem.step, obstacle=None), internal_force=None)))


def test_rows_without_a_match_may_hold_anything() -> None:
    potential = default_potential()
    problem = potential.prepare(over_a_ball(0.0))
    contact = problem.contact
    assert contact is not None
    lost = torch.arange(len(contact.dist)) % 3 == 0
    spoiled = {name: getattr(contact, name).clone() for name in ("next_point", "next_normal", "dist")}
    for values in spoiled.values():
        values[lost] = torch.nan
    contact = replace(contact, valid=contact.valid & ~lost, **spoiled)
    found, expected = both(potential, replace(problem, contact=contact))
    assert_same(found, expected)
    assert torch.isfinite(found.walls[0].point).all()
    assert float(found.grips[0].force[lost].abs().max()) == 0.0


def test_a_velocity_that_is_not_finite_is_not_hidden() -> None:
    potential, problem = default_potential(), over_a_ball(-1.0)
    problem = potential.prepare(problem)
    problem = replace(problem, state=replace(problem.state, vel=problem.state.vel * torch.nan))
    found, expected = (forces.grips[0].force.isnan() for forces in both(potential, problem))
    assert found.any()
    assert expected[found].all()


def test_the_pass_is_for_float64_alone() -> None:
    problem = default_potential().prepare(over_a_ball(0.0))
    single = replace(problem, state=replace(problem.state, pos=problem.state.pos.float()))
    assert contact_pass(single, single.contact) is None

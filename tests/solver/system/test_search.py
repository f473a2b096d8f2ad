"""Paths that bend away from the body."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import Iterate, Unknowns
from hood.solver.system.line_search import Path, backtrack
from hood.solver.system.linear import diagonal_inverse
from hood.solver.system.plan import plan_for, quadratic_model
from hood.testing import grid, make_problem, plane_contact

F64 = torch.float64
WEIGHT, EPSILON = 5e5, 2e-3


def over_plane(height: float, speed: float = 0.0, lost: bool = False) -> StepProblem:
    """A level sheet over the plane y = 0 that moves down."""
    pos, faces = grid(5, 5, 0.2)
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    start = cloth.rest_pos + torch.tensor([0.0, height, 0.0])
    contact = plane_contact(start)
    if lost:
        gone = torch.arange(25) < 10
        point = torch.where(gone[:, None], float("nan"), contact.next_point)
        contact = replace(contact, valid=~gone, next_point=point)
    return make_problem(cloth, start, torch.tensor([0.0, -speed, 0.0]).expand(25, 3), contact=contact)


def path_of(problem: StepProblem, direction: torch.Tensor) -> tuple[Unknowns, Iterate, Path, torch.Tensor]:
    potential, plan = default_potential(), plan_for(problem)
    unknowns = Unknowns(potential, problem)
    now = unknowns.at(problem.state.pos)
    model = quadratic_model(potential, problem, plan, now.pos, now.acc)
    path = Path(unknowns, now, direction, diagonal_inverse(plan.pattern, model.triples), plan.vertices)
    return unknowns, now, path, problem.sum_vertices((model.gradient * direction).sum(1))


def test_straight_away_from_the_body():
    problem = over_plane(0.1)
    direction = 0.01 * torch.ones_like(problem.state.pos)
    _, now, path, _ = path_of(problem, direction)
    for length in (0.0, 0.3, 1.0):
        torch.testing.assert_close(path.at(torch.tensor([length], dtype=F64)).pos, now.pos + length * direction)


def test_a_step_into_the_body_ends_where_contact_balances_the_model():
    problem = over_plane(0.004)
    direction = torch.tensor([0.0, -0.05, 0.0], dtype=F64).expand(25, 3)
    _, _, path, _ = path_of(problem, direction)
    end = path.at(torch.ones(1, dtype=F64)).pos
    depth = EPSILON - end[:, 1]
    assert float(depth.min()) > 0
    assert float(depth.max()) < 0.02  # the straight line goes to 48 mm
    torch.testing.assert_close(end[:, [0, 2]], problem.state.pos[:, [0, 2]], rtol=0, atol=5e-3)


@pytest.mark.parametrize("height", [-0.001, 0.001, 0.004])
def test_the_correction_is_of_second_order(height):
    problem = over_plane(height)
    direction = torch.tensor([0.0, -0.02, 0.0], dtype=F64).expand(25, 3)
    _, now, path, _ = path_of(problem, direction)

    def off(length: float) -> float:
        return float((path.at(torch.tensor([length], dtype=F64)).pos - now.pos - length * direction).norm())

    assert off(0.0) < 1e-15
    assert off(1e-4) <= 0.02 * off(1e-3) + 1e-15


def test_vertices_without_a_match_are_no_obstacle():
    problem = over_plane(0.004, lost=True)
    direction = torch.tensor([0.0, -0.05, 0.0], dtype=F64).expand(25, 3)
    _, _, path, _ = path_of(problem, direction)
    end = path.at(torch.ones(1, dtype=F64)).pos
    assert torch.isfinite(end).all()
    torch.testing.assert_close(end[:10, 1], problem.state.pos[:10, 1] - 0.05)
    assert float(end[10:, 1].min()) > -0.02


def test_backtracking_descends_and_reports_who_moved():
    problem = over_plane(0.004, speed=2.0)
    uphill = torch.tensor([0.0, -0.05, 0.0], dtype=F64).expand(25, 3)
    for direction in (uphill, -uphill):
        unknowns, now, path, slope = path_of(problem, direction)
        found, moved = backtrack(unknowns, path, now, slope, torch.ones(1, dtype=torch.bool))
        assert bool(moved) == bool(slope < 0)
        assert float(found.phi) < float(now.phi) if bool(moved) else found is now


def test_a_hard_landing_takes_few_iterations():
    """Every vertex meets the body within the step: straight paths shorten step after step."""
    problem = over_plane(0.03, speed=3.0)
    start = problem.state.pos + torch.tensor([0.0, -0.025, 0.0])
    _, report = minimize(default_potential(), problem, start, NewtonSettings(target_rg=1e-4))
    assert report.converged.all()
    assert report.iterations <= 12


def test_without_contact_there_are_no_walls():
    whole = default_potential().terms
    potential = Potential({name: whole[name] for name in ("inertia", "gravity", "stretching")})
    assert Unknowns(potential, over_plane(0.001)).terms.vertices.walls == ()

"""The way on from a place: the iterations are the solver's own, and the problem stays as it was."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.potential import default_potential, relative_gradient
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier
from hood.solver.derivatives.self_contact import approached
from hood.solver.newton import Further, NewtonSettings, minimize
from hood.testing import grid, make_problem, plane_contact

POTENTIAL = default_potential()
LAYERED = POTENTIAL.with_terms(layers=LayerBarrier())


def falling(dtype: torch.dtype = torch.float64) -> StepProblem:
    """A wavy sheet over the plane y = 0, held at one corner."""
    pos, faces = grid(6, 6, 0.25)
    pos[:, 1] += 0.01 + 0.002 * np.sin(20 * pos[:, 0]) * np.cos(15 * pos[:, 2])
    cloth = build_cloth(pos, faces, Material(), np.arange(36) < 1, dtype=dtype)
    return POTENTIAL.prepare(make_problem(cloth, contact=plane_contact(cloth.rest_pos)))


def pulled(problem: StepProblem) -> torch.Tensor:
    """Somewhere off the minimum, the held vertex in its place."""
    pos = problem.state.pos
    return torch.where(problem.cloth.free.unsqueeze(1), pos + 0.02 * torch.sin(30.0 * pos[:, [1, 2, 0]]), pos)


@pytest.mark.parametrize("engine", ["auto", "torch"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_iterations_are_those_of_the_solver(engine: str, dtype: torch.dtype) -> None:
    problem = falling(dtype)
    start = pulled(problem)
    way = Further(POTENTIAL, problem, start, NewtonSettings(engine=engine))
    for count in range(1, 4):
        before = way.residual
        assert way.move()
        settings = NewtonSettings(target_rg=1e-12, max_iterations=count, engine=engine)
        expected, report = minimize(POTENTIAL, problem, start, settings)
        torch.testing.assert_close(way.pos.to(dtype), expected, rtol=0, atol=1e-9 if dtype == torch.float64 else 1e-7)
        assert way.residual == pytest.approx(float(report.relative_gradient), rel=1e-6)
        assert before == pytest.approx(float(report.history[-2].relative_gradient), rel=1e-6)


@pytest.mark.parametrize("engine", ["auto", "torch"])
def test_the_direction_is_a_whole_step_of_newton(engine: str) -> None:
    """Of a quadratic potential, here inertia and weight, it leads to the minimum."""
    potential, problem = POTENTIAL.only({name: POTENTIAL.terms[name] for name in ("inertia", "gravity")}), falling()
    end, _ = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-9))
    start = pulled(problem)
    way = Further(potential, problem, start, NewtonSettings(engine=engine))
    assert way.move()
    torch.testing.assert_close(start + way.direction, end, rtol=0, atol=1e-6)
    assert not way.direction[~problem.cloth.free].any()


@pytest.mark.usefixtures("compiled_layers")
def test_a_place_that_only_a_bent_way_leads_to_is_where_the_way_begins() -> None:
    """Two sheets that fly through each other, but for what keeps them apart: the solver leads them around each other."""
    pos, faces = grid(9, 9, 0.3)
    rest, both = np.concatenate([pos, pos]), np.concatenate([faces, faces + len(pos)])
    down = np.zeros_like(rest)
    down[len(pos) :, 1] = -5.0
    cloth = build_cloth(rest, both, Material(), dtype=torch.float64)
    start = np.concatenate([pos, pos + [0.013, 0.01, 0.008]])
    problem = LAYERED.prepare(make_problem(cloth, start, down))
    end, _ = minimize(LAYERED, problem, settings=NewtonSettings(target_rg=1e-5))
    assert float((approached(problem.layers, end) - end).abs().max()) > 1e-3
    way = Further(LAYERED, problem, end)
    torch.testing.assert_close(way.pos, end, rtol=0, atol=1e-12)
    assert way.residual == pytest.approx(float(relative_gradient(problem, LAYERED.gradient(problem, end)[0])), rel=1e-3)

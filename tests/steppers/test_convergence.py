"""What steps and meshes converge to as they get finer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.mesh.editing.remeshing import isotropic
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import implicit_euler
from hood.testing import Mesh, grid, make_problem

TIGHT = NewtonSettings(target_rg=1e-7)


def ribbon(rows: int, columns: int, length: float) -> Mesh:
    pos, faces = grid(rows, columns, 1.0)
    return pos * np.array([length, 1.0, length * (columns - 1) / (rows - 1)]), faces


def held(mesh: Mesh, dt: float) -> StepProblem:
    """A step of cloth of ``mesh`` that is held up to x = 0."""
    cloth = build_cloth(*mesh, Material(), pinned=mesh[0][:, 0] < 1e-9, dtype=torch.float64)
    return replace(make_problem(cloth, dt=dt), gravity=torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64))


def last(problem: StepProblem, steps: int) -> torch.Tensor:
    pos = problem.state.pos
    for step in implicit_euler(default_potential(), problem, steps, TIGHT):
        assert step.report.converged.all()
        pos = step.state.pos
    return pos


def test_a_hanging_strip_converges_in_the_first_order_of_the_time_step() -> None:
    """At rest under its weight at first, let go 0.4 rad from there; held against the limit of the first order."""
    still = replace(held(ribbon(13, 4, 0.3), 100.0), gravity=9.81 * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    start = last(still, 3)
    aside = 9.81 * torch.tensor([np.cos(0.4), -np.sin(0.4), 0.0], dtype=torch.float64)

    def swung(rate: int) -> torch.Tensor:
        problem = replace(held(ribbon(13, 4, 0.3), 1 / rate), gravity=aside)
        return last(replace(problem, state=replace(problem.state, pos=start)), rate // 5)

    exact = 2 * swung(3840) - swung(1920)
    errors = [float((swung(rate) - exact).norm()) for rate in (120, 240, 480, 960)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((orders >= 0.9) & (orders <= 1.1)).all(), orders
    assert errors[-1] < 0.005 * float((exact - start).norm())


@pytest.mark.parametrize("regular", [True, False])
def test_a_cantilever_comes_nearer_to_the_elastica_on_finer_meshes(regular: bool) -> None:
    """4 cm of the default fabric: the tip of a rod of a quarter of its bending stiffness hangs 30.2 mm down."""
    drops = []
    for rows in (5, 9, 17):
        edge = 0.04 / (rows - 1)
        mesh = ribbon(rows + 1, rows, 0.04 + edge)
        mesh = mesh if regular else isotropic(*mesh, round(1.15 * len(mesh[0])))
        problem = held((mesh[0] - [edge, 0, 0], mesh[1]), 1 / 30)
        settled = last(problem, 60)
        still = replace(problem.state, pos=settled, vel=torch.zeros_like(settled))
        rest = last(replace(problem, state=still, step=replace(problem.step, dt=torch.full_like(problem.step.dt, 100.0))), 1)
        drops.append(-float(rest[problem.cloth.rest_pos[:, 0] > 0.04 - 1e-9, 1].mean()))
    errors = np.abs(np.array(drops) - 0.0302)
    assert errors[0] > 1.25 * errors[1] > 1.25**2 * errors[2]
    assert errors[2] < 0.1 * 0.0302

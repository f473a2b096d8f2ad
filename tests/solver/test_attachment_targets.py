"""Every form of the solver draws attachments to the same targets."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from test_newton import batch
from test_plan import states, touching_sheet

from hood.cloth.state import Attachments
from hood.energies.potential import default_potential
from hood.solver.derivatives.step_terms import StepTerms
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.plan import plan_for, quadratic_model
from hood.solver.vertex.block_jacobi import LocalTerms
from hood.solver.vertex.gauss_seidel import neighbourhoods, vertex_systems


def fastened(active=(True, False)):
    """A sheet that is buttoned to itself, one of two pairs closed, at a distance and at a speed."""
    problem = touching_sheet()
    pairs = Attachments(
        torch.tensor([[3, 16], [5, 18]]), torch.tensor(active), torch.tensor([0.05, 0.1]), torch.tensor([0.3, 2.0])
    )
    return replace(problem, step=replace(problem.step, attachments=pairs))


@pytest.mark.parametrize("name", ["near", "folded"])
def test_gradients_are_those_of_the_potential(name):
    problem, potential = fastened((True, True)), default_potential()
    pos = states(problem)[name]
    acc = problem.acceleration(pos)
    expected, _ = potential.gradient(problem, pos, acc)
    model = quadratic_model(potential, problem, plan_for(problem), pos, acc)
    torch.testing.assert_close(model.gradient, expected, rtol=1e-9, atol=1e-9)
    terms = StepTerms(potential, problem)
    for group in neighbourhoods(terms):
        gradient, _ = vertex_systems(terms, group, pos, acc)
        torch.testing.assert_close(gradient, expected[group.colour.vertices], rtol=1e-9, atol=1e-9)
    free = problem.cloth.free.unsqueeze(1)
    torch.testing.assert_close(
        LocalTerms(potential, problem)(pos).force, torch.where(free, -expected, 0.0), rtol=1e-9, atol=1e-9
    )


@pytest.mark.usefixtures("compiled_solver")
@pytest.mark.parametrize("active", [(True, False), (True, True), (False, False)])
def test_the_compiled_solver_finds_the_same_minimum_alone_and_in_a_batch(active):
    problem, other = fastened(active), touching_sheet(attached=False)
    potential, tight = default_potential(), NewtonSettings(target_rg=1e-9, engine="torch")
    expected, _ = minimize(potential, problem, settings=tight)
    found, report = minimize(potential, problem, settings=replace(tight, engine="compiled"))
    assert bool(report.converged.all())
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    both = batch([other, problem])
    pairs = problem.step.attachments
    count = problem.cloth.num_vertices
    both = replace(both, step=replace(both.step, attachments=replace(pairs, edges=pairs.edges + count)))
    together, _ = minimize(potential, both, settings=replace(tight, engine="compiled"))
    torch.testing.assert_close(together[count:], expected, rtol=0, atol=1e-9)


def test_opening_and_closing_takes_the_plan_that_is_there():
    """Pairs that open stay in the sparsity: nothing is made anew."""
    closed = fastened((True, True))
    pairs = replace(closed.step.attachments, active=torch.tensor([False, True]))
    opened = replace(closed, step=replace(closed.step, attachments=pairs))
    assert plan_for(closed) is plan_for(opened)

"""The start of a minimisation and the unknowns."""

from __future__ import annotations

import copy
import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import State
from hood.energies.potential import default_potential
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system import plan
from hood.solver.system.iterate import Unknowns, first_iterate, projected_guess
from hood.solver.vertex.compiled import local_terms
from hood.tensors.batch import made_of
from hood.testing import grid, make_problem, plane_contact

F64 = torch.float64


def problem_at(height, vel=(0.0, 0.0, 0.0), dtype=F64):
    pos, faces = grid(4, 4, 0.1)
    cloth = build_cloth(pos, faces, Material(), np.arange(16) < 4, dtype=dtype)
    start = cloth.rest_pos + torch.tensor([0.0, height, 0.0])
    problem = make_problem(cloth, start, torch.tensor(vel).expand(16, 3), contact=plane_contact(start))
    target = start + torch.tensor([0.01, -0.5, 0.0])
    return replace(problem, step=replace(problem.step, pin_target=target))


def test_guess_is_free_flight_away_from_the_body():
    problem = problem_at(0.08, vel=(0.3, -0.1, 0.0))
    guess = projected_guess(default_potential(), problem)
    expected = problem.state.pos[4:] + problem.state.vel[4:] / 30 + problem.gravity / 900
    torch.testing.assert_close(guess[4:], expected)
    assert torch.equal(guess[:4], problem.step.pin_target[:4])


def test_guess_rests_its_weight_on_the_body():
    problem = problem_at(0.01, vel=(0.3, -2.0, 0.0))
    potential = default_potential()
    guess = projected_guess(potential, problem)
    depth = 2e-3 - guess[4:, 1]
    weight = problem.cloth.mass[4:] * 9.81
    torch.testing.assert_close(3 * 5e5 * depth**2, weight, rtol=1e-6, atol=0)
    torch.testing.assert_close(guess[4:, 0], problem.state.pos[4:, 0] + 0.01)


def test_guess_ignores_vertices_without_a_match():
    problem = problem_at(-0.05)
    contact = problem.contact
    lost = replace(
        contact,
        valid=torch.zeros(16, dtype=torch.bool),
        next_point=torch.full_like(contact.next_point, float("nan")),
        next_normal=torch.full_like(contact.next_normal, float("nan")),
    )
    guess = projected_guess(default_potential(), replace(problem, contact=lost))
    torch.testing.assert_close(guess[4:], problem.state.pos[4:] + problem.gravity / 900)


def test_cloth_in_the_air_starts_falling_and_cloth_at_rest_stays():
    potential, problem = default_potential(), problem_at(0.08)
    problem = replace(problem, step=replace(problem.step, pin_target=problem.state.pos))
    limp = replace(problem, cloth=replace(problem.cloth, pinned=torch.zeros(16, dtype=torch.bool)))
    start = first_iterate(Unknowns(potential, limp))
    torch.testing.assert_close(start.pos, limp.state.pos + limp.gravity / 900)
    state, settings = problem.state, NewtonSettings(target_rg=1e-6)
    for _ in range(40):
        pos, report = minimize(potential, replace(problem, state=state), settings=settings)
        state = State(pos, 0.5 * (state.vel + report.acc / 30), state.origin)
    hanging = replace(problem, state=state)
    start = first_iterate(Unknowns(potential, hanging))
    assert torch.equal(start.pos, projected_guess(potential, hanging, falls=False))


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_accelerations_carry_the_precision(dtype):
    """A change of 1e-10 m is lost in float32 positions, not in the inertia of the iterate."""
    problem = problem_at(0.5, dtype=dtype)
    unknowns = Unknowns(default_potential(), problem)
    acc = torch.full_like(problem.state.pos, 1e-3)
    ahead, here = unknowns.evaluate(acc + 1e-7), unknowns.evaluate(acc)
    assert not torch.equal(ahead.acc[4:], here.acc[4:])
    torch.testing.assert_close(here.pos[4:], problem.state.pos[4:] + 1e-3 / 900)
    assert torch.equal(here.pos[:4], problem.step.pin_target[:4])
    torch.testing.assert_close(unknowns.at(here.pos).phi, here.phi)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_what_steps_keep_of_a_cloth_does_not_outlive_it(dtype):
    """Plans, engines and copies refer to the cloth that they were made of."""
    problem, potential = problem_at(0.1, dtype=dtype), default_potential()
    minimize(potential, problem)
    local_terms(potential, problem)(problem.state.pos)
    alive = [weakref.ref(problem.cloth.faces), weakref.ref(plan.plan_for(problem))]
    assert alive[1]() is plan.plan_for(problem)
    assert "plan" not in made_of(copy.deepcopy(problem.cloth).faces)
    del problem
    gc.collect()
    assert [reference() for reference in alive] == [None, None]

"""The compiled pass over the elements: the same numbers as the terms in torch, whatever the shape."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import State, StepInput
from hood.energies import compiled_elements
from hood.energies.bending import Bending, CurrentLengthBending
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.solver.step_figures import edge_strain
from hood.testing import cylinder, grid, make_problem, plane_contact

F64 = torch.float64
POTENTIALS = {"default": default_potential(), "code": default_potential().with_terms(bending=CurrentLengthBending())}


compiled = pytest.mark.skipif(compiled_elements.library() is None, reason="no C++ compiler")


def problem_of(mesh, seed=0, size=0.004, dtype=F64):
    rng = np.random.default_rng(seed)
    cloth = build_cloth(*mesh, Material(), dtype=dtype)
    pos = cloth.rest_pos + size * torch.as_tensor(rng.normal(size=mesh[0].shape)).to(dtype)
    return make_problem(cloth, pos, 0.1 * rng.normal(size=mesh[0].shape), 1 / 30, plane_contact(pos)), pos


def assert_same(potential, problem, pos, acc=None):
    expected, energies = potential.gradient(problem, pos, acc)
    gradient, found = compiled_elements.energies_and_gradient(potential, problem, pos, acc)
    assert list(found) == list(energies)
    for name, value in energies.items():
        torch.testing.assert_close(found[name], value, rtol=1e-12, atol=1e-22)
    torch.testing.assert_close(gradient, expected, rtol=1e-11, atol=1e-12 * float(expected.abs().max()))
    total = compiled_elements.total_energy(potential, problem, pos)
    torch.testing.assert_close(total, potential.total(problem, pos), rtol=1e-12, atol=1e-22)


@compiled
@pytest.mark.parametrize("name", POTENTIALS)
@pytest.mark.parametrize("size", [0.0, 0.004, 0.2])
def test_energies_and_gradient_are_those_of_the_potential(name, size):
    for seed, mesh in enumerate((grid(7, 5, 0.4), cylinder(9, 4, 0.1, 0.3))):
        problem, pos = problem_of(mesh, seed, size)
        assert_same(POTENTIALS[name], problem, pos)
        assert_same(POTENTIALS[name], problem, pos, problem.acceleration(pos))


@compiled
@pytest.mark.parametrize("name", POTENTIALS)
def test_degenerate_hinges_have_their_energy_and_no_force(name):
    problem, pos = problem_of(grid(5, 5, 0.4))
    first, second, third = problem.cloth.faces[4].tolist()
    pos = pos.clone()
    pos[third] = 0.5 * (pos[first] + pos[second])
    assert_same(POTENTIALS[name], problem, pos)
    pos[second] = pos[first]
    assert_same(POTENTIALS[name], problem, pos)
    assert_same(POTENTIALS[name], problem, torch.zeros_like(pos))


@compiled
def test_hinges_beyond_half_a_turn_bend_the_short_way():
    mesh = cylinder(3, 3, 0.1, 0.2)
    problem, _ = problem_of(mesh, size=0.0)
    assert_same(default_potential(), problem, problem.cloth.rest_pos * torch.tensor([-1.0, 1.0, 1.0], dtype=F64))


@compiled
def test_scenes_of_a_batch_keep_their_energies():
    problems = [problem_of(mesh, seed)[0] for seed, mesh in enumerate((grid(4, 4, 0.3), cylinder(6, 3, 0.1, 0.2)))]
    cloth = concatenate_cloths([problem.cloth for problem in problems])
    pos, vel = (torch.cat([getattr(problem.state, name) for problem in problems]) for name in ("pos", "vel"))
    together = StepProblem(
        cloth, State(pos, vel, torch.zeros(2, 3, dtype=F64)), StepInput(torch.tensor([1 / 30, 1 / 60]).to(F64))
    )
    assert_same(Potential({"stretching": Stretching(), "bending": Bending()}), together, pos)


@compiled
def test_cloth_in_float32_is_measured_in_float64():
    exact, pos = problem_of(grid(6, 6, 0.4))
    rounded = problem_of(grid(6, 6, 0.4), dtype=torch.float32)[0]
    gradient, found = compiled_elements.energies_and_gradient(default_potential(), rounded, pos.float())
    _, expected = default_potential().gradient(exact, pos)
    assert gradient.dtype == found["stretching"].dtype == F64
    torch.testing.assert_close(found["stretching"], expected["stretching"], rtol=1e-4, atol=0)


@compiled
def test_strain_is_that_of_the_edges():
    problem, pos = problem_of(cylinder(9, 4, 0.1, 0.3))
    strain = compiled_elements.absolute_strain(problem.cloth, pos)
    np.testing.assert_allclose(strain, edge_strain(problem.cloth, pos).abs().numpy(), rtol=0, atol=1e-15)


def test_without_a_compiler_torch_takes_its_place(monkeypatch):
    monkeypatch.setattr(compiled_elements, "library", lambda: None)
    problem, pos = problem_of(grid(4, 4, 0.3))
    assert_same(default_potential(), problem, pos)
    assert compiled_elements.absolute_strain(problem.cloth, pos) is None

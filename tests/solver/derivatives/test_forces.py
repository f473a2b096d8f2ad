"""Energies and gradients of terms on single vertices in closed form are those of automatic differentiation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.contact import Collision
from hood.energies.mass_points import Gravity, Inertia
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.solver.derivatives import compiled_vertices
from hood.solver.derivatives.vertices import energies_and_gradient, known_forces, total_energy
from hood.testing import grid, make_problem, plane_contact

F64 = torch.float64


def touching(size: float) -> tuple[StepProblem, torch.Tensor]:
    """A sheet about a plane, partly in it, that slides; positions a step later."""
    rng = np.random.default_rng(1)
    cloth = build_cloth(*grid(6, 5, 0.4), Material(), dtype=F64)
    noise = torch.as_tensor(rng.normal(size=cloth.rest_pos.shape))
    pos = cloth.rest_pos * torch.tensor([1.0, 0.0, 1.0], dtype=F64) + 1e-3 * noise
    problem = make_problem(cloth, pos, 0.1 * noise.numpy(), 1 / 30, plane_contact(pos))
    return problem, pos + size * torch.as_tensor(rng.normal(size=pos.shape))


@pytest.mark.parametrize(
    "potential", [default_potential(), default_potential(friction_coefficient=10.0)], ids=["default", "rough"]
)
@pytest.mark.parametrize("size", [0.0, 1e-5, 1e-3, 0.1])
@pytest.mark.parametrize("form", ["compiled", "torch"])
def test_they_are_those_of_the_potential(potential: Potential, size: float, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if form == "torch":
        monkeypatch.setattr(compiled_vertices, "library", lambda: None)
    elif compiled_vertices.library() is None:
        pytest.skip("no C++ compiler")
    problem, pos = touching(size)
    problem = potential.prepare(problem)
    for acc in (None, problem.acceleration(pos)):
        expected, energies = potential.gradient(problem, pos, acc)
        gradient, found = energies_and_gradient(potential, problem, pos, acc)
        assert list(found) == list(energies)
        for name, value in energies.items():
            torch.testing.assert_close(found[name], value, rtol=1e-12, atol=1e-20)
        torch.testing.assert_close(gradient, expected, rtol=1e-10, atol=1e-12 * float(expected.abs().max()))
        total = total_energy(potential, problem, pos)
        torch.testing.assert_close(total, potential.total(problem, pos), rtol=1e-12, atol=1e-20)


def test_terms_of_one_kind_have_energies_of_their_own() -> None:
    problem, pos = touching(1e-3)
    potential = default_potential().with_terms(
        more_gravity=Gravity(), more_inertia=Inertia(), more_collision=Collision(1e5, 3e-3)
    )
    problem = potential.prepare(problem)
    expected, energies = potential.gradient(problem, pos)
    gradient, found = energies_and_gradient(potential, problem, pos)
    assert list(found) == list(energies)
    for name, value in energies.items():
        torch.testing.assert_close(found[name], value, rtol=1e-12, atol=1e-20)
    torch.testing.assert_close(gradient, expected, rtol=1e-10, atol=1e-12 * float(expected.abs().max()))


def test_forces_are_gathered_once_a_step() -> None:
    problem, _ = touching(1e-3)
    potential = default_potential()
    problem = potential.prepare(problem)
    first = known_forces(potential, problem)
    assert known_forces(potential.with_terms(stretching=Stretching()), problem) is first
    assert known_forces(potential.with_terms(gravity=Gravity()), problem) is not first


def test_contact_and_friction_are_felt() -> None:
    problem, pos = touching(1e-3)
    _, found = energies_and_gradient(default_potential(), problem, pos)
    assert min(float(found["collision"]), float(found["friction"])) > 0

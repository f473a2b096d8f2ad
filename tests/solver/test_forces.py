"""Energies and gradients of terms on single vertices in closed form are those of automatic differentiation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.losses.potential import Potential, default_potential
from hood.losses.problem import StepProblem
from hood.scene.cloth import build_cloth
from hood.solver.forces import energies_and_gradient
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
def test_they_are_those_of_the_potential(potential: Potential, size: float) -> None:
    problem, pos = touching(size)
    problem = potential.prepare(problem)
    for acc in (None, problem.acceleration(pos)):
        expected, energies = potential.gradient(problem, pos, acc)
        gradient, found = energies_and_gradient(potential, problem, pos, acc)
        assert list(found) == list(energies)
        for name, value in energies.items():
            torch.testing.assert_close(found[name], value, rtol=1e-12, atol=1e-20)
        torch.testing.assert_close(gradient, expected, rtol=1e-10, atol=1e-12 * float(expected.abs().max()))


def test_contact_and_friction_are_felt() -> None:
    problem, pos = touching(1e-3)
    _, found = energies_and_gradient(default_potential(), problem, pos)
    assert min(float(found["collision"]), float(found["friction"])) > 0

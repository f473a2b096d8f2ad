"""The training loss as a number to watch."""

from __future__ import annotations

import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import State, StepInput
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.testing import grid
from hood.training.outcome import relative_loss


def test_the_loss_does_not_depend_on_where_the_scene_is() -> None:
    """Free fall costs nothing, rest one e0; gravity's zero plays no role."""

    cloth = build_cloth(*grid(4, 4, 0.3), Material(), dtype=torch.float64)
    potential = Potential({name: default_potential().terms[name] for name in ("stretching", "bending", "inertia", "gravity")})
    for height in (0.0, 5.0):
        pos = cloth.rest_pos + torch.tensor([0.0, height, 0.0])
        state = State(pos, torch.zeros_like(pos), torch.zeros(1, 3, dtype=torch.float64))
        problem = StepProblem(cloth, state, StepInput(torch.tensor([1 / 30], dtype=torch.float64), None))
        for acc, expected in ((problem.gravity.to(pos).expand_as(pos), 0.0), (torch.zeros_like(pos), 1.0)):
            _, energies = potential.gradient(problem, pos + acc / 900, acc)
            assert float(relative_loss(problem, energies, acc)) == pytest.approx(expected, abs=1e-9)

"""Parts of the body that grip more or less: the coefficient of friction, face by face."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle
from hood.energies.friction import Friction
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings, minimize
from hood.testing import grid, make_problem, sphere

F64 = torch.float64
TIGHT = NewtonSettings(target_rg=1e-8)


def on_a_ball(grip: float | np.ndarray | None, dtype: torch.dtype = F64, side: int = 7) -> StepProblem:
    """A sheet on a ball that moves sideways beneath it."""
    pos, faces = grid(side, side, 0.3)
    cloth = build_cloth(pos, faces, Material(friction=np.linspace(0.5, 2.0, len(pos))), dtype=dtype)
    ball, sides = sphere(3, 0.1)
    now = torch.as_tensor(ball + [0.15, -0.1005, 0.15]).to(dtype)
    none = torch.zeros(len(ball)).long()
    given = None if grip is None else torch.as_tensor(np.broadcast_to(grip, len(sides)).copy()).to(dtype)
    moved = now + torch.tensor([4e-3, 0.0, 0.0], dtype=dtype)
    obstacle = Obstacle(now, moved, now, torch.as_tensor(sides), none, none.new_zeros(len(sides)), none.bool(), given)
    problem = replace(make_problem(cloth, cloth.rest_pos), gravity=torch.tensor([0.0, -9.81, 0.0], dtype=dtype))
    return replace(problem, step=replace(problem.step, obstacle=obstacle))


def potential(coefficient: float, place: str = "vertices") -> Potential:
    usual = default_potential(contact=place)
    return Potential({**usual.terms, "friction": Friction(coefficient, contact=place)})


@pytest.mark.parametrize("place", ["vertices", "edges", "strict"])
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_a_body_that_grips_everywhere_is_another_coefficient(place: str, dtype: torch.dtype) -> None:
    """Energy, gradient and the step of the solver, by terms and compiled."""
    rough, gripping = potential(0.5, place), potential(0.25, place)
    problems = [p.prepare(on_a_ball(grip, dtype)) for p, grip in ((rough, None), (gripping, 2.0))]
    moved = problems[0].state.pos + 1e-3 * torch.randn(problems[0].state.pos.shape, dtype=dtype)
    tolerance = {"rtol": 1e-12, "atol": 1e-14} if dtype is F64 else {"rtol": 1e-5, "atol": 1e-8}
    for found, expected in zip(
        *(p.gradient(made, moved) for p, made in zip((rough, gripping), problems, strict=True)), strict=True
    ):
        torch.testing.assert_close(found, expected, **tolerance)
    if dtype is F64:
        steps = [minimize(p, made, settings=TIGHT)[0] for p, made in zip((rough, gripping), problems, strict=True)]
        torch.testing.assert_close(*steps, rtol=0, atol=1e-9)


def test_a_factor_of_one_changes_no_bit() -> None:
    usual = potential(0.5)
    steps = [minimize(usual, usual.prepare(on_a_ball(grip)), settings=TIGHT)[0] for grip in (None, 1.0)]
    assert torch.equal(*steps)


def test_one_side_may_slide_where_the_other_holds() -> None:
    """The ball moves by 4 mm along x: what lies on its gripping half goes along, the rest stays."""
    ball, sides = sphere(3, 0.1)
    right = ball[sides].mean(axis=1)[:, 2] > 0
    moved = {}
    for name, grip in (("all", 5.0), ("half", np.where(right, 5.0, 0.0)), ("none", 0.0)):
        usual = potential(0.5)
        problem = usual.prepare(on_a_ball(grip, side=31))
        contact = problem.contact
        assert contact is not None
        pos = minimize(usual, problem, settings=TIGHT)[0]
        near = contact.valid & (contact.dist < 2e-3)
        way = (pos - problem.state.pos)[near, 0]
        moved[name] = float(way.mean())
    assert moved["all"] > 1e-4
    assert moved["none"] < 0.25 * moved["all"]
    assert moved["none"] < moved["half"] < moved["all"]

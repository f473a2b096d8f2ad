"""Adjoints of implicit steps: every tensor that a step depends on, contact at edges and faces, and indefinite Hessians."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import hood
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Attachments, Obstacle, State, StepInput
from hood.energies.contact import Collision
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.friction import Friction
from hood.energies.potential import Potential, default_potential, reference_potential, with_soft_pins
from hood.energies.pressure import Pressure
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, LayerFriction
from hood.energies.wind import Wind
from hood.mesh.shapes import grid, sphere
from hood.rollouts import adjoint
from hood.rollouts.adjoint import Hessian
from hood.rollouts.differentiable import differentiable_step, indefinite_at
from hood.rollouts.gradients import constants_of
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import NewtonStepper

REAL = torch.float64
EXACT = NewtonSettings(target_rg=1e-11, max_iterations=500)
Given = tuple[Potential, StepProblem]


def wave(like: Tensor) -> Tensor:
    """Numbers between -1 and 1, no two of them alike."""
    return torch.sin(1.0 + torch.arange(like.numel(), dtype=REAL)).view_as(like)


def ball(way: tuple[float, float, float]) -> Obstacle:
    """10 cm, with parts that grip less."""
    points, faces = (torch.as_tensor(part) for part in sphere(2, 0.1))
    points = points + 1e-3 * wave(points)
    none, move = torch.zeros(len(points), dtype=torch.int64), torch.tensor(way, dtype=REAL)
    grip = 1.0 + 0.2 * wave(faces[:, 0])
    return Obstacle(points, points + move, points - move, faces, none, torch.zeros_like(faces[:, 0]), none > 0, grip)


def sheet_on_a_ball(potential: Potential, warp: float = 1.0, flat: bool = False, layers: bool = False) -> Given:
    """A sheet that is held at one corner and drawn to places at the side, two of whose vertices are buttoned together."""
    pos, faces = grid(5, 5, 0.12)
    pos = pos + np.random.default_rng(0).normal(0.0, 1e-3, pos.shape) + [-0.06, 0.1005, -0.06]
    if layers:
        pos, faces = np.concatenate([pos, pos + [0.007, 0.0015, 0.005]]), np.concatenate([faces, faces + len(pos)])
    held = np.arange(len(pos)) == 0
    material = hood.Material(bending_stiffness=4e-4, warp=warp, shear=2.0 - warp)
    cloth = build_cloth(pos, faces, material, held, dtype=REAL, flat=1.02 * laid_out_corners(pos, faces) if flat else None)
    start = torch.as_tensor(pos)
    start = start + 1e-3 * wave(start)
    edges = torch.tensor([[3, 13], [9, 19]])
    length, speed = torch.tensor([[0.02, 0.03], [0.3, 9.0]], dtype=REAL)
    buttons = Attachments(edges, torch.tensor([True, True]), length, speed)
    step = StepInput(
        torch.full((1,), 1.0 / 30.0, dtype=REAL),
        ball((0.004, 0.001, 0.002)),
        start + 0.01 * wave(start).flip(0),
        buttons,
        torch.full((1,), 0.7, dtype=REAL),
        torch.where(torch.arange(len(pos)) < 6, 5.0, 0.0).double(),
    )
    state = State(start, 0.1 * wave(start), torch.tensor([[0.3, 0.2, 0.1]], dtype=REAL))
    gravity = torch.tensor([0.3, -9.81, 0.2], dtype=REAL)
    return with_soft_pins(potential), StepProblem(cloth, state, step, gravity=gravity)


def laid_out_corners(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return pos[faces][:, :, [0, 2]]


def everything() -> Potential:
    air = Wind((1.0, 0.5, -2.0), gusts=0.3)
    damping = {"viscous": StretchDamping(0.01), "dull": BendDamping(0.02)}
    soft = default_potential(collision_weight=500.0, friction_slip_speed=0.3)
    return soft.with_terms(air=air, **damping)


#: What is refused with a gradient, and what no energy of a case reads: the fabric that networks are shown, the density beside
#: the mass that was made of it, a body at t - 1; steps in still air do not depend on where and when they are.
REFUSED = {"air:gusts", "air:gust_time", "layers:reach", "layers:pressure"}
UNREAD = {"cloth.density", "cloth.vertex_fabric", "cloth.edge_fabric", "cloth.grain", "step.obstacle.prev_pos"}
STILL = {"state.origin", "step.time"}
#: Friction that slips faster than its bound for sticking, by what presses the cloth on.
PRESSED = {"friction:slip_speed", "friction:weight"}
BODY = {f"step.obstacle.{name}" for name in ("pos", "next_pos", "prev_pos")}
#: What acts in all cases as in the first one, or in that with a warp.
ELSEWHERE = UNREAD | {f"cloth.{name}" for name in ("thickness", "lame_lambda", "bending_stiffness", "rest_area", "hinge_area")}
FLAT = {"cloth.rest_pos", "cloth.rest_angle"}
BY_CENTROIDS = UNREAD | STILL | FLAT | {"cloth.hinge_rest_length", "friction:slip_speed", "friction:radius"}
BLOWN = default_potential().with_terms(blown=Pressure(3.0))
CASES: dict[str, tuple[Callable[[], Given], set[str], set[str]]] = {
    "everything": (lambda: sheet_on_a_ball(everything()), REFUSED, UNREAD),
    "edges": (lambda: sheet_on_a_ball(default_potential(contact="edges", reach="constant")), set(), UNREAD | STILL | PRESSED),
    "strict": (lambda: sheet_on_a_ball(default_potential(contact="strict", reach="constant")), set(), UNREAD | STILL | PRESSED),
    "woven": (lambda: sheet_on_a_ball(BLOWN, warp=1.5), set(), UNREAD | STILL | PRESSED),
    "flat": (lambda: sheet_on_a_ball(default_potential(contact="edges"), flat=True), set(), UNREAD | STILL | PRESSED | FLAT),
    "layers": (lambda: sheet_on_a_ball(layered(), layers=True), REFUSED, UNREAD | STILL | PRESSED),
    "reference": (lambda: sheet_on_a_ball(reference_potential()), BODY, BY_CENTROIDS),
}


def layered() -> Potential:
    return default_potential().with_terms(layers=LayerBarrier(), rubbing=LayerFriction(0.3))


def tensors_of(item: Any, path: str = "") -> Iterator[str]:
    """Paths to the numbers of a problem."""
    for spec in fields(item):
        value, place = getattr(item, spec.name), path + spec.name
        if is_dataclass(value):
            yield from tensors_of(value, place + ".")
        elif isinstance(value, Tensor) and value.is_floating_point():
            yield place


def parameters(given: Given) -> Iterator[str]:
    potential, problem = given
    yield from tensors_of(problem)
    for name, term in potential.terms.items():
        for key, value in vars(term).items():
            if isinstance(value, float):
                yield f"{name}:{key}"


def moved(given: Given, path: str, by: Tensor) -> Given:
    """The same with one of its parameters changed by so much of itself."""
    potential, problem = given
    if ":" in path:
        name, key = path.split(":")
        term = copy(potential.terms[name])
        setattr(term, key, (1.0 + by) * getattr(term, key))
        return potential.with_terms(**{name: term}), problem

    def replaced(item: Any, names: list[str]) -> Any:
        if names:
            return replace(item, **{names[0]: replaced(getattr(item, names[0]), names[1:])})
        return item + by * item.abs().mean() * wave(item)

    return potential, replaced(problem, path.split("."))


def loss(given: Given) -> Tensor:
    state = differentiable_step(NewtonStepper(given[0], EXACT), given[1])
    return (state.pos * wave(state.pos)).sum() + 0.01 * state.vel.square().sum()


@pytest.mark.parametrize("name", CASES)
def test_every_tensor_of_a_step_has_its_derivative_or_is_refused(name: str) -> None:
    """By central differences, one parameter after the other, whatever fields and constants there are."""
    make, refused, unread = CASES[name]
    given, change, without = make(), 2e-6, set()
    known = set() if name in ("everything", "woven") else ELSEWHERE
    for path in parameters(given):
        if path in known:
            continue
        by = torch.zeros((), dtype=REAL, requires_grad=True)
        if path in refused:
            with pytest.raises(ValueError, match="no derivative"):
                loss(moved(given, path, by))
            continue
        loss(moved(given, path, by)).backward()
        with torch.no_grad():
            above, below = (float(loss(moved(given, path, by + sign * change))) for sign in (1, -1))
        found, expected = 0.0 if by.grad is None else float(by.grad), (above - below) / (2.0 * change)
        assert found == pytest.approx(expected, rel=1e-5, abs=2e-9), path
        if found == 0.0:
            without.add(path)
    assert without <= unread
    assert {"state.pos", "cloth.mass", "step.pin_stiffness", "step.attachments.speed"}.isdisjoint(without)


class Learned(nn.Module):
    """An own energy with parameters in a list, a dict and a module."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 4, dtype=REAL)
        self.power = torch.tensor(0.1, dtype=REAL)
        self.listed, self.named = [torch.tensor(0.3, dtype=REAL)], {"size": (torch.tensor(0.2, dtype=REAL),)}

    def applies(self, problem: StepProblem) -> bool:
        return True

    def forward(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        energy = (self.power.exp() * self.listed[0] * self.layer(20.0 * next_pos) + self.named["size"][0]).square().sum(dim=1)
        return problem.sum_vertices(1e-3 * energy)


def test_an_own_energy_may_have_tensors_in_lists_and_modules() -> None:
    torch.manual_seed(0)
    own = Learned()
    potential, problem = sheet_on_a_ball(default_potential().with_terms(own=own))
    tensors = own.layer.weight, own.layer.bias, own.listed[0], own.named["size"][0], own.power
    given = [one.requires_grad_() for one in tensors]
    found = torch.autograd.grad(loss((potential, problem)), given)
    for tensor, by in zip(given, found, strict=True):
        way, change, ends = wave(tensor), 1e-5, []
        for sign in (1.0, -2.0):
            tensor.data += sign * change * way
            ends.append(float(loss((potential, problem)).detach()))
        tensor.data += change * way
        assert float((by * way).sum()) == pytest.approx((ends[0] - ends[1]) / (2.0 * change), rel=1e-5)


def test_tensors_of_own_energies_have_names() -> None:
    found = constants_of(default_potential().with_terms(own=Learned()))
    tensors = {name for name, value in found.items() if isinstance(value, Tensor)}
    assert tensors == {"own.layer.weight", "own.layer.bias", "own.listed.0", "own.named.size.0", "own.power"}
    assert found["friction.coefficient"] == 0.5


def test_what_would_be_dropped_is_refused() -> None:
    outside = torch.tensor(2.0, dtype=REAL, requires_grad=True)

    class Closed:
        def applies(self, problem: StepProblem) -> bool:
            return True

        def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
            return problem.sum_vertices(outside * next_pos[:, 1])

    potential, problem = sheet_on_a_ball(default_potential().with_terms(own=Closed()))
    with pytest.raises(ValueError, match="the term own depends on a tensor with a gradient that is none of its attributes"):
        loss((potential, problem))
    with pytest.raises(ValueError, match=r"the potential has no term for them; give hood\.energies\.potential\.with_soft_pins"):
        loss((default_potential(), problem))
    with pytest.raises(ValueError, match="wind: gusts is a tensor, by which steps have no derivative; give a number"):
        Wind((1.0, 0.0, 0.0), gusts=outside)  # type: ignore[arg-type]
    known = problem.with_contact()
    assert known.contact is not None
    moving = replace(known, contact=replace(known.contact, dist=known.contact.dist.clone().requires_grad_()))
    with pytest.raises(ValueError, match="contact of the problem has a tensor with a gradient, but every step finds it itself"):
        loss((with_soft_pins(default_potential()), moving))


def pressed_strip(rg: float) -> tuple[NewtonStepper, StepProblem]:
    """A strip of cloth whose ends are brought nearer to each other by a fifth."""
    pos, faces = grid(9, 3, 0.2)
    pos = (pos + np.random.default_rng(0).normal(0.0, 1e-4, pos.shape)) * [1.0, 1.0, 0.3]
    held = (np.arange(len(pos)) < 3) | (np.arange(len(pos)) >= 24)
    cloth = build_cloth(pos, faces, hood.Material(), held, dtype=REAL)
    start = torch.as_tensor(pos)
    step = StepInput(torch.full((1,), 1.0 / 30.0, dtype=REAL), pin_target=start * torch.tensor([0.8, 1.0, 1.0], dtype=REAL))
    problem = StepProblem(cloth, State(start, torch.zeros_like(start), torch.zeros(1, 3, dtype=REAL)), step)
    return NewtonStepper(default_potential(), NewtonSettings(target_rg=rg)), problem


@pytest.mark.parametrize("compiled", [True, False])
def test_an_indefinite_hessian_is_solved_and_said(compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not compiled:
        monkeypatch.setattr(adjoint, "_compiled", lambda *given: None)
    stepper, problem = pressed_strip(1000.0)
    with torch.no_grad():
        pos = stepper.predict(problem, None).next_pos
    at = stepper.potential, problem, pos
    hessian, free = Hessian(*at), problem.cloth.free
    rows = torch.eye(pos.numel(), dtype=REAL)[free.repeat_interleave(3)].view(-1, *pos.shape)
    dense = torch.stack([hessian(row)[free].reshape(-1) for row in rows])
    torch.testing.assert_close(dense, dense.t(), rtol=0.0, atol=1e-9 * float(dense.abs().max()))
    assert float(torch.linalg.eigvalsh(dense)[0]) < -1e-3
    right = torch.where(free.unsqueeze(1), wave(pos), 0.0)
    expected = torch.linalg.solve(dense, right[free].reshape(-1))
    found = adjoint.solve_symmetric(hessian, adjoint.Preconditioner(*at), right)
    assert found.met
    assert found.indefinite
    assert float((found.value[free].reshape(-1) - expected).norm() / expected.norm()) < 1e-6


def test_steps_that_ended_at_no_minimum_are_named() -> None:
    for rg, expected in ((1000.0, True), (1e-9, False)):
        stepper, problem = pressed_strip(rg)
        mu = problem.cloth.lame_mu.clone().requires_grad_()
        after = differentiable_step(stepper, replace(problem, cloth=replace(problem.cloth, lame_mu=mu)))
        assert not indefinite_at(after)
        after.pos.sum().backward()
        assert indefinite_at(after) is expected


def test_constants_may_be_tensors_of_one() -> None:
    """The solver takes them as numbers, bit for bit."""
    given = sheet_on_a_ball(default_potential())
    weight, coefficient = (torch.tensor(value, dtype=REAL) for value in (5e5, 0.5))
    collision, friction = Collision(weight), Friction(coefficient, weight=weight)  # type: ignore[arg-type]
    other = given[0].with_terms(collision=collision, friction=friction)
    ends = [NewtonStepper(potential).predict(given[1], None).next_pos for potential in (given[0], other)]
    assert torch.equal(*ends)

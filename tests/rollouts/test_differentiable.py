"""Derivatives of implicit steps: against closed forms, and against central differences of converged steps in float64."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

import hood
from hood.cloth.cloth import Cloth, build_cloth, with_values
from hood.cloth.state import Obstacle, State, StepInput
from hood.energies.friction import Friction
from hood.energies.potential import Potential, default_potential, with_soft_pins
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, LayerFriction, _followed_pressing, _pairs, _pressing, nearest_weights
from hood.energies.wind import Wind
from hood.rollouts import adjoint
from hood.rollouts.differentiable import differentiable_step
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import NewtonStepper, implicit_euler

REAL = torch.float64
EXACT = NewtonSettings(target_rg=1e-10, max_iterations=500)
Values = dict[str, Tensor]


def number(value: float, grad: bool = False) -> Tensor:
    return torch.tensor(value, dtype=REAL, requires_grad=grad)


def sheet(count: int, edge: float, height: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A horizontal grid of ``count`` by ``count`` vertices with its diagonals in turns, a little uneven."""
    x, z = np.meshgrid(edge * np.arange(count), edge * np.arange(count), indexing="ij")
    pos = np.stack([x.ravel(), np.full(count**2, height), z.ravel()], axis=1)
    pos += np.random.default_rng(seed).normal(0.0, 3e-4, pos.shape)
    faces = []
    for i in range(count - 1):
        for j in range(count - 1):
            a, b, c, d = i * count + j, i * count + j + 1, (i + 1) * count + j, (i + 1) * count + j + 1
            faces += [[a, c, b], [b, c, d]] if (i + j) % 2 else [[a, d, b], [a, c, d]]
    return pos, np.array(faces)


def at_rest(pos: np.ndarray) -> State:
    start = torch.as_tensor(pos)
    return State(start, torch.zeros_like(start), torch.zeros(1, 3, dtype=REAL))


def weigh(states: Iterator[State], start: np.ndarray) -> Tensor:
    """A loss of all states that tells every coordinate from every other."""
    weights = torch.sin(torch.arange(start.size, dtype=REAL)).reshape(-1, 3)
    parts = [((state.pos - torch.as_tensor(start)) * weights).sum() + 0.01 * state.vel.square().sum() for state in states]
    return torch.stack(parts).sum()


def frames(potential: Potential, cloth: Cloth, state: State, steps: list[StepInput], gravity: Tensor) -> Iterator[State]:
    stepper = NewtonStepper(potential, EXACT)
    for step in steps:
        state = differentiable_step(stepper, StepProblem(cloth, state, step, gravity=gravity))
        yield state


def check(loss: Callable[[Values], Tensor], usual: dict[str, float], allowed: float, change: float = 1e-5) -> None:
    """The derivatives by all numbers are those of central differences, to a share."""
    given = {name: number(value, grad=True) for name, value in usual.items()}
    loss(given).backward()
    for name, value in usual.items():
        step = change * abs(value)
        ends = (
            loss({key: number(one + (sign * step if key == name else 0.0)) for key, one in usual.items()}) for sign in (1, -1)
        )
        above, below = (float(end) for end in ends)
        found = given[name].grad
        assert found is not None, name
        assert float(found) == pytest.approx((above - below) / (2.0 * step), rel=allowed), name


def down(g: Tensor) -> Tensor:
    return torch.stack([torch.zeros_like(g), -g, torch.zeros_like(g)])


def triangle() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Held along its upper edge, 0.2 m high."""
    return np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, -0.2, 0.0]]), np.array([[0, 2, 1]]), np.array([True, True, False])


def test_a_hanging_triangle_stretches_as_its_closed_form_says() -> None:
    """Its strain is s² − 1 over 2 along the height and nothing else: (λ + 2 μ)(s² − 1) s / 2 = m g l / (A h)."""
    pos, faces, held = triangle()
    base = build_cloth(pos, faces, hood.Material(lame_mu=2e3, lame_lambda=3e3), held, dtype=REAL)
    mu = number(2e3, grad=True)
    step = StepInput(torch.full((1,), 1e4, dtype=REAL), pin_target=torch.as_tensor(pos))
    cloth = with_values(base, lame_mu=mu)
    stepper = NewtonStepper(default_potential(), replace(EXACT, target_rg=1e-13))
    after = differentiable_step(stepper, StepProblem(cloth, at_rest(pos), step))
    (found,) = torch.autograd.grad(-after.pos[2, 1], mu)
    area, thickness, mass = float(base.rest_area[0]), float(base.thickness[0]), float(base.mass[2])
    load, stiffness = mass * 9.81 * 0.2 / (area * thickness), 2.0 * 2e3 + 3e3
    stretch = max(root.real for root in np.roots([0.5 * stiffness, 0.0, -0.5 * stiffness, -load]) if abs(root.imag) < 1e-9)
    assert float(-after.pos[2, 1].detach()) == pytest.approx(0.2 * stretch, rel=1e-8)
    slope = -0.2 * (stretch**2 - 1.0) * stretch / (0.5 * stiffness * (3.0 * stretch**2 - 1.0))
    assert float(found) == pytest.approx(slope, rel=1e-6)


def test_a_pendulum_is_slower_with_less_gravity_as_its_recursion_says() -> None:
    """Small swings by implicit Euler are θ₊ (1 + ω² dt²) = 2 θ − θ₋ with ω² = g / l; their derivatives by g are another."""
    pos, faces, held = triangle()
    angle, dt, count, g = 1e-4, 1.0 / 30.0, 40, 9.81
    base = build_cloth(pos, faces, hood.Material(lame_mu=1e8, lame_lambda=0.0), held, dtype=REAL)
    start = pos.copy()
    start[2] = 0.0, -0.2 * math.cos(angle), 0.2 * math.sin(angle)
    steps = [StepInput(torch.full((1,), dt, dtype=REAL), pin_target=torch.as_tensor(pos))] * count
    gravity = number(g, grad=True)
    *_, last = frames(default_potential(), base, at_rest(start), steps, down(gravity))
    (found,) = torch.autograd.grad(last.pos[2, 2], gravity)
    now = before = angle
    slope = slope_before = 0.0
    for _ in range(count):
        factor = 1.0 + dt**2 * g / 0.2
        new = (2.0 * now - before) / factor
        new_slope = (2.0 * slope - slope_before - new * dt**2 / 0.2) / factor
        now, before, slope, slope_before = new, now, new_slope, slope
    assert float(last.pos[2, 2].detach()) == pytest.approx(0.2 * now, rel=1e-3)
    assert float(found) == pytest.approx(0.2 * slope, rel=1e-3)


@pytest.mark.parametrize("count", [1, 6])
def test_a_hanging_sheet_by_fabric_rest_shape_start_and_pins(count: int) -> None:
    pos, faces = sheet(4, 0.03)
    held = np.arange(len(pos)) < 4
    base = build_cloth(pos, faces, hood.Material(), held, dtype=REAL)
    names = ("density", "lame_mu", "lame_lambda", "bending_stiffness")
    usual = {"density": 0.2, "lame_mu": 23600.0, "lame_lambda": 44400.0, "bending_stiffness": 4e-4}
    usual |= {"size": 1.02, "g": 9.81, "pins": 0.01, "moved": 1e-3, "speed": 0.1}

    def loss(of: Values) -> Tensor:
        cloth = with_values(base, rest_pos=of["size"] * base.rest_pos, **{name: of[name] for name in names})
        start = at_rest(pos)
        start = replace(start, pos=start.pos + of["moved"], vel=start.vel + of["speed"])
        target = torch.as_tensor(pos) + of["pins"] * torch.tensor([1.0, 0.5, 0.2], dtype=REAL)
        steps = [StepInput(torch.full((1,), 1.0 / 30.0, dtype=REAL), pin_target=target)] * count
        return weigh(frames(default_potential(), cloth, start, steps, down(of["g"])), pos)

    check(loss, usual, allowed=1e-5)


@pytest.mark.parametrize("contact", ["vertices", "edges", "strict"])
def test_a_sheet_on_a_moving_ball_by_friction_and_by_the_ball(contact: str) -> None:
    ball = trimesh.creation.icosphere(2, 0.15)
    points, triangles = torch.tensor(np.array(ball.vertices)), torch.tensor(np.array(ball.faces), dtype=torch.int64)
    points += 1e-3 * torch.sin(torch.arange(points.numel(), dtype=REAL)).reshape(-1, 3)  # no two edges turn alike
    pos, faces = sheet(6, 0.04, height=0.151)
    pos -= [0.09, 0.0, 0.11]
    base = build_cloth(pos, faces, hood.Material(), dtype=REAL)
    none = torch.zeros(len(points), dtype=torch.int64)
    usual = {"density": 0.2, "lame_mu": 23600.0, "bending_stiffness": 4e-4, "friction": 0.5, "radius": 1.0, "way": 0.004}
    usual |= {"moved": 0.1, "speed": 0.5}  # less most of it

    def loss(of: Values, contact: str = contact) -> Tensor:
        cloth = with_values(base, **{name: of[name] for name in ("density", "lame_mu", "bending_stiffness")})
        potential = default_potential(contact=contact, reach="constant")
        potential = potential.with_terms(friction=Friction(of["friction"], contact=contact, reach="constant"))  # type: ignore[arg-type]
        start = at_rest(pos)
        start = replace(start, pos=start.pos + of["moved"] - 0.0999, vel=start.vel + of["speed"] - 0.48)

        def there(frame: int) -> Tensor:
            return of["radius"] * points + frame * of["way"] * torch.tensor([0.0, 0.2, 1.0], dtype=REAL)

        steps = [
            StepInput(
                torch.full((1,), 1.0 / 30.0, dtype=REAL),
                Obstacle(there(k), there(k + 1), there(k - 1), triangles, none, torch.zeros_like(triangles[:, 0]), none > 0),
            )
            for k in range(4)
        ]
        return weigh(frames(potential, cloth, start, steps, down(number(9.81))), pos)

    check(loss, usual, allowed=1e-5, change=1e-6)
    if contact != "vertices":  # points inside edges and faces press
        given = {name: number(value) for name, value in usual.items()}
        assert float(loss(given)) != pytest.approx(float(loss(given, "vertices")), rel=1e-3)


def test_the_written_out_derivatives_are_those_of_autograd(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a fabric with a warp, its mass and friction, by positions, velocities and gravity, on a body with a fold beside it."""
    ball = trimesh.creation.icosphere(2, 0.15)
    one, triangles = torch.tensor(np.array(ball.vertices)), torch.tensor(np.array(ball.faces), dtype=torch.int64)
    points = torch.cat([one, one + torch.tensor([0.0, 0.0, 0.304], dtype=REAL)])
    points += 1e-3 * torch.sin(torch.arange(points.numel(), dtype=REAL)).reshape(-1, 3)
    faces = torch.cat([triangles, triangles + len(one)])
    pos, mesh = sheet(6, 0.04)
    pos = pos[:, [0, 2, 1]] + np.array([-0.09, 0.0, 0.152])  # upright, between both
    base = build_cloth(pos, mesh, hood.Material(warp=2.0, shear=0.5), dtype=REAL)
    start = pos + np.random.default_rng(1).normal(0.0, 1e-3, pos.shape)  # at rest the cloth around pulls nothing, to rounding
    none = torch.zeros(len(points), dtype=torch.int64)
    way = torch.tensor([0.002, 0.004, 0.001], dtype=REAL)
    obstacle = Obstacle(points, points + way, points - way, faces, none, torch.zeros_like(faces[:, 0]), none > 0)
    step = StepInput(torch.full((1,), 1.0 / 30.0, dtype=REAL), obstacle)

    def derivatives() -> dict[str, Tensor]:
        given = {name: getattr(base, name).clone() for name in ("mass", "friction", "lame_mu", "rest_inverse", "rest_angle")}
        given |= {"pos": torch.as_tensor(start), "vel": torch.zeros_like(base.rest_pos), "gravity": down(number(9.81))}
        given |= {"bending_stiffness": base.bending_stiffness.clone(), "coefficient": number(0.5)}
        given = {name: value.clone().requires_grad_() for name, value in given.items()}
        cloth = replace(base, **{name: value for name, value in given.items() if hasattr(base, name)})
        state = State(given["pos"], given["vel"], torch.zeros(1, 3, dtype=REAL))
        potential = default_potential().with_terms(friction=Friction(given["coefficient"]))  # type: ignore[arg-type]
        states = list(frames(potential, cloth, state, [step] * 2, given["gravity"]))
        weigh(iter(states), pos).backward()
        return {name: value.grad for name, value in given.items() if value.grad is not None}

    compiled = derivatives()
    assert len(compiled) == 10
    monkeypatch.setattr(adjoint, "_written_out", lambda potential, taken: ([], potential))
    monkeypatch.setattr(adjoint, "_followed", lambda potential, problem, taken: {})
    monkeypatch.setattr(adjoint, "_compiled", lambda *given: None)
    for name, expected in derivatives().items():
        assert bool(expected.any()), name
        torch.testing.assert_close(compiled[name], expected, rtol=1e-6, atol=1e-7 * float(expected.abs().max()), msg=name)


def two_sheets() -> tuple[np.ndarray, Cloth]:
    """A loose sheet just above one that is held at its corners."""
    (below, faces), (above, _) = sheet(5, 0.03), sheet(5, 0.03, height=0.0035, seed=1)
    pos = np.concatenate([below, above + [0.007, 0.0, 0.005]])
    held = np.isin(np.arange(len(pos)), [0, 4, 20, 24])
    return pos, build_cloth(pos, np.concatenate([faces, faces + 25]), hood.Material(), held, dtype=REAL)


def test_a_sheet_that_falls_on_a_sheet_and_slides() -> None:
    pos, base = two_sheets()
    potential = default_potential().with_terms(layers=LayerBarrier(), rubbing=LayerFriction(0.3), air=Wind((0.0, 0.0, 0.0)))
    usual = {"density": 0.2, "lame_mu": 23600.0, "bending_stiffness": 4e-4, "g": 9.81, "speed": 0.05}

    def loss(of: Values) -> Tensor:
        cloth = with_values(base, **{name: of[name] for name in ("density", "lame_mu", "bending_stiffness")})
        start = at_rest(pos)
        loose = torch.arange(len(pos)).unsqueeze(1) >= 25
        start = replace(start, vel=torch.where(loose, of["speed"] * torch.tensor([1.0, -1.0, 0.3], dtype=REAL), 0.0))
        steps = [StepInput(torch.full((1,), 1.0 / 30.0, dtype=REAL), pin_target=torch.as_tensor(pos))] * 5
        return weigh(frames(potential, cloth, start, steps, down(of["g"])), pos)

    check(loss, usual, allowed=1e-5, change=1e-6)


def test_the_pressing_of_layers_is_that_of_the_compiled_search() -> None:
    pos, cloth = two_sheets()
    potential = default_potential().with_terms(layers=LayerBarrier(), rubbing=LayerFriction(0.3))
    step = StepInput(torch.full((1,), 1.0 / 30.0, dtype=REAL), pin_target=torch.as_tensor(pos))
    problem = StepProblem(cloth, at_rest(pos), step)
    for taken in implicit_euler(potential, problem, 3, EXACT):
        problem = replace(problem, state=taken.state)
    known = potential.prepare(problem)
    pairs = _pairs(known)
    assert len(pairs.corners) > 10
    inertia = cloth.mass / (1.0 / 30.0) ** 2
    there = torch.where(cloth.free.unsqueeze(1), _flown(known), torch.as_tensor(pos))
    found = _followed_pressing(pairs, inertia, there, known.internal_force, ~cloth.free)
    expected = _pressing(known, pairs)
    assert torch.isfinite(expected).any()
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-15)


def _flown(problem: StepProblem) -> Tensor:
    dt = problem.vertex_dt
    return problem.state.pos + dt * (problem.state.vel + dt * problem.gravity.to(dt))


def test_nearest_points_are_the_searched_ones_and_move_as_they_do() -> None:
    """Weights that were kept are those of the search, to rounding; where corners move, of the nearest points there."""
    pos, base = two_sheets()
    layers = LayerBarrier(reach=6e-3).prepare(StepProblem(base, at_rest(pos), StepInput(torch.ones(1, dtype=REAL)))).layers[0]
    near = layers.layers.contacts(pos)
    known, edges = torch.as_tensor(near.weights), torch.as_tensor(near.edges)
    assert bool(edges.any())
    assert bool((~edges).any())
    corners = torch.as_tensor(pos)[torch.as_tensor(near.corners)]
    torch.testing.assert_close(nearest_weights(corners, known, edges), known, rtol=0.0, atol=1e-9)


def test_states_are_those_of_the_solver_bit_for_bit() -> None:
    pos, faces = sheet(4, 0.03)
    held = np.arange(len(pos)) < 4
    cloth = build_cloth(pos, faces, hood.Material(), held, dtype=REAL)
    step = StepInput(torch.full((1,), 1.0 / 30.0, dtype=REAL), pin_target=torch.as_tensor(pos))
    problem = StepProblem(cloth, at_rest(pos), step)
    plain = [one.state for one in implicit_euler(default_potential(), problem, 3, EXACT)]
    mu = number(23600.0, grad=True)
    followed = list(frames(default_potential(), with_values(cloth, lame_mu=mu), at_rest(pos), [step] * 3, problem.gravity))
    for one, other in zip(plain, followed, strict=True):
        assert torch.equal(one.pos, other.pos.detach())
        assert torch.equal(one.vel, other.vel.detach())


def test_a_rollout_of_a_garment_by_name() -> None:
    simulation = hood.simulate("tank", "walk_brisk", num_frames=3, stepper="newton", solver={"target_rg": 1e-9}, metrics="none")
    usual = {"lame_mu": 23600.0, "density": 0.2}

    def loss(of: Values) -> Tensor:
        start = simulation.scene.garment.rest_pos
        return weigh(hood.differentiable(simulation, **of), start)

    check(loss, usual, allowed=1e-4, change=1e-4)


def test_what_has_no_derivative_is_refused() -> None:
    simulation = hood.simulate("tank", "plie", num_frames=3, stepper="newton")
    with pytest.raises(ValueError, match=r"'mu' is no number of a fabric; give density"):
        next(hood.differentiable(simulation, mu=number(1.0)))
    with pytest.raises(ValueError, match=r"friction has the shape \(3,\); give one number or \(1016,\)"):
        next(hood.differentiable(simulation, friction=torch.ones(3, dtype=REAL)))
    pos, faces = sheet(3, 0.03)
    problem = StepProblem(build_cloth(pos, faces, hood.Material()), at_rest(pos), StepInput(torch.ones(1, dtype=REAL)))
    half = replace(problem, gravity=torch.zeros(3, requires_grad=True))
    with pytest.raises(ValueError, match=r"a tensor is torch.float32; give cloth, state and parameters in torch.float64"):
        differentiable_step(NewtonStepper(default_potential()), half)


def test_places_and_stiffness_of_soft_pins() -> None:
    pos, faces = sheet(3, 0.05)
    cloth = build_cloth(pos, faces, hood.Material(), dtype=REAL)
    potential = with_soft_pins(default_potential())

    def loss(given: Values) -> Tensor:
        target = torch.as_tensor(pos) + given["shift"] * torch.tensor([0.3, 1.0, -0.5], dtype=REAL)
        stiffness = given["stiffness"] * torch.as_tensor(np.arange(9) < 3).to(REAL)
        step = StepInput(dt=torch.tensor([1 / 30], dtype=REAL), pin_target=target, pin_stiffness=stiffness)
        gravity = torch.tensor([0.0, -9.81, 0.0], dtype=REAL)
        return weigh(frames(potential, cloth, at_rest(pos), [step] * 3, gravity), pos)

    check(loss, {"shift": 0.01, "stiffness": 12.0}, 1e-5)

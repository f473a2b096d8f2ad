"""Steps one by one, windows, events and jumps, and networks: derivatives against central differences, and what is refused."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

import hood
from hood.cloth.state import State
from hood.energies.problem import StepProblem
from hood.mesh.shapes import grid, sphere
from hood.rollouts.differentiable import differentiable_step, prepare
from hood.rollouts.gradients import followed_stepper
from hood.tensors.batch import to_device

REAL = torch.float64
Values = dict[str, Tensor]
HANGING: dict[str, Any] = {"body": "none", "pins": [0, 4]}
EXACT: dict[str, Any] = {"stepper": "newton", "solver": {"target_rg": 1e-10, "max_iterations": 300}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("sheets")
    pos, faces = grid(5, 5, 0.2)
    for name, (points, triangles) in {"sheet": (pos + [-0.09, 0.104, -0.1], faces), "ball": sphere(2, 0.1)}.items():
        trimesh.Trimesh(points, triangles, process=False).export(made / f"{name}.obj")
    return made


def simulated(folder: Path, num_frames: int, **keys: Any) -> hood.Simulation:
    usual: dict[str, Any] = {"num_frames": num_frames, "settle": 0, "metrics": "none", "worn": False, "kernels": "torch"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what may be simulated with these weights
        return hood.simulate(str(folder / "sheet.obj"), **usual | keys)


def number(value: float, grad: bool = False) -> Tensor:
    return torch.tensor(value, dtype=REAL, requires_grad=grad)


def weigh(states: list[State]) -> Tensor:
    """A loss that tells every coordinate of every frame from every other."""
    parts = []
    for state in states:
        weights = torch.sin(torch.arange(state.pos.numel(), dtype=state.pos.dtype)).reshape(-1, 3)
        parts.append(((state.pos + state.origin.to(state.pos)) * weights).sum() + 0.01 * state.vel.square().sum())
    return torch.stack(parts).sum()


def moved(start: State, values: Values) -> State:
    """The start with noise, a shift that differs from vertex to vertex, and a speed."""
    noise = 1e-3 * torch.as_tensor(np.random.default_rng(0).normal(size=start.pos.shape))
    wave = torch.sin(torch.arange(start.pos.numel(), dtype=REAL)).reshape(-1, 3)
    return State(start.pos.double() + noise + values["shift"] * wave, start.vel.double() + values["speed"], start.origin)


def check(loss: Callable[[Values], Tensor], usual: dict[str, float], change: float = 1e-6) -> None:
    """Derivatives are those of a central difference along a way to which all numbers give the same share."""
    given = {name: number(value, grad=True) for name, value in usual.items()}
    loss(given).backward()
    found = {name: float(value.grad) for name, value in given.items() if value.grad is not None}
    assert found.keys() == usual.keys()
    share = change * min(abs(found[name] * value) for name, value in usual.items())
    assert share > 0.0
    with torch.no_grad():
        ends = (loss({name: number(value + way * share / found[name]) for name, value in usual.items()}) for way in (1, -1))
        above, below = (float(end) for end in ends)
    assert (above - below) / (2.0 * share) == pytest.approx(len(usual), rel=1e-5)


USUAL = {"lame_mu": 23600.0, "density": 0.2, "bending_stiffness": 4e-5, "shift": 1e-3, "speed": 0.05}
FABRIC = ("lame_mu", "density", "bending_stiffness")


@pytest.mark.parametrize("weights", ["paper-fine15-l32-20k", "quickstart", "edges"])
@pytest.mark.parametrize("on", ["air", "ball"])
def test_a_network_is_differentiated_by_all_that_it_is_told(folder: Path, weights: str, on: str) -> None:
    scene = HANGING if on == "air" else {"body": str(folder / "ball.obj"), "pins": "none"}
    simulation = simulated(folder, 2, checkpoint=weights, **scene)
    start, rest = simulation.start(), simulation.scene.cloth.rest_pos.double()
    sees = weights != "paper-fine15-l32-20k"

    def loss(of: Values) -> Tensor:
        given: dict[str, Any] = {name: of[name] for name in FABRIC} | {"rest_pos": (1.0 + of["wider"]) * rest}
        if sees:
            given["gravity"] = of["g"] * torch.tensor([0.0, -1.0, 0.0], dtype=REAL)
        return weigh(list(hood.differentiable(simulation, start=moved(start, of), **given)))

    check(loss, USUAL | {"wider": 0.01} | ({"g": 9.81} if sees else {}))


@pytest.mark.parametrize("weights", ["paper-fine15-l32-20k", "quickstart"])
def test_a_network_is_differentiated_by_the_body(folder: Path, weights: str) -> None:
    simulation = simulated(folder, 2, checkpoint=weights, body=str(folder / "ball.obj"), pins="none")
    start, usual = simulation.start(), {"radius": 1.0, "way": 0.004}
    network = followed_stepper(simulation, given={"radius": number(1.0)})
    scene = replace(simulation.scene, cloth=to_device(simulation.scene.cloth, dtype=REAL))
    prepared = prepare(network, scene)

    def loss(of: Values) -> Tensor:
        state = moved(start, {"shift": number(1e-3), "speed": number(0.05)})
        step = scene.step_input(0, state)
        assert step.obstacle is not None
        points = step.obstacle.pos.double()
        ends = {
            name: of["radius"] * points + sign * of["way"] for name, sign in (("pos", 0), ("next_pos", 1), ("prev_pos", -1))
        }
        step = replace(step, dt=step.dt.double(), time=None, obstacle=replace(to_device(step.obstacle, dtype=REAL), **ends))
        problem = StepProblem(scene.cloth, state, step, gravity=network.gravity)
        return weigh([differentiable_step(network, problem, prepared=prepared)])

    check(loss, usual)


def test_frames_of_a_network_are_those_of_its_rollout_bit_for_bit(folder: Path) -> None:
    simulation = simulated(folder, 4, checkpoint="quickstart", **HANGING)
    mu = torch.tensor(23600.0, requires_grad=True)
    frames = [frame.state for frame in simulation]
    for plain, followed in zip(frames[1:], hood.differentiable(simulation, lame_mu=mu), strict=True):
        assert followed.pos.dtype == torch.float32
        assert torch.equal(plain.pos, followed.pos.detach())
        assert torch.equal(plain.vel, followed.vel.detach())
    found = hood.differentiable(simulation, lame_mu=mu).gradients(weigh)
    assert bool(found.by["lame_mu"] != 0.0)
    assert (found.error, found.steps) == ({}, ())


def test_what_a_network_is_not_told_of_is_named(folder: Path) -> None:
    simulation = simulated(folder, 2, checkpoint="paper-fine15-l32-20k", **HANGING)
    given = {"density": number(0.2, True), "friction": number(1.0, True)}
    gravity = torch.tensor([0.0, -9.81, 0.0], dtype=REAL, requires_grad=True)
    with pytest.warns(UserWarning, match=r"the network is not told of gravity, friction: gradients by that are zero"):
        found = hood.differentiable(simulation, gravity=gravity, **given).gradients(weigh)
    assert [name for name, grad in found.by.items() if not grad.any()] == ["gravity", "friction"]


def test_a_network_is_told_of_a_fabric_that_differs_from_face_to_face(folder: Path) -> None:
    """What faces and hinges say is told at vertices and edges as of a fabric given there, in a torch that follows it."""
    simulation = simulated(folder, 2, checkpoint="quickstart", **HANGING)
    cloth = simulation.scene.cloth
    mu = torch.linspace(2e4, 3e4, len(cloth.faces), dtype=REAL)
    fabric = hood.Material(lame_mu=hood.FaceField(mu.numpy()))
    (expected,) = [frame.state for frame in simulated(folder, 2, checkpoint="quickstart", material=fabric, **HANGING)][1:]
    (found,) = hood.differentiable(simulation, lame_mu=mu.float())
    torch.testing.assert_close(found.pos, expected.pos, rtol=0.0, atol=2e-6)
    (uniform,) = hood.differentiable(simulation, lame_mu=float(mu.mean()))
    assert (uniform.pos - expected.pos).abs().max() > 1e-5


def test_every_rollout_of_a_network_looks_at_its_own_potential(folder: Path) -> None:
    """Also where steps of two are taken in turns; the simulation keeps its own."""
    simulation = simulated(folder, 3, checkpoint="quickstart", **HANGING)
    before = [frame.state for frame in simulation]
    own = simulation.potential
    lighter = own.only({name: term for name, term in own.terms.items() if name != "gravity"})
    one, other = (hood.differentiable(simulation, potential=potential) for potential in (lighter, own))
    turns = [(first, second) for first, second in zip(one, other, strict=True)]
    for (first, second), expected in zip(turns, before[1:], strict=True):
        assert torch.equal(second.pos, expected.pos)
        assert (first.pos - expected.pos).abs().max() > 1e-5
    (alone, _) = hood.differentiable(simulation, potential=lighter, start=simulation.start())
    assert torch.equal(alone.pos, turns[0][0].pos)
    assert torch.equal(hood.step(simulation, simulation.start(), 0, potential=lighter).pos, alone.pos)
    assert all(torch.equal(frame.state.pos, expected.pos) for frame, expected in zip(simulation, before, strict=True))


def test_the_estimate_of_errors_keeps_the_gravity_of_the_simulation(folder: Path) -> None:
    simulation = simulated(folder, 3, gravity=1.62, **HANGING, **EXACT)
    found = hood.differentiable(simulation, density=number(0.2, True)).gradients(weigh)
    assert found.error["density"] < 1e-5


def test_a_tensor_that_was_changed_in_place_has_no_gradient_any_more(folder: Path) -> None:
    for keys, mu in ((EXACT, number(23600.0, True)), ({"checkpoint": "quickstart"}, torch.tensor(23600.0, requires_grad=True))):
        simulation = simulated(folder, 2, **HANGING, **keys)
        frames = hood.differentiable(simulation, lame_mu=mu)
        loss = weigh([*frames])
        with torch.no_grad():
            mu *= 1.1
        with pytest.raises(RuntimeError, match="a tensor was changed in place since the step was taken"):
            loss.backward()
        with pytest.raises(RuntimeError, match="a tensor was changed in place"):
            frames.gradients(weigh)


@pytest.mark.parametrize(
    "keys",
    [
        EXACT,
        {"checkpoint": "small1"},
        {"checkpoint": "paper-fine15-l32-20k"},
        {"checkpoint": "paper-fine15-l32-20k", "settle": 1},
    ],
)
def test_steps_one_by_one_are_the_frames(folder: Path, keys: dict[str, Any]) -> None:
    simulation = simulated(folder, 4, **HANGING | keys)
    with torch.no_grad():
        state = simulation.start()
        for frame, expected in enumerate([one.state for one in simulation][1:]):
            state = hood.step(simulation, state, frame)
            assert torch.equal(state.pos, expected.pos)
            assert torch.equal(state.vel, expected.vel)
    assert not state.pos.requires_grad


def test_a_corner_comes_where_it_is_asked_by_where_the_cloth_is_held(folder: Path) -> None:
    simulation = simulated(folder, 5, **HANGING, **EXACT)
    start = simulation.start()
    held = start.origin + start.pos

    def corner(shift: Tensor) -> Tensor:
        state = start
        for frame in range(4):
            state = hood.step(simulation, state, frame, targets=held + (frame + 1) / 4 * shift)
        return (state.origin + state.pos)[24]

    with torch.no_grad():
        goal = corner(torch.tensor([0.06, 0.04, -0.02], dtype=REAL))
    shift = torch.zeros(3, dtype=REAL, requires_grad=True)

    def missed() -> Tensor:
        return corner(shift) - goal

    optimiser = torch.optim.LBFGS([shift], max_iter=20, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = 1e4 * missed().square().sum()
        loss.backward()
        return loss

    before = float(missed().detach().norm())
    optimiser.step(closure)  # type: ignore[arg-type]
    after = float(missed().detach().norm())
    assert after < 1e-3 < 0.01 < before


def test_what_no_step_can_be_taken_with_is_refused(folder: Path) -> None:
    simulation = simulated(folder, 3, body="none", pins="none", stepper="newton")
    state = simulation.start()
    with pytest.raises(ValueError, match="this motion has steps from the frames 0 to"):
        hood.step(simulation, state, -1)
    with pytest.raises(ValueError, match="no vertex is held in this step; give pins=…"):
        hood.step(simulation, state, 0, targets=state.pos)
    other = State(state.pos[:3], state.vel[:3], state.origin)
    with pytest.raises(ValueError, match=r"state.pos has the shape \(3, 3\); this cloth has 25 vertices"):
        hood.step(simulation, other, 0)
    with pytest.raises(ValueError, match="window is 0; give at least 1 step"):
        hood.differentiable(simulation, window=0)
    counted = simulated(folder, 3, **HANGING, checkpoint="quickstart", refine=3)
    with pytest.raises(ValueError, match=r"refined by Count, .* give hood.simulate\(refine='0.01rg'\)"):
        hood.step(counted, counted.start(), 0)


@pytest.mark.parametrize("keys", [{"stepper": "guess"}, {"checkpoint": "quickstart"}])
def test_steps_that_are_refined_to_a_goal_are_followed_as_the_solver_s(folder: Path, keys: dict[str, Any]) -> None:
    given = {"lame_mu": number(23600.0, True)}
    refined = simulated(folder, 4, refine="1e-8rg", **HANGING, **keys)
    found = hood.differentiable(refined, **given).gradients(weigh)
    exact = hood.differentiable(simulated(folder, 4, **HANGING, **EXACT), **given).gradients(weigh)
    assert float(found.by["lame_mu"]) == pytest.approx(float(exact.by["lame_mu"]), rel=1e-4)
    assert found.error["lame_mu"] < 1e-3
    *_, last = refined
    *_, same = hood.differentiable(refined)
    torch.testing.assert_close(same.pos, last.state.pos, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("keys", [EXACT, {"checkpoint": "small1"}])
def test_windows_cut_the_way_back(folder: Path, keys: dict[str, Any]) -> None:
    simulation = simulated(folder, 4, **HANGING, **keys)
    start = simulation.start()

    def slope(window: int | None) -> Tensor:
        mu = number(23600.0, True)
        return hood.differentiable(simulation, lame_mu=mu, window=window, start=start).gradients(weigh).by["lame_mu"]

    full, single = slope(None), slope(1)
    assert torch.equal(slope(3), full)
    by_hand, state = torch.zeros((), dtype=REAL), start
    for frame in range(3):
        mu = number(23600.0, True)
        state = hood.step(simulation, State(state.pos.detach(), state.vel.detach(), state.origin), frame, lame_mu=mu)
        by_hand += torch.autograd.grad(weigh([state]), mu)[0]
    torch.testing.assert_close(single, by_hand, rtol=1e-9, atol=0.0)
    assert len({float(slope(window)) for window in (1, 2, 3)}) == 3


EVENTS: dict[str, dict[str, Any]] = {
    "let go": {"events": [{"frame": 1, "detach": [0]}]},
    "grows": {"size_end": {"size": 1.05, "seconds": 0.1}},
}


@pytest.mark.parametrize("what", EVENTS)
@pytest.mark.parametrize("keys", [EXACT, {"checkpoint": "small1"}])
def test_events_are_followed(folder: Path, what: str, keys: dict[str, Any]) -> None:
    simulation = simulated(folder, 3, **HANGING, **keys, **EVENTS[what])
    assert simulation.scene.cloth_of_step(1, 0) is not simulation.scene.cloth
    start = simulation.start()

    def loss(of: Values) -> Tensor:
        return weigh(list(hood.differentiable(simulation, start=moved(start, of), **{name: of[name] for name in FABRIC})))

    check(loss, USUAL, 1e-7)
    plain = [one.state for one in simulation][1:]
    for one, expected in zip(hood.differentiable(simulation, lame_mu=torch.tensor(23600.0)), plain, strict=True):
        torch.testing.assert_close(one.pos, expected.pos, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("keys", [EXACT, {"checkpoint": "small1"}])
def test_a_body_that_jumps_takes_the_derivative_along(folder: Path, keys: dict[str, Any]) -> None:
    """Half a metre and a quarter turn in one step: the cloth goes with it, and so does what it depends on."""
    points, faces = sphere(2, 0.1)
    turned = points[:, [2, 1, 0]] * [1.0, 1.0, -1.0] + [0.5, 0.0, 0.0]
    ball = hood.BodyMesh(np.stack([points] * 2 + [turned] * 2), faces, 30.0)
    usual: dict[str, Any] = {"num_frames": 4, "settle": 0, "metrics": "none", "worn": False, "kernels": "torch", "pins": "none"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the weights
        simulation = hood.simulate(str(folder / "sheet.obj"), body=ball, **usual | keys)
    with pytest.warns(UserWarning, match="jumps by up to"):
        frames = [frame.world_pos for frame in simulation]
    assert float((frames[2] - frames[1]).norm(dim=1).min()) > 0.2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start = simulation.start()

    def loss(of: Values) -> Tensor:
        return weigh(list(hood.differentiable(simulation, 3, start=moved(start, of), **{name: of[name] for name in FABRIC})))

    check(loss, USUAL, 1e-7)
    for state, there in zip(hood.differentiable(simulation, start=start), frames[1:], strict=True):
        torch.testing.assert_close(state.origin + state.pos.double(), there, rtol=0.0, atol=1e-6)

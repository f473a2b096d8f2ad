"""Whole steps with features and feedback from the compiled library against those in torch."""

import pytest
import torch
from torch import Tensor

from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.model.features import compiled, local
from hood.model.features.inputs import Inputs
from hood.model.graph.builder import build_graph
from hood.model.readout.network_step import Dirichlet, Feedback
from hood.model.readout.output import LocalStepOutput, VelocityBaseOutput
from hood.native import features as native
from hood.scene.scene import Scene
from hood.steppers.network import NetworkStepper, build_simulator

pytestmark = pytest.mark.skipif(native.library() is None, reason="no C++ compiler")
PASSES = "1x(mesh+coarse0) 1x(coarse0) | 1x(mesh+coarse0) | 1x(mesh)"
SCENES = ["band_scene", "tank_scene"]


def make(features: str = "local", output: str = "local_steps", schedule: str = PASSES) -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator(features, output, schedule, latent_dim=16, output_init=0.3).eval()


def problem_of(scene: Scene, frame: int = 8) -> StepProblem:
    state = scene.start(frame)
    problem = StepProblem(scene.cloth, state, scene.step_input(frame, state))
    return default_potential().prepare(problem)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(
    "arguments",
    [
        ("local", "local_steps", PASSES),
        ("physical", "velocity_base", "1x(mesh+coarse0)"),
        ("paper", "acceleration", "1x(mesh+coarse0)"),
        ("local", "edges", "1x(mesh+coarse0)"),
        ("local", "global_steps", PASSES),
    ],
    ids=["local", "physical", "paper", "edges", "global"],
)
@torch.no_grad()
def test_a_step_is_that_of_torch(name: str, arguments: tuple[str, str, str], request: pytest.FixtureRequest) -> None:
    """To some roundings of positions, which stiff cloth turns into forces that the network sees."""
    scene: Scene = request.getfixturevalue(name)
    simulator, problem = make(*arguments), problem_of(scene)
    prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
    found = simulator.predict(problem, prepared).next_pos
    with native.in_torch():
        expected = simulator.predict(problem, prepared).next_pos
    assert float((found - expected).abs().max()) < 1e-5
    assert torch.equal(found, simulator.predict(problem, prepared).next_pos)


@pytest.mark.parametrize("name", SCENES)
@torch.no_grad()
def test_the_base_is_that_of_torch(name: str, request: pytest.FixtureRequest) -> None:
    problem = problem_of(request.getfixturevalue(name))
    found = VelocityBaseOutput().base(problem)
    with native.in_torch():
        expected = VelocityBaseOutput().base(problem)
    assert not torch.equal(expected, problem.state.pos)
    torch.testing.assert_close(found, expected, rtol=0.0, atol=5e-7)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("index", [0, 1])
@torch.no_grad()
def test_a_correction_is_that_of_torch(name: str, index: int, request: pytest.FixtureRequest) -> None:
    problem = problem_of(request.getfixturevalue(name))
    pos, output = problem.state.pos, LocalStepOutput()
    raw, step = torch.randn(len(pos), 5), 4e-3 * torch.randn(len(pos), 3)
    before = None if index == 0 else 1e-3 * torch.randn_like(pos)
    fixed = torch.randn_like(pos)

    def take() -> Tensor:
        return output.take(
            problem, raw, index, step, before, pos - 3e-3 * torch.sin(9 * pos), Dirichlet(problem.cloth.free, fixed)
        )

    found = take()
    with native.in_torch():
        expected = take()
    assert bool((step.norm(dim=1) > 5e-3).any()), "some local steps are to be shortened"
    assert torch.equal(found[~problem.cloth.free], fixed[~problem.cloth.free])
    torch.testing.assert_close(found, expected, rtol=0.0, atol=5e-7)


@torch.no_grad()
def test_residuals_of_neighbourhoods_are_those_of_torch(tank_scene: Scene) -> None:
    problem, simulator = problem_of(tank_scene), make()
    prepared = simulator.prepare(tank_scene.cloth, tank_scene.garment.rest_pos)
    graph = build_graph(prepared.static, problem.step, problem.contact.nearest)
    inputs = Inputs(problem.cloth, problem.state, problem.step, problem.contact, graph)
    pos = problem.state.pos + 1e-3 * torch.sin(60 * problem.state.pos.flip(1))
    found, force = Feedback(default_potential(), problem)(inputs, pos)
    with native.in_torch():
        expected, expected_force = Feedback(default_potential(), problem)(inputs, pos)
    # A rounding of a position of half a metre against elements of stiff cloth.
    assert float((force - expected_force).norm() / expected_force.norm()) < 1e-4
    for name in ("residual", "local_step", "wide_residual"):
        one, other = getattr(found, name), getattr(expected, name)
        assert float((one - other).norm() / other.norm()) < 1e-3


@torch.no_grad()
def test_global_steps_between_passes_are_those_of_torch(tank_scene: Scene) -> None:
    problem, simulator = problem_of(tank_scene), make(output="global_steps")
    prepared = simulator.prepare(tank_scene.cloth, tank_scene.garment.rest_pos)
    graph = build_graph(prepared.static, problem.step, problem.contact.nearest)
    inputs = Inputs(problem.cloth, problem.state, problem.step, problem.contact, graph)
    pos = problem.state.pos + 1e-3 * torch.sin(60 * problem.state.pos.flip(1))
    seen, _ = Feedback(default_potential(), problem, together=True)(inputs, pos)
    found, expected = compiled.look(seen, ("mesh",)), local.look_local(seen, ("mesh",))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-4)
    with native.in_torch():
        exact, _ = Feedback(default_potential(), problem, together=True)(inputs, pos)
    assert float((seen.global_step - exact.global_step).norm() / exact.global_step.norm()) < 1e-3


def test_training_goes_by_torch(tank_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("the library was called")

    simulator, problem = make().train(), problem_of(tank_scene)
    prepared = simulator.prepare(tank_scene.cloth, tank_scene.garment.rest_pos)
    monkeypatch.setattr(native, "call", refuse)
    simulator.predict(problem, prepared).next_pos.sum().backward()
    with torch.no_grad(), pytest.raises(AssertionError, match="the library was called"):
        simulator.predict(problem, prepared)

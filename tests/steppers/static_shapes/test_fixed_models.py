"""Steps of fixed shapes of the models that come with the library: the plain step's, and nothing in them depends on data."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from hood.assets.body.body import Body
from hood.assets.files.library import locate
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.state import Attachments
from hood.energies.mass_points import Gravity
from hood.energies.potential import Potential, default_potential, reference_potential
from hood.energies.problem import StepProblem
from hood.mesh.closest_point import tree
from hood.model.graph.static_shapes import Capacity, lay_out
from hood.native import features as native
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import NetworkStepper, build_simulator
from hood.steppers.static_shapes.cuda_graph import trace
from hood.steppers.static_shapes.problem import settled_potential, step_inputs
from hood.steppers.static_shapes.simulator import CapturedSimulator, FixedStep, StepResult
from hood.testing import without_values

#: All of them; the long ones take ten seconds and more.
MODELS = ["small-ours", "small1", "small2", "small3", "quickstart"]
MODELS += [pytest.param(name, marks=pytest.mark.slow) for name in ("small-fine15", "small-fine48")]
#: Of the displacement in a step. Stiff cloth turns roundings of positions into forces, which quickstart sees eight times.
LIMITS = {"quickstart": 2e-4}
PASSES = "1x(mesh+coarse0) | 1x(mesh)"
KINDS = {
    "local": ("local", "local_steps", PASSES),
    "physical": ("physical", "velocity_base", "1x(mesh+coarse0)"),
    "base": ("paper", "velocity_base", "1x(mesh)"),
    "edges": ("physical", "edges", "1x(mesh+coarse0)"),
    "local edges": ("local", "edges", "1x(mesh)"),
    "global": ("local", "global_steps", "1x(mesh)"),
}


def load(name: str) -> NetworkStepper:
    return load_simulator(locate("weights", name)).eval()


def problem_of(scene: Scene, frame: int) -> StepProblem:
    state = scene.start(frame)
    return StepProblem(scene.cloth, state, scene.step_input(frame, state))


def fixed_step(simulator: NetworkStepper, scene: Scene, problem: StepProblem, capacity: Capacity, dense: bool) -> FixedStep:
    static = simulator.prepare(scene.cloth, scene.garment.rest_pos).static
    assert static is not None
    potential = settled_potential(simulator.potential, problem) if simulator.looks_at_potential else None
    return FixedStep(simulator, lay_out(static, capacity, problem.step.attachments), problem, dense, potential)


def error(found: Tensor, expected: Tensor, problem: StepProblem) -> float:
    return float((found - expected).abs().max() / (expected - problem.state.pos).abs().max())


@pytest.mark.parametrize("name", MODELS)
@torch.no_grad()
def test_a_step_is_the_plain_one(name: str, skirt_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames with different numbers of contacts, by one plan; all pairs tried as on a GPU, and by the searches of a CPU."""
    monkeypatch.setattr(tree, "library", lambda: None)
    simulator, scene = load(name), skirt_scene
    prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
    stepper = CapturedSimulator(simulator, "fixed")
    step = fixed_step(simulator, scene, problem_of(scene, 2), Capacity(500, 500), dense=True)
    numbers = set()
    for frame in (2, 6, 9):
        problem = problem_of(scene, frame)
        with native.in_torch():
            expected = simulator.predict(problem, prepared).next_pos
        result = StepResult(*step(*step_inputs(problem, simulator.needs_contact)))
        numbers.add(int(result.num_found[0]))
        assert error(result.next_pos, expected, problem) < LIMITS.get(name, 1e-5)
        assert error(stepper.predict(problem, prepared).next_pos, expected, problem) < LIMITS.get(name, 1e-5)
    assert len(numbers) > 1
    assert len(stepper._plans) == 1


#: Kinds whose steps are made of the others'.
MIXED = ("physical", "local edges")


@pytest.mark.parametrize("name", ["small1", "quickstart", pytest.param("small-ours", marks=pytest.mark.slow)])
def test_nothing_in_a_step_depends_on_data(name: str, skirt_scene: Scene) -> None:
    """Tensors without values on a device other than the CPU: asking for a value, or for an array whose size follows from
    values, raises an error there, as does one tensor from the CPU."""
    assert_no_data(load(name), skirt_scene, problem_of(skirt_scene, 2))


def assert_no_data(simulator: NetworkStepper, scene: Scene, problem: StepProblem) -> None:
    simulator = copy.deepcopy(simulator)
    potential = settled_potential(simulator.potential, problem) if simulator.looks_at_potential else None
    static = simulator.prepare(scene.cloth, scene.garment.rest_pos).static
    assert static is not None
    layout, inputs = lay_out(static, Capacity(400, 400, 8)), step_inputs(problem, simulator.needs_contact)
    with FakeTensorMode(), torch.no_grad():
        step = FixedStep(without_values(simulator), without_values(layout), without_values(problem), potential=potential)
        traced = trace(step, [without_values(value) for value in inputs], fold=False)
    values = [node.meta["val"] for node in traced.graph.nodes if isinstance(node.meta.get("val"), Tensor)]
    assert len(values) > 200
    assert {value.device.type for value in values} == {"meta"}


def make(kind: str) -> NetworkStepper:
    torch.manual_seed(0)
    features, output, schedule = KINDS[kind]
    return build_simulator(features, output, schedule, latent_dim=16, output_init=0.3).eval()


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind in MIXED)) for kind in KINDS])
@pytest.mark.parametrize("name", ["skirt_scene", pytest.param("tank_scene", marks=pytest.mark.slow)])
def test_every_kind_of_model_has_such_a_step(kind: str, name: str, request: pytest.FixtureRequest) -> None:
    """With pins and without, with springs of buttons, and without a body."""
    scene: Scene = request.getfixturevalue(name)
    simulator, problem = make(kind), problem_of(scene, 3)
    prepared, stepper = simulator.prepare(scene.cloth, scene.garment.rest_pos), CapturedSimulator(make(kind), "fixed")
    buttons = Attachments(torch.tensor([[0, 70], [3, 60]]), torch.tensor([True, False]))
    cases = [replace(problem, step=replace(problem.step, attachments=buttons)), problem]
    cases.append(replace(problem, step=replace(problem.step, obstacle=None)))
    for case in cases:
        with native.in_torch(), torch.no_grad():
            expected = simulator.predict(case, prepared).next_pos
        assert error(stepper.predict(case, prepared).next_pos, expected, case) < 5e-4
    if name == "skirt_scene":  # which has pins and springs
        assert_no_data(simulator, scene, cases[0])


@pytest.mark.parametrize("kind", [pytest.param("local", marks=pytest.mark.slow), "base"])
def test_a_compiler_takes_it_on_a_cpu(kind: str, tank_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the compiler's front; contact by curvature asks stretched cloth for values elsewhere, and fans are written with
    gaps."""
    compiled = torch.compile
    monkeypatch.setattr(torch, "compile", lambda f, **options: compiled(f, backend="aot_eager", **options))
    simulator, problem = make(kind), problem_of(tank_scene, 3)
    prepared = simulator.prepare(tank_scene.cloth, tank_scene.garment.rest_pos)
    with native.in_torch(), torch.no_grad():
        expected = simulator.predict(problem, prepared).next_pos
    found = CapturedSimulator(simulator, "compiled").predict(problem, prepared).next_pos
    assert error(found, expected, problem) < 5e-4


def test_a_rollout_hands_its_potential_over(tank_scene: Scene) -> None:
    """Another potential is another plan, as is another gravity."""
    simulator, problem = make("local"), problem_of(tank_scene, 3)
    prepared, stepper = simulator.prepare(tank_scene.cloth, tank_scene.garment.rest_pos), CapturedSimulator(simulator, "fixed")
    results = []
    for potential in (default_potential(), default_potential(collision_weight=1e5, collision_epsilon=5e-3)):
        for gravity in (torch.tensor([0.0, -9.81, 0.0]), torch.zeros(3)):
            case = replace(problem, gravity=gravity)
            simulator.use_potential(potential)
            with native.in_torch(), torch.no_grad():
                expected = simulator.predict(case, prepared).next_pos
            results.append(stepper.predict(case, prepared).next_pos)
            assert error(results[-1], expected, case) < 5e-4
    assert len({float(result.sum()) for result in results}) == 4


def test_a_rollout_of_several_frames(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    scene = build_scene(garments["skirt"], body, walk.window(60, 66))
    simulator = load("small1")
    frames = []
    for stepper in (simulator, CapturedSimulator(simulator, "fixed", Capacity(60, 50))):
        frames.append([frame.world_pos for frame in simulate(stepper, scene, default_potential(), 5, metrics="none")])
    moved = float((frames[0][-1] - frames[0][0]).abs().max())
    assert moved > 1e-2
    for plain, fixed in zip(*frames, strict=True):
        assert float((fixed - plain).abs().max()) < 1e-3 * moved


def test_searches_beyond_contact_are_refused(tank_scene: Scene) -> None:
    simulator, problem = make("local"), problem_of(tank_scene, 3)
    simulator.use_potential(reference_potential())
    prepared = simulator.prepare(tank_scene.cloth, tank_scene.garment.rest_pos)
    with pytest.raises(ValueError, match=r"losses.terms.collision is a CentroidCollision.*use step=plain"):
        CapturedSimulator(simulator, "fixed").predict(problem, prepared)


def test_a_settled_potential_does_not_ask_again(tank_scene: Scene) -> None:
    class Asked(Gravity):
        count = 0

        def applies(self, problem: StepProblem) -> bool:
            self.count += 1
            return super().applies(problem)

    term, problem = Asked(), problem_of(tank_scene, 3).with_contact()
    potential = Potential({"gravity": term}).settled(problem)
    assert term.count == 1
    assert float(potential.total(problem, problem.state.pos)) != 0.0
    assert term.count == 1
    weightless = replace(problem, gravity=torch.zeros(3))
    assert not Potential({"gravity": term}).settled(weightless).terms

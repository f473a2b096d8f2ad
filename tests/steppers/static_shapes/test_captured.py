"""Steps of fixed shapes: equal to the plain ones, independent of data, refused where there is no such step."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Attachments, State, StepInput, concatenate_states, concatenate_step_inputs
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.model.graph.static_shapes import Capacity, lay_out
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.steppers.network import NetworkStepper, Prepared, build_simulator
from hood.steppers.static_shapes.cuda_graph import count_operations, trace
from hood.steppers.static_shapes.problem import step_inputs
from hood.steppers.static_shapes.simulator import CapturedSimulator, FixedStep, StepPrediction
from hood.testing import grid, without_values

SMALL = "1x(mesh+coarse0) 1x(coarse0+coarse1) 1x(coarse1)"
#: Of the root mean square of the accelerations.
LIMITS = {torch.float32: 1e-5, torch.float64: 1e-12}


def make(schedule: str = SMALL, dtype: torch.dtype = torch.float32, latent_dim: int = 16, **options: Any) -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator(schedule=schedule, latent_dim=latent_dim, **options).to(dtype).eval()


def problem_of(scene: Scene, frame: int = 0) -> StepProblem:
    state = scene.start(frame)
    rng = np.random.default_rng(frame)
    vel = state.vel + torch.as_tensor(rng.normal(scale=0.1, size=state.vel.shape)).to(state.vel)
    state = State(state.pos, vel, state.origin)
    return StepProblem(scene.cloth, state, scene.step_input(frame, state))


def prepare(simulator: NetworkStepper, scene: Scene) -> Prepared:
    """The scene's prepared cloth; the simulator's statistics are those of the step."""
    prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
    simulator.train()
    with torch.no_grad():
        simulator.predict(problem_of(scene), prepared)
    simulator.eval()
    return prepared


def difference(acc: Tensor, expected: Tensor) -> float:
    """Relative to the root mean square of what is expected, which may be zero where it is met exactly."""
    if torch.equal(acc, expected):
        return 0.0
    return float(((acc - expected).square().mean() / expected.square().mean()).sqrt())


def compare(
    simulator: NetworkStepper, stepper: CapturedSimulator, problem: StepProblem, prepared: Prepared, limit: float
) -> None:
    with torch.no_grad():
        plain = simulator.predict(problem, prepared)
        plain_vel = simulator.next_velocity(problem, plain)
    fixed = stepper.predict(problem, prepared)
    assert difference(fixed.acc, plain.acc) <= limit
    assert difference(stepper.next_velocity(problem, fixed), plain_vel) <= limit
    pinned = problem.cloth.pinned
    assert torch.equal(fixed.next_pos[pinned], plain.next_pos[pinned])
    assert float((fixed.next_pos - plain.next_pos).abs().max()) <= limit * float(plain.next_pos.abs().max())


@pytest.mark.parametrize(
    "schedule, dtype, capacity",
    [
        ("ours", torch.float32, None),
        ("fine15", torch.float64, None),
        ("ours", torch.float64, Capacity(60, 50)),
        ("fine15", torch.float32, Capacity(60, 50)),
    ],
)
def test_a_rollout_is_that_of_the_plain_step(
    schedule: str, dtype: torch.dtype, capacity: Capacity | None, garments: dict[str, Garment], body: Body, walk: PoseSequence
) -> None:
    """The relaxing step and five more on pinned vertices and omitted hands; with room for too few edges at the start."""
    scene = build_scene(garments["skirt"], body, walk.window(60, 66), dtype=dtype)
    simulator = make(schedule, dtype, output_init=0.1)
    stepper = CapturedSimulator(simulator, "fixed", capacity)
    rollouts = [[], []]
    for taken, frames in zip((simulator, stepper), rollouts, strict=True):
        for frame in simulate(taken, scene, default_potential(), 6, metrics="none"):
            frames.append(frame.world_pos)
    moved = float((rollouts[0][-1] - rollouts[0][0]).abs().max())
    assert moved > 1e-2
    for plain, fixed in zip(*rollouts, strict=True):
        assert float((fixed - plain).abs().max()) <= LIMITS[dtype] * moved


@pytest.mark.parametrize("aggregation", ["sum", "mean"])
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_accelerations_are_those_of_the_plain_step(aggregation: str, precision: str, skirt_scene: Scene) -> None:
    simulator = make(aggregation=aggregation)
    simulator.network.use_precision(precision)
    prepared = prepare(simulator, skirt_scene)
    stepper = CapturedSimulator(simulator, "fixed")
    # Products of rows in other company round differently, and bfloat16 keeps eight bits.
    limit = 1e-2 if precision == "bf16" else 1e-5
    for frame in (0, 3):
        compare(simulator, stepper, problem_of(skirt_scene, frame), prepared, limit)


@pytest.mark.slow
def test_a_compiler_is_given_one_graph(skirt_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the compiler's front, which takes the graph apart and runs it; making kernels takes minutes."""
    compiled = torch.compile
    monkeypatch.setattr(torch, "compile", lambda f, **options: compiled(f, backend="aot_eager", **options))
    simulator = make("1x(mesh)", latent_dim=8)
    prepared = prepare(simulator, skirt_scene)
    stepper = CapturedSimulator(simulator, "compiled")
    for frame in (0, 3):
        compare(simulator, stepper, problem_of(skirt_scene, frame), prepared, 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_compiled_steps_are_the_plain_ones(precision: str, skirt_scene: Scene) -> None:
    simulator = make("1x(mesh+coarse0) 1x(coarse0)")
    simulator.network.use_precision(precision)
    prepared = prepare(simulator, skirt_scene)
    stepper = CapturedSimulator(simulator, "compiled")
    for frame in (0, 3):
        limit = 1e-2 if precision == "bf16" else 1e-5
        compare(simulator, stepper, problem_of(skirt_scene, frame), prepared, limit)


def test_conventions_of_earlier_weights(skirt_scene: Scene) -> None:
    """Steps counted in frames, pinned vertices standing ahead."""
    for velocity in ("displacement", "carried"):
        simulator = make(frame_dt=1 / 30, pins_ahead=True, velocity=velocity, body_velocity="next", divisor_floor=1e-8)
        prepared = prepare(simulator, skirt_scene)
        stepper = CapturedSimulator(simulator, "fixed")
        problem = problem_of(skirt_scene)
        compare(simulator, stepper, problem, prepared, 1e-5)
        relaxing = replace(problem, step=skirt_scene.step_input(0, problem.state, relaxing=True))
        compare(simulator, stepper, relaxing, prepared, 1e-5)
        with pytest.raises(ValueError, match=r"counts in frames of 1/30 s"):
            stepper.predict(replace(problem, step=replace(problem.step, dt=torch.tensor([0.01]))), prepared)


def test_a_batch(tank_scene: Scene, skirt_scene: Scene) -> None:
    simulator = make()
    scenes = (tank_scene, skirt_scene)
    problems = [problem_of(scene) for scene in scenes]
    counts = [scene.cloth.num_vertices for scene in scenes]
    cloth = concatenate_cloths([scene.cloth for scene in scenes])
    prepared = simulator.concatenate(cloth, [simulator.prepare(s.cloth, s.garment.rest_pos) for s in scenes], counts)
    steps = concatenate_step_inputs([p.step for p in problems], counts)
    both = StepProblem(cloth, concatenate_states([p.state for p in problems]), steps)
    compare(simulator, CapturedSimulator(simulator, "fixed"), both, prepared, 1e-5)


def test_a_traced_step_leaves_no_values_behind(skirt_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a cloth computes once is there before the step is traced: a second plan of it would take what has no values."""
    simulator = build_simulator("local", "local_steps", "1x(mesh) | 1x(mesh)", latent_dim=8).eval()
    prepared = prepare(simulator, skirt_scene)
    cloth = replace(skirt_scene.cloth)  # nothing is known of it
    monkeypatch.setattr(torch, "compile", lambda module, **options: module)
    for frame in (0, 4):
        there = replace(problem_of(skirt_scene, frame), cloth=cloth)
        found = CapturedSimulator(simulator, "compiled").predict(there, prepared)
        expected = simulator.predict(simulator.search(there), prepared)
        assert type(found.next_pos) is Tensor
        assert float((found.next_pos - expected.next_pos).abs().max()) < 1e-5
    assert not [name for name, value in vars(cloth).items() if isinstance(value, FakeTensor)]


def sheet(dtype: torch.dtype = torch.float32) -> tuple[StepProblem, np.ndarray]:
    pos, faces = grid(8, 9, 0.3)
    cloth = build_cloth(pos, faces, Material(), np.arange(72) < 4, dtype=dtype)
    state = State(cloth.rest_pos, 0.1 * torch.ones_like(cloth.rest_pos), torch.zeros(1, 3).double())
    return StepProblem(cloth, state, StepInput(torch.tensor([1 / 30], dtype=dtype))), pos


def test_no_body_no_targets_and_buttons_that_open() -> None:
    simulator = make()
    problem, pos = sheet()
    prepared = simulator.prepare(problem.cloth, pos)
    stepper = CapturedSimulator(simulator, "fixed")
    compare(simulator, stepper, problem, prepared, 1e-5)
    accelerations = []
    for active in ([True, True], [True, False], [False, False]):
        buttons = Attachments(torch.tensor([[0, 70], [3, 60]]), torch.tensor(active))
        buttoned = replace(problem, step=replace(problem.step, attachments=buttons))
        compare(simulator, stepper, buttoned, prepared, 1e-5)
        accelerations.append(stepper.predict(buttoned, prepared).acc)
    assert not torch.equal(accelerations[0], accelerations[1])


def test_a_step_leaves_its_inputs_and_earlier_results_alone(skirt_scene: Scene) -> None:
    simulator = make()
    prepared = prepare(simulator, skirt_scene)
    stepper = CapturedSimulator(simulator, "fixed")
    problem = problem_of(skirt_scene)
    before = [value.clone() for value in step_inputs(problem)]
    first = stepper.predict(problem, prepared)
    kept = first.next_pos.clone(), first.acc.clone()
    stepper.predict(problem_of(skirt_scene, 3), prepared)
    assert torch.equal(first.next_pos, kept[0])
    assert torch.equal(first.acc, kept[1])
    assert all(torch.equal(a, b) for a, b in zip(before, step_inputs(problem), strict=True))
    # A tensor changed in place is seen, as is one made where none can be tracked.
    problem.state.vel.add_(1.0)
    compare(simulator, stepper, problem, prepared, 1e-5)
    with torch.inference_mode():
        problem = problem_of(skirt_scene)
        again = stepper.predict(problem, prepared)
    assert torch.equal(again.next_pos, first.next_pos)


def test_another_precision_is_another_plan(skirt_scene: Scene) -> None:
    simulator = make()
    prepared = prepare(simulator, skirt_scene)
    stepper = CapturedSimulator(simulator, "fixed")
    problem = problem_of(skirt_scene)
    fp32 = stepper.predict(problem, prepared)
    simulator.network.use_precision("bf16")
    compare(simulator, stepper, problem, prepared, 1e-2)
    assert not torch.equal(stepper.predict(problem, prepared).acc, fp32.acc)


def test_a_step_that_finds_no_room_is_taken_again(skirt_scene: Scene) -> None:
    """Alone, such a step says how much room it needs, and is wrong."""
    simulator = make()
    prepared = prepare(simulator, skirt_scene)
    problem = problem_of(skirt_scene)
    assert prepared.static is not None
    with torch.no_grad():
        plain = simulator.predict(problem, prepared)
        *_, found = FixedStep(simulator, lay_out(prepared.static, Capacity(400, 400)), problem)(*step_inputs(problem))
        edges, vertices, faces = found.tolist()
        assert faces == 0
        for room in (Capacity(edges, vertices + 1), Capacity(edges + 1, vertices - 4), Capacity(edges + 1, vertices + 1)):
            step = FixedStep(simulator, lay_out(prepared.static, room), problem)
            _, acc, _, found = step(*step_inputs(problem))
            assert bool(torch.isfinite(acc).all())
            assert found.tolist() == [edges, vertices, 0]
            assert (difference(acc, plain.acc) <= 1e-5) == room.holds((edges, vertices, 0))
    compare(simulator, CapturedSimulator(simulator, "fixed", Capacity(edges, 7)), problem, prepared, 1e-5)


# ---- nothing in the step depends on data ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "near_body, schedule, precision",
    [
        (True, SMALL, "fp32"),
        (True, SMALL, "bf16"),
        (False, SMALL, "fp32"),
        *(
            pytest.param(near_body, schedule, precision, marks=pytest.mark.slow)
            for near_body in (True, False)
            for schedule in ("ours", "fine15")
            for precision in ("fp32", "bf16")
        ),
    ],
)
def test_nothing_in_a_step_depends_on_data(near_body: bool, schedule: str, precision: str, skirt_scene: Scene) -> None:
    """Tensors without values on a device other than the CPU: asking for a value, or for an array whose size follows from
    values, raises an error there, as does one tensor from the CPU. The scene has pins, and the body hands that are
    omitted."""
    simulator = make(schedule)
    simulator.network.use_precision(precision)
    problem = problem_of(skirt_scene)
    assert problem.step.obstacle is not None
    assert bool(problem.step.obstacle.omitted.any())
    assert problem.step.pin_target is not None
    problem = problem if near_body else replace(problem, step=replace(problem.step, obstacle=None))
    static = simulator.prepare(skirt_scene.cloth, skirt_scene.garment.rest_pos).static
    assert static is not None
    layout, simulator = lay_out(static, Capacity(400, 400)), copy.deepcopy(simulator)
    with FakeTensorMode(), torch.no_grad():
        problem = without_values(problem)
        step = FixedStep(without_values(simulator), without_values(layout), problem)
        traced = trace(step, step_inputs(problem), fold=False)
    values = [node.meta["val"] for node in traced.graph.nodes if isinstance(node.meta.get("val"), Tensor)]
    assert len(values) > 250
    assert {value.device.type for value in values} == {"meta"}


def test_operations_on_weights_and_on_the_cloth_at_rest_are_not_repeated(skirt_scene: Scene) -> None:
    simulator = make()
    simulator.network.use_precision("bf16")
    problem = problem_of(skirt_scene)
    prepared = prepare(simulator, skirt_scene)
    assert prepared.static is not None
    step = FixedStep(simulator, lay_out(prepared.static, Capacity(400, 400)), problem, dense=True)
    folded, whole = (trace(step, step_inputs(problem), fold) for fold in (True, False))
    assert count_operations(folded) < 0.8 * count_operations(whole)
    with torch.no_grad():
        later = step_inputs(problem_of(skirt_scene, 4))
        assert all(torch.equal(a, b) for a, b in zip(folded(*later), whole(*later), strict=True))


# ---- refusals ---------------------------------------------------------------------------------------------------------


def test_where_no_step_can_be_made_the_plain_ones_are_taken(skirt_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_memory(*_: object) -> None:
        raise RuntimeError("out of memory")

    simulator, problem = make(), problem_of(skirt_scene)
    prepared = prepare(simulator, skirt_scene)
    monkeypatch.setattr("hood.steppers.static_shapes.simulator._Plan", no_memory)
    with pytest.raises(RuntimeError, match="out of memory"):
        CapturedSimulator(simulator, "fixed").predict(problem, prepared)
    captured = CapturedSimulator(simulator, "fixed", or_plain=True)
    with pytest.warns(UserWarning, match=r"step=plain: no CUDA graph of a step could be made \(out of memory\)"):
        first = captured.predict(problem, prepared)
    with torch.no_grad():
        plain = simulator.predict(simulator.search(problem), prepared)
    assert torch.equal(first.next_pos, plain.next_pos)
    assert torch.equal(captured.predict(problem, prepared).next_pos, plain.next_pos)  # without asking again
    assert torch.equal(captured.next_velocity(problem, first), simulator.next_velocity(problem, plain))


def test_steps_that_do_not_exist_are_refused() -> None:
    with pytest.raises(ValueError, match="step is 'quick'; choose plain, fixed, captured or compiled"):
        CapturedSimulator(make(), "quick")
    with pytest.raises(ValueError, match="step=captured needs device=cuda.*use step=fixed or step=plain"):
        CapturedSimulator(make(), "captured")
    with pytest.raises(ValueError, match=r"for inference: call simulator.eval\(\)"):
        CapturedSimulator(make().train(), "fixed")


# ---- with a GPU -------------------------------------------------------------------------------------------------------


@pytest.mark.gpu
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("mode", ["fixed", "captured", "compiled"])
def test_a_step_on_a_gpu_is_the_plain_one_and_waits_for_nothing(
    mode: str, precision: str, garments: dict[str, Garment], body: Body, walk: PoseSequence
) -> None:
    scene = build_scene(garments["skirt"], body, walk.window(60, 72), device="cuda")
    simulator = make().cuda()
    simulator.network.use_precision(precision)
    prepared = prepare(simulator, scene)
    stepper = CapturedSimulator(simulator, mode)
    for frame in (0, 3, 5):
        compare(simulator, stepper, problem_of(scene, frame), prepared, 1e-2 if precision == "bf16" else 1e-5)
    problem = problem_of(scene, 7)
    (plan,) = stepper._plans.values()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        result = plan.take(problem)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert bool(torch.isfinite(result.next_pos).all())


@pytest.mark.gpu
def test_a_captured_rollout_grows_where_there_is_no_room(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    scene = build_scene(garments["skirt"], body, walk.window(60, 66), device="cuda")
    simulator = make("ours", output_init=0.1).cuda()
    steppers = (simulator, CapturedSimulator(simulator, "captured", Capacity(60, 50)))
    plain, captured = ([f.world_pos for f in simulate(s, scene, default_potential(), 6, metrics="none")] for s in steppers)
    for a, b in zip(plain, captured, strict=True):
        assert float((a - b).abs().max()) < 1e-4


def test_a_prediction_of_another_stepper_has_a_velocity_too(skirt_scene: Scene) -> None:
    simulator = make()
    prepared = prepare(simulator, skirt_scene)
    problem = problem_of(skirt_scene)
    stepper = CapturedSimulator(simulator, "fixed")
    with torch.no_grad():
        plain = simulator.predict(problem, prepared)
    assert not isinstance(plain, StepPrediction)
    assert torch.equal(stepper.next_velocity(problem, plain), simulator.next_velocity(problem, plain))

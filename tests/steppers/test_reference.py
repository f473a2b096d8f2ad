"""Published weights give the published function: agreement with an independent implementation, names, files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from reference_oracle import LAYOUTS, Oracle, OracleScene, OracleStep, make_state
from torch import Tensor

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import Cloth, build_cloth
from hood.cloth.state import Obstacle, State, StepInput
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.model.graph.hierarchy import build_hierarchy
from hood.model.graph.known_hierarchies import given_hierarchy
from hood.rollouts.loop import simulate
from hood.scene.scene import build_scene
from hood.steppers.checkpoint import load_simulator, save_simulator
from hood.steppers.network import NetworkStepper, Prepared, build_simulator
from hood.steppers.protocol import Relaxing
from hood.steppers.published import import_reference_weights
from hood.testing import cylinder, sphere

DT = 1 / 30
PARAMETERS = {"postcvpr": 5_146_852, "cvpr": 5_076_964, "fine15": 3_854_164, "fine48": 12_027_604}
LIMIT = {torch.float64: 1e-10, torch.float32: 1e-5}
DTYPES = list(LIMIT)


@dataclass
class Bench:
    """A tube around a ball: pinned rim, an isolated vertex, body vertices near, far and omitted. Positions are exact in
    float32."""

    rest: np.ndarray
    faces: np.ndarray
    pinned: np.ndarray
    coarse: dict  # as garment files hold it: centre → level → edges, four levels
    material: Material
    body_faces: np.ndarray
    omitted: np.ndarray
    pos: list[Tensor]  # two frames
    body: list[Tensor]  # frames 0 … 5
    targets: list[Tensor]

    @property
    def isolated(self) -> Tensor:
        return torch.arange(len(self.rest)) == len(self.rest) - 1

    @property
    def compared(self) -> Tensor:
        """Vertices that the network moves."""
        return ~torch.as_tensor(self.pinned) & ~self.isolated

    def oracle_scene(self) -> OracleScene:
        levels, m = next(iter(self.coarse.values())), self.material
        fabric = (m.density, m.lame_mu, m.lame_lambda, m.bending_stiffness)
        body = (self.body_faces, np.where(self.omitted, 2, 1))
        return OracleScene(self.rest, self.faces, self.pinned, [levels[k] for k in range(3)], *fabric, *body)

    def cloth(self, dtype: torch.dtype) -> Cloth:
        return build_cloth(self.rest, self.faces, self.material, self.pinned, dtype=dtype)

    def prepare(self, simulator: NetworkStepper, cloth: Cloth) -> Prepared:
        hierarchy = given_hierarchy(len(self.rest), self.coarse, simulator.num_coarse)
        return simulator.prepare(cloth, self.rest, hierarchy)

    def step_input(self, before: Tensor, now: Tensor, after: Tensor, target: Tensor, dt: float, like: Tensor) -> StepInput:
        faces, scene = torch.as_tensor(self.body_faces), torch.zeros(len(now), dtype=torch.int64)
        surfaces = [pos.to(like) for pos in (now, after, before)]
        obstacle = Obstacle(*surfaces, faces, scene, torch.zeros(len(faces), dtype=torch.int64), torch.as_tensor(self.omitted))
        return StepInput(like.new_tensor([dt]), obstacle, target.to(like))


def make_bench(seed: int = 0, pinned: bool = True, near: bool = True) -> Bench:
    rng = np.random.default_rng(seed)

    def exact(pos: np.ndarray) -> np.ndarray:
        return pos.astype(np.float32).astype(np.float64)

    rest, faces = cylinder(12, 12, 0.14, 0.44)
    rest = exact(np.concatenate([rest - [0, 0.22, 0] + 0.004 * rng.normal(size=rest.shape), [[0.3, 0.0, 0.0]]]))
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    levels = [table.numpy() for table in build_hierarchy(len(rest), edges, rest, 3).coarse_edges]
    deepest = np.unique(levels[-1])
    levels.append(np.stack([deepest[:-1], deepest[1:]], axis=1))  # the level that is ignored
    # Shuffled and turned around, as a foreign file may have them.
    coarse = {17: {k: table[rng.permutation(len(table))][:, ::-1] for k, table in enumerate(levels)}}
    ball, body_faces = sphere(3, 0.125 if near else 0.05)
    body = [torch.as_tensor(exact(ball * [1, 1.3, 1] + t * np.array([0.002, 0.001, -0.003]))) for t in range(6)]
    pos = [torch.as_tensor(exact(rest + 0.003 * rng.normal(size=rest.shape))) for _ in range(2)]
    pos[1] = torch.as_tensor(exact(pos[0].numpy() + 0.004 * rng.normal(size=rest.shape)))
    mask = (np.arange(len(rest)) < 12) if pinned else np.zeros(len(rest), dtype=bool)
    targets = [torch.as_tensor(exact(pos[1].numpy() + t * np.array([0.003, -0.001, 0.002]))) for t in range(6)]
    material = Material(density=0.3, lame_mu=70000.0, lame_lambda=20000.0, bending_stiffness=2e-3)  # partly out of range
    return Bench(rest, faces, mask, coarse, material, body_faces, ball[:, 0] > 0.09, pos, body, targets)


def error(mine: Tensor, expected: Tensor) -> float:
    """Largest difference over the expected values' root mean square."""
    return float((mine.double() - expected).abs().max() / expected.square().mean().sqrt())


def single_step(bench: Bench, layout: str, dtype: torch.dtype, latent: int = 16) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Accelerations and positions of one regular step: ours, then the oracle's."""
    weights = make_state(layout, latent)
    simulator = import_reference_weights(weights)[0].to(dtype)
    cloth = bench.cloth(dtype)
    before, now = (pos.to(dtype) for pos in bench.pos)
    step = bench.step_input(*bench.body[:3], bench.targets[2], DT, now)
    state = State(now, (now - before) / step.dt, torch.zeros(1, 3, dtype=torch.float64))
    problem = StepProblem(cloth, state, step, gravity=simulator.gravity)
    with torch.no_grad():
        prediction = simulator.predict(problem, bench.prepare(simulator, cloth))
    given = OracleStep(bench.pos[1], bench.pos[0], None, bench.targets[2], *bench.body[:3], DT)
    acceleration, following, _ = Oracle(layout, weights).predict(bench.oracle_scene(), given)
    return prediction.acc * step.dt**2, prediction.next_pos, acceleration, following


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_step_agrees_with_the_oracle(layout: str, dtype: torch.dtype) -> None:
    bench = make_bench()
    mine, pos, expected, following = single_step(bench, layout, dtype)
    rows = bench.compared
    assert error(mine[rows], expected[rows]) <= LIMIT[dtype]
    assert torch.equal(pos[torch.as_tensor(bench.pinned)].double(), following[torch.as_tensor(bench.pinned)])
    assert float((pos.double() - following)[rows].abs().max()) <= (1e-12 if dtype == torch.float64 else 1e-6)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("pinned, near", [(False, True), (True, False), (False, False)])
def test_without_pins_and_without_body_edges(layout: str, pinned: bool, near: bool) -> None:
    bench = make_bench(1, pinned, near)
    mine, _, expected, _ = single_step(bench, layout, torch.float64)
    assert error(mine[bench.compared], expected[bench.compared]) <= LIMIT[torch.float64]


def test_the_bench_holds_what_it_is_meant_to_test() -> None:
    """Body edges on every level, omitted and far vertices, pinned vertices whose nearest body vertex changes."""
    bench = make_bench()
    distance = torch.cdist(bench.pos[1], bench.body[1])
    near, vertex = distance.min(dim=1).values < 0.03, distance.argmin(dim=1)
    omitted = torch.as_tensor(bench.omitted)[vertex]
    level = given_hierarchy(len(bench.rest), bench.coarse).node_level
    assert {0, 1, 2} <= set(level[near & ~omitted].tolist())
    assert bool((near & omitted).any())
    assert bool((~near).any())
    far = make_bench(1, near=False)
    assert not bool((torch.cdist(far.pos[1], far.body[1]) < 0.03).any())


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_step_at_the_published_width(dtype: torch.dtype) -> None:
    bench = make_bench(2)
    mine, _, expected, _ = single_step(bench, "postcvpr", dtype, latent=128)
    assert error(mine[bench.compared], expected[bench.compared]) <= LIMIT[dtype]


def own_rollout(
    bench: Bench, simulator: NetworkStepper, dtype: torch.dtype, num_steps: int = 5
) -> Iterator[tuple[Tensor, Tensor]]:
    """Accelerations per frame² and positions of a relaxing step and the regular ones that follow."""
    cloth = bench.cloth(dtype)
    prepared = bench.prepare(simulator, cloth)
    start = bench.targets[0].to(dtype)
    state = State(start, torch.zeros_like(start), torch.zeros(1, 3, dtype=torch.float64))
    still = simulator.relaxing is not Relaxing.RESTART  # whether the body stands still in the relaxing step
    for step in range(num_steps):
        frame = max(step - still, 0)
        after = frame if step == 0 and still else frame + 1
        surfaces = (bench.body[max(frame - 1, 0)], bench.body[frame], bench.body[after])
        given = bench.step_input(*surfaces, bench.targets[after], 1 / 3 if step == 0 else DT, start)
        problem = StepProblem(cloth, state, given, gravity=simulator.gravity)
        prediction = simulator.predict(problem, prepared)
        yield prediction.acc * given.dt**2, prediction.next_pos
        state = State(prediction.next_pos, simulator.next_velocity(problem, prediction), state.origin)


def rollout_errors(layout: str, dtype: torch.dtype, latent: int, seed: int) -> list[tuple[float, float]]:
    """Errors of accelerations and positions [m] in every step of a rollout; bench and weights are drawn by ``seed``."""
    bench, weights = make_bench(13 + seed), make_state(layout, latent, seed)
    simulator = import_reference_weights(weights)[0].to(dtype)
    scene, rows = bench.oracle_scene(), bench.compared
    reference = Oracle(layout, weights).rollout(scene, bench.targets[0], bench.body, bench.targets, bench.isolated)
    with torch.no_grad():
        steps = list(zip(own_rollout(bench, simulator, dtype), islice(reference, 5), strict=True))
    return [
        (error(mine[rows], expected[rows]), float((pos.double() - following).abs().max()))
        for (mine, pos), (expected, following) in steps
    ]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("latent, seed", [(16, 0), (16, 1), (16, 2), (128, 0)])
def test_a_rollout_from_the_relaxing_step_agrees(layout: str, latent: int, seed: int) -> None:
    for acceleration, position in rollout_errors(layout, torch.float64, latent, seed):
        assert acceleration <= LIMIT[torch.float64]
        assert position <= 1e-11


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_rollout_in_float32_at_the_published_width(layout: str, seed: int) -> None:
    """Narrow random networks amplify rounding, the naive form in float32 as much; 128 features average it out."""
    for acceleration, position in rollout_errors(layout, torch.float32, 128, seed):
        assert acceleration <= LIMIT[torch.float32]
        assert position <= 1e-6


def whole_rollout(
    layout: str, garment: Garment, body: Body, motion: PoseSequence, dtype: torch.dtype, num_steps: int, latent: int
) -> list[float]:
    """Largest difference [m] after every step between :func:`simulate` and the oracle, both from the settled start.

    The oracle's first step relaxes. postcvpr's leads to frame 0, that of the others to frame 1: they come one frame later.
    """
    weights = make_state(layout, latent)
    simulator = import_reference_weights(weights)[0].to(dtype)
    scene = build_scene(garment, body, motion, dtype=dtype)
    first = 0 if layout == "postcvpr" else 1
    frames = list(simulate(simulator, scene, default_potential(), num_steps + first, metrics="none"))
    motion_frames, nowhere = range(num_steps + first), np.zeros(3)
    surfaces = [scene.motion.surface(t, nowhere).double() for t in motion_frames]
    skinned = [scene.motion.skinned(scene.garment, t, nowhere).double() for t in motion_frames]
    start = scene.start(0, relaxed=False, thorough=True)
    fabric, levels = Material(), simulator.prepare(scene.cloth, garment.rest_pos).hierarchy.coarse_edges
    oracle_scene = OracleScene(
        garment.rest_pos, garment.faces, garment.pinned, [edges.numpy() for edges in levels],
        fabric.density, fabric.lame_mu, fabric.lame_lambda, fabric.bending_stiffness,
        body.faces, np.where(body.omitted, 2, 1),
    )  # fmt: skip
    held = torch.zeros(len(garment.rest_pos), dtype=torch.bool)
    reference = Oracle(layout, weights).rollout(oracle_scene, start.pos.double() + start.origin, surfaces, skinned, held)
    with torch.no_grad():
        pairs = zip(frames[first:], islice(reference, num_steps), strict=True)
        return [float((frame.world_pos - expected).abs().max()) for frame, (_, expected) in pairs]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_whole_loop_agrees_on_a_moving_body(
    layout: str, garments: dict[str, Garment], body: Body, walk: PoseSequence
) -> None:
    """A skirt held at the waist: start, relaxing step, frames of the body, pins, all as a rollout does it."""
    errors = whole_rollout(layout, garments["skirt"], body, walk.window(60, 72), torch.float64, 4, 16)
    assert max(errors) <= 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", ["skirt", "tshirt"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_ten_steps(layout: str, name: str, garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    """What differs in float32 is rounding: in float64 the same ten steps differ by nothing that grows."""
    for dtype, limit in ((torch.float64, 1e-10), (torch.float32, 2e-6)):
        errors = whole_rollout(layout, garments[name], body, walk.window(60, 72), dtype, 10, 128)
        print(f"{layout}, {name}, {dtype}: {max(errors):.1e} m")
        assert max(errors) <= limit


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("seed", range(2, 16))
def test_more_rollouts_in_float32(layout: str, seed: int) -> None:
    """Where the error exceeds the limit the step itself is to blame: in float64, with no rounding but that of a start, it
    answers to half a unit in the last place of float32 positions with an error of that size (1 of 56: cvpr, seed 4)."""
    worst = max(acceleration for acceleration, _ in rollout_errors(layout, torch.float32, 128, seed))
    if worst > LIMIT[torch.float32]:
        print(f"{layout}, seed {seed}: {worst:.1e}")
        assert worst <= 3.0 * answer_to_rounding(layout, seed)


def answer_to_rounding(layout: str, seed: int) -> float:
    """Largest change of the accelerations of a float64 rollout whose start is moved by up to half a unit in the last place."""
    bench = make_bench(13 + seed)
    simulator = import_reference_weights(make_state(layout, 128, seed))[0].double()
    generator = torch.Generator().manual_seed(0)
    start = bench.targets[0]
    shift = torch.rand(start.shape, generator=generator, dtype=start.dtype) - 0.5
    moved = replace(bench, targets=[start + torch.finfo(torch.float32).eps / 4 * shift, *bench.targets[1:]])
    rows = bench.compared
    with torch.no_grad():
        pairs = zip(*(own_rollout(case, simulator, torch.float64) for case in (moved, bench)), strict=True)
        return max(error(changed[rows], plain[rows]) for (changed, _), (plain, _) in pairs)


@pytest.mark.parametrize(
    "layout, wrong",
    [
        ("postcvpr", {"body_velocity": "next"}),
        ("postcvpr", {"pins_ahead": False}),
        ("postcvpr", {"velocity": "displacement"}),
        ("postcvpr", {"frame_dt": None}),
        ("cvpr", {"body_velocity": "previous"}),
        ("cvpr", {"velocity": "carried"}),
        ("fine15", {"pins_ahead": False}),
    ],
)
def test_every_convention_is_seen_by_the_comparison(layout: str, wrong: dict) -> None:
    """The same weights under another convention miss the oracle by far: the tests above would notice."""
    bench, weights = make_bench(3), make_state(layout)
    right = import_reference_weights(weights)[0].double()
    other = build_simulator(**{**right.config, **wrong}).double().eval()
    other.load_state_dict(right.state_dict())
    rows = bench.compared
    with torch.no_grad():
        steps = zip(own_rollout(bench, other, torch.float64), own_rollout(bench, right, torch.float64), strict=True)
        assert max(error(mine[rows], expected[rows]) for (mine, _), (expected, _) in steps) > 1e-3


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_saved_import_is_the_same_model(layout: str, tmp_path: Path) -> None:
    bench = make_bench(3)
    simulator, name = import_reference_weights(make_state(layout))
    assert name == layout
    save_simulator(tmp_path / "m.safetensors", simulator)
    loaded, clone = load_simulator(tmp_path / "m.safetensors"), simulator.clone()
    assert loaded.config == simulator.config
    assert loaded.rules == simulator.rules
    with torch.no_grad():
        runs = [[pos for _, pos in own_rollout(bench, s, torch.float32, 2)] for s in (simulator, loaded, clone.eval())]
    for first, second, third in zip(*runs, strict=True):
        assert torch.equal(first, second)
        assert torch.equal(first, third)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_parameters_are_those_of_the_file(layout: str) -> None:
    simulator, _ = import_reference_weights(make_state(layout, 128))
    assert sum(p.numel() for p in simulator.parameters() if p.requires_grad) == PARAMETERS[layout]


def test_parameters_of_the_native_model() -> None:
    with torch.device("meta"):
        simulator = build_simulator(schedule="ours")
    assert sum(p.numel() for p in simulator.parameters()) == 5_111_904
    assert not {"frame_dt", "pins_ahead", "velocity", "body_velocity"} & set(simulator.config)

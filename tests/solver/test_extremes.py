"""Implicit steps far from ordinary fabrics, meshes and motions: finite, bounded, and honest about what they reached."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, State, StepInput
from hood.contact.contact import find_contact
from hood.energies.potential import Potential, default_potential, relative_gradient
from hood.energies.problem import StepProblem
from hood.rollouts.loop import simulate
from hood.scene.scene import build_scene
from hood.solver.newton import NewtonSettings
from hood.solver.step_figures import penetration_metrics, strain_metrics
from hood.steppers.newton import EulerStep, NewtonStepper, implicit_euler
from hood.testing import Mesh, grid, make_problem, sphere

G = 9.81
RADIUS = 0.15
#: Few iterations: what has not converged by then must be bounded and reported as well.
DEFAULT = NewtonSettings(max_iterations=30, linear="direct")


def draped(
    material: Material | None = None,
    dt: float = 1 / 30,
    gap: float = 1e-3,
    pinned: bool = False,
    mesh: Mesh | None = None,
    radius: float = RADIUS,
    dtype: torch.dtype = torch.float64,
) -> StepProblem:
    """A level sheet (or ``mesh``) centred ``gap`` over the pole of a sphere about 0, at rest; a row of it may be held."""
    pos, faces = grid(6, 6, 0.25) if mesh is None else mesh
    pos = pos - pos.mean(axis=0) + np.array([0.0, radius + gap, 0.0])
    held = np.arange(len(pos)) < 6 if pinned else None
    problem = make_problem(build_cloth(pos, faces, material or Material(), held, dtype=dtype), dt=dt)
    return replace(problem, step=replace(problem.step, obstacle=surface(sphere(2, radius), dtype)))


def surface(mesh: Mesh, dtype: torch.dtype = torch.float64) -> Obstacle:
    pos, faces = torch.as_tensor(mesh[0]).to(dtype), torch.as_tensor(mesh[1])
    return Obstacle(pos, pos, pos, faces, torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long())


def fabric(stretching: float = 1.0, bending: float = 1.0, density: float = 1.0) -> Material:
    base = Material()
    return replace(
        base,
        lame_mu=stretching * base.lame_mu,
        lame_lambda=stretching * base.lame_lambda,
        bending_stiffness=bending * base.bending_stiffness,
        density=density * base.density,
    )


def honest(steps: Iterable[EulerStep], settings: NewtonSettings = DEFAULT) -> list[EulerStep]:
    """The steps; each is finite, says whether it converged, and is right about it."""
    taken = list(steps)
    for step in taken:
        assert torch.isfinite(step.state.pos).all()
        assert torch.isfinite(step.state.vel).all()
        reached, reason = bool(step.report.converged), step.report.reason[0]
        assert reached == (reason == "")
        if step.state.pos.dtype == torch.float64:
            gradient, _ = default_potential().gradient(step.problem, step.state.pos, step.report.acc)
            residual = float(relative_gradient(step.problem, gradient))
            assert reached == (residual <= settings.target_rg * (1 + 1e-6)), f"rg {residual}, reported {reached}"
    return taken


def bounded(steps: Iterable[EulerStep], settings: NewtonSettings = DEFAULT) -> list[EulerStep]:
    """:func:`honest` steps of a cloth on a body at rest whose energy never exceeds that of the start: whatever speed there
    is comes from falling, or from the deformation and the penetration of the start."""
    taken = honest(steps, settings)
    mass = taken[0].problem.cloth.mass
    start = taken[0].problem
    limit = energy_of(start, start.state) + energy_of_contact(start) + 1e-4 * G * float(mass.sum())
    for step in taken:
        assert energy_of(step.problem, step.state) <= limit
    return taken


def energy_of(problem: StepProblem, state: State) -> float:
    """Kinetic, gravitational and elastic energy [J]."""
    terms = default_potential().terms
    stored = Potential({name: terms[name] for name in ("stretching", "bending", "gravity")})
    kinetic = 0.5 * (problem.cloth.mass * state.vel.square().sum(1)).sum()
    return float(kinetic + stored.total(problem, state.pos, torch.zeros_like(state.pos)))


def energy_of_contact(problem: StepProblem) -> float:
    term = Potential({"collision": default_potential().terms["collision"]})
    return float(term.total(problem, problem.state.pos, torch.zeros_like(problem.state.pos)))


def strain(step: EulerStep) -> float:
    return strain_metrics(step.problem.cloth, step.state.pos)["strain_max"]


STIFFNESS = (1e-3, 0.1, 1.0, 10.0, 100.0, 1e3)


def test_strain_falls_as_stretching_stiffness_rises():
    strains = []
    for factor in STIFFNESS:
        problem = draped(fabric(stretching=factor), pinned=True)
        strains.append(max(strain(step) for step in bounded(implicit_euler(default_potential(), problem, 2, DEFAULT))))
    assert all(stiffer < softer for softer, stiffer in zip(strains, strains[1:], strict=False)), strains
    assert strains[-1] < 2e-3


@pytest.mark.parametrize("factor", STIFFNESS)
def test_stretching_stiffness(factor):
    bounded(implicit_euler(default_potential(), draped(fabric(stretching=factor)), 2, DEFAULT))


@pytest.mark.parametrize("pinned", [False, True])
@pytest.mark.parametrize("factor", [0.0, 1e-3, 1e5])
def test_bending_stiffness(factor, pinned):
    bounded(implicit_euler(default_potential(), draped(fabric(bending=factor), pinned=pinned), 2, DEFAULT))


@pytest.mark.parametrize("pinned", [False, True])
@pytest.mark.parametrize("density", [1e-3, 0.1 * 0.20022, 50.0])
def test_density(density, pinned):
    bounded(implicit_euler(default_potential(), draped(Material(density=density), pinned=pinned), 2, DEFAULT))


@pytest.mark.parametrize("pinned", [False, True])
@pytest.mark.parametrize("dt", [1 / 480, 1 / 240, 1 / 30, 1 / 5])
def test_time_step(dt, pinned):
    steps = bounded(implicit_euler(default_potential(), draped(dt=dt, pinned=pinned), 3, DEFAULT))
    depth = [penetration_metrics(step.problem.contact, step.problem.cloth)["penetration_depth"] for step in steps]
    assert max(depth) < 2e-3


@pytest.mark.parametrize("edge", [1e-3, 1e-2, 1e-1])
def test_edge_length(edge):
    """Float64 within the bounds, float32 next to it."""
    ends = {}
    for dtype in (torch.float32, torch.float64):
        problem = draped(mesh=grid(6, 6, 5 * edge), radius=max(0.05, edge), dtype=dtype)
        run = implicit_euler(default_potential(), problem, 2, DEFAULT)
        steps = bounded(run) if dtype == torch.float64 else honest(run)
        assert all(step.report.converged for step in steps)
        ends[dtype] = steps[-1].state.pos.double()
    torch.testing.assert_close(ends[torch.float32], ends[torch.float64], rtol=0, atol=1e-3 * edge + 1e-5)


@pytest.mark.filterwarnings("ignore:.*longer than high")
@pytest.mark.parametrize("aspect", [10.0, 1e3, 1e5, 1e7])
def test_rest_aspect_ratio(aspect):
    """One column of cells is a row of slivers, up to 5e-9 m wide.

    From 1e5 the steps do not converge. From free flight, its start, the solver then ends anywhere; from the previous
    positions, as the potential never rises, the step gains no energy.
    """
    pos, faces = grid(6, 6, 0.25)
    pos[pos[:, 0] > 0.12, 0] -= 0.05 * (1.0 - 1.0 / aspect)
    problem = draped(mesh=(pos, faces))
    steps = honest(implicit_euler(default_potential(), problem, 2, DEFAULT))
    assert all(step.report.converged for step in steps) or aspect > 100
    bounded(implicit_euler(default_potential(), problem, 2, DEFAULT, start=lambda now: now.state.pos))


@pytest.mark.parametrize("pinned", [False, True])
def test_one_triangle(pinned):
    pos = np.array([[-0.03, RADIUS + 0.002, -0.02], [0.07, RADIUS + 0.002, -0.03], [-0.02, RADIUS + 0.002, 0.08]])
    problem = draped(mesh=(pos, np.array([[0, 1, 2]])))
    if pinned:
        problem = replace(problem, cloth=replace(problem.cloth, pinned=torch.tensor([True, False, False])))
    steps = bounded(implicit_euler(default_potential(), problem, 5, DEFAULT))
    assert all(step.report.converged for step in steps)
    assert strain(steps[-1]) < 0.01


def degenerate_states() -> dict[str, np.ndarray]:
    pos, _ = grid(6, 6, 0.25)
    middle = pos[14]
    return {
        "collinear": pos * np.array([1.0, 1.0, 0.0]),
        "coincident": np.tile(middle, (len(pos), 1)),
        "folded by π": np.column_stack([np.minimum(pos[:, 0], 2 * middle[0] - pos[:, 0]), pos[:, 1], pos[:, 2]]),
        "folded twice": np.abs(pos - middle) + middle,
        "inside out": pos * np.array([-1.0, 1.0, 1.0]),
        "crumpled": pos + 0.1 * np.random.default_rng(0).normal(size=pos.shape),
    }


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("name", list(degenerate_states()))
def test_degenerate_states(name, held):
    """In the air, with and without a row held at its rest place. Coincident vertices feel no membrane force at all."""
    pos, faces = grid(6, 6, 0.25)
    start = degenerate_states()[name]
    pinned = np.arange(len(pos)) < 6 if held else np.zeros(len(pos), dtype=bool)
    start = np.where(pinned[:, None], pos, start)
    cloth = build_cloth(pos, faces, Material(), pinned, dtype=torch.float64)
    bounded(implicit_euler(default_potential(), make_problem(cloth, start), 2, DEFAULT))


@pytest.mark.parametrize("name", ["collinear", "folded by π", "coincident"])
def test_degenerate_states_on_a_body(name):
    pos, faces = grid(6, 6, 0.25)
    problem = draped(mesh=(pos, faces))
    start = degenerate_states()[name]
    start = start - start.mean(axis=0) + np.array([0.0, RADIUS + 0.01, 0.0])
    problem = replace(problem, state=replace(problem.state, pos=torch.as_tensor(start)))
    bounded(implicit_euler(default_potential(), problem, 2, DEFAULT))


def moving(problem: StepProblem, vel: Tensor) -> list[StepInput]:
    """Steps in which the body moves with ``vel`` (3,) [m/s]."""
    body, shift = problem.step.obstacle, vel * float(problem.step.dt)
    assert body is not None
    places = [body.pos + k * shift for k in range(-1, 9)]
    return [
        replace(problem.step, obstacle=replace(body, pos=places[k + 1], next_pos=places[k + 2], prev_pos=places[k]))
        for k in range(8)
    ]


UP, ASLANT = (0.0, 1.0, 0.0), (0.7, 0.7, 0.0)


@pytest.mark.parametrize("speed, heading", [(0.0, UP), (1.0, UP), (3.0, UP), (10.0, UP), (3.0, ASLANT), (6.0, ASLANT)])
def test_body_speed(speed, heading):
    """A body that sets off at up to 10 m/s, 2.2 radii per step, takes the cloth along.

    Single vertices may be inside for a frame at 6 m/s and more; the metrics count them, and they are out in the next.
    """
    problem = draped(gap=2e-3)
    inputs = moving(problem, speed * torch.tensor(heading, dtype=torch.float64))
    steps = honest(implicit_euler(default_potential(), problem, 3, DEFAULT, step_input=lambda k: inputs[k]))
    counts = []
    for k, step in enumerate(steps, 1):
        now = find_contact(step.state.pos, problem.cloth.vertex_scene, inputs[k].obstacle)
        counts.append(penetration_metrics(now, problem.cloth)["penetration_count"])
        assert float(step.state.vel.norm(dim=1).max()) < 2.0 * speed + G * k / 30 + 0.5
    assert max(counts) <= (0 if speed < 6.0 else 2)
    assert counts[-1] == 0
    if heading[0] == 0.0:
        # Not left behind on the other side.
        middle = steps[-1].state.pos[:, [0, 2]].norm(dim=1).argmin()
        assert float(steps[-1].state.pos[middle, 1]) > RADIUS - 0.02 + speed * len(steps) / 30


def depths(problem: StepProblem, steps: list[EulerStep]) -> list[float]:
    """Penetration depth [m] that the metrics report, at the start and after every step."""
    cloth, found = problem.cloth, []
    for pos in [problem.state.pos, *(step.state.pos for step in steps)]:
        contact = find_contact(pos, cloth.vertex_scene, problem.step.obstacle)
        found.append(penetration_metrics(contact, cloth)["penetration_depth"])
    return found


LIMB = 0.09


@pytest.mark.parametrize("dt", [1 / 30, 1 / 240])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6])
def test_initial_penetration(share, dt):
    """A sheet that starts through a body of a limb's radius leaves it."""
    pos, faces = grid(7, 7, 0.25)
    problem = draped(gap=-share * LIMB, dt=dt, radius=LIMB, mesh=(pos, faces))
    found = depths(problem, bounded(implicit_euler(default_potential(), problem, 3, DEFAULT)))
    assert found[0] == pytest.approx(share * LIMB, abs=2e-3)
    assert all(later <= max(earlier, 1e-9) for earlier, later in zip(found, found[1:], strict=False)), found
    assert found[-1] < 1e-3


def test_penetration_to_the_middle_of_a_limb_is_reported():
    """Cut at its centre, the sheet is pushed out on both sides: depth falls, and what stays inside is in the metrics."""
    pos, faces = grid(7, 7, 0.25)
    problem = draped(gap=-LIMB, radius=LIMB, mesh=(pos, faces))
    found = depths(problem, honest(implicit_euler(default_potential(), problem, 4, DEFAULT)))
    assert found[0] > 0.8 * LIMB
    assert all(later <= earlier + 1e-4 for earlier, later in zip(found, found[1:], strict=False)), found


def rollouts_here_and_there(
    garment: Garment, body: Body, sequence: PoseSequence, offset: np.ndarray, settings: NewtonSettings, relaxing: int, dtype
) -> list[tuple[Tensor, Tensor]]:
    """Frames (world positions) of a rollout, and of the same at ``offset`` (3,) [m] with that taken off again."""
    runs = []
    for shift in (np.zeros(3), offset):
        scene = build_scene(garment, body, replace(sequence, transl=sequence.transl + shift), dtype=dtype)
        stepper = NewtonStepper(default_potential(), settings)
        stepper.gravity = stepper.gravity.to(dtype)
        frames = simulate(stepper, scene, default_potential(), 3, relaxing_steps=relaxing)
        runs.append([frame.world_pos - torch.as_tensor(shift) for frame in frames])
    return list(zip(*runs, strict=True))


@pytest.mark.parametrize("offset, dtype, tolerance, engine", [
    ((1e4, -5e3, 1e4), torch.float32, 1e-6, "torch"),
    ((1e4 + 0.137, -5e3 - 0.311, 1e4 + 0.063), torch.float32, 1e-4, "torch"),
    ((1e4 + 0.137, -5e3 - 0.311, 1e4 + 0.063), torch.float64, 1e-8, "torch"),
    # Its linear solver in float32 amplifies what differs in the last digit.
    ((1e4, -5e3, 1e4), torch.float32, 2e-5, "auto"),
    ((1e4 + 0.137, -5e3 - 0.311, 1e4 + 0.063), torch.float32, 1e-4, "auto"),
    ((1e4 + 0.137, -5e3 - 0.311, 1e4 + 0.063), torch.float64, 2e-5, "auto"),
])  # fmt: skip
def test_world_offset(offset, dtype, tolerance, engine, garments: dict[str, Garment], body: Body, walk: PoseSequence):
    """The same rollout anywhere within 10 km. Few iterations: where the minimum itself hangs on rounding (a fold may go
    either way) two converged runs in float32 can part by millimetres at single vertices, near the origin as well."""
    # The start needs no thorough settling, whose accelerated projections amplify rounding some hundred times.
    settings = NewtonSettings(max_iterations=8, engine=engine)
    pairs = rollouts_here_and_there(garments["tank"], body, walk.window(10, 14), np.array(offset), settings, 0, dtype)
    for here, there in pairs:
        torch.testing.assert_close(there, here, rtol=0, atol=tolerance)
    assert float((pairs[0][0] - pairs[-1][0]).abs().max()) > 1e-2


@pytest.mark.slow
def test_world_offset_of_converged_steps(garments: dict[str, Garment], body: Body, walk: PoseSequence):
    offset, settings = np.array([1e4 + 0.137, -5e3 - 0.311, 1e4 + 0.063]), NewtonSettings(max_iterations=300)
    pairs = rollouts_here_and_there(garments["tank"], body, walk.window(60, 64), offset, settings, 1, torch.float64)
    for here, there in pairs:
        torch.testing.assert_close(there, here, rtol=0, atol=1e-4)


def swinging_flag(dtype: torch.dtype = torch.float64) -> StepProblem:
    """A sheet of 12 vertices that hangs from one side and starts with a small push."""
    pos, faces = grid(4, 3, 0.2)
    pos = np.stack([pos[:, 1], -pos[:, 0], pos[:, 2]], axis=1)
    cloth = build_cloth(pos, faces, Material(), np.arange(12) < 3, dtype=dtype)
    vel = torch.tensor([0.05, 0.0, 0.02], dtype=dtype).expand(12, 3) * cloth.free[:, None]
    return make_problem(cloth, vel=vel)


@pytest.mark.parametrize("num_steps", [50, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_grows_at_rest(num_steps, dtype):
    """A push dies out, and what remains is the accuracy of the steps."""
    settings = NewtonSettings(target_rg=1e-4, linear="direct")
    steps = implicit_euler(default_potential(), swinging_flag(dtype), num_steps, settings)
    speed = []
    for step in steps:
        assert step.report.converged.all(), step.report.reason
        speed.append(float(step.state.vel.norm(dim=1).max()))
    assert max(speed) < 0.5
    assert max(speed[num_steps // 2 :]) < max(speed[: num_steps // 4])
    assert speed[-1] < 0.1
    if num_steps >= 1000:
        assert max(speed[-100:]) < 1e-3

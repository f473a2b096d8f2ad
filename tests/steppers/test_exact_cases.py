"""Steps against what is known without a simulator: closed forms, ordinary differential equations, symmetries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import integrate, optimize

from hood.assets.material import Material
from hood.assets.pattern.making import sides_between
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Obstacle, State, StepInput, concatenate_obstacles, concatenate_states
from hood.contact.contact import Contact
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem, inertial_guess
from hood.mesh.flat import Construction, laid_out, stretched_sides
from hood.mesh.geometry import dihedral_angles, face_normals
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.step_figures import edge_strain
from hood.steppers.newton import EulerStep, implicit_euler
from hood.testing import Mesh, cylinder, grid, make_problem, plane_contact, random_rotation, sphere

F64 = torch.float64
G = 9.81
TIGHT = NewtonSettings(target_rg=1e-8, linear="direct")


def problem_of(mesh: Mesh, dt: float = 1 / 30, material: Material | None = None, **state) -> StepProblem:
    """A step in float64, gravity included (9.81 in float32 is 4e-7 m/s² off)."""
    cloth = build_cloth(*mesh, material or Material(), dtype=F64)
    return replace(make_problem(cloth, dt=dt, **state), gravity=torch.tensor([0.0, -G, 0.0], dtype=F64))


def surface(mesh: Mesh) -> Obstacle:
    """A body at rest."""
    pos, faces = (torch.as_tensor(array) for array in mesh)
    return Obstacle(pos, pos, pos, faces, torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long())


def over(problem: StepProblem, obstacle: Obstacle | None) -> StepProblem:
    return replace(problem, step=replace(problem.step, obstacle=obstacle))


def last(steps) -> EulerStep:
    """The last of the steps, all of which must have converged."""
    for step in steps:
        assert step.report.converged.all(), step.report.reason
    return step


def free_fall(problem: StepProblem, steps: int, dt: float) -> torch.Tensor:
    """Positions after ``steps`` steps of implicit Euler from rest: more than ½ g t²."""
    return problem.state.pos - torch.tensor([0.0, G * dt**2 * steps * (steps + 1) / 2, 0.0], dtype=F64)


def wavy(n: int = 6, m: int = 5, size: float = 0.3) -> Mesh:
    pos, faces = grid(n, m, size)
    pos[:, 1] = 0.03 * np.sin(15.0 * pos[:, 0]) * np.cos(9.0 * pos[:, 2])
    return pos, faces


def without_gravity(problem: StepProblem) -> torch.Tensor:
    """A start, x + dt v, from which the solver has something to do in free fall; from its own it has not."""
    return inertial_guess(problem.state, problem.step)


@pytest.mark.parametrize("dt, start", [(1 / 30, None), (1 / 30, without_gravity), (1 / 240, without_gravity)])
def test_free_fall_is_the_series_of_implicit_euler(dt, start):
    problem = problem_of(wavy(), dt)
    settings = NewtonSettings(target_rg=1e-6, linear="direct")
    for k, step in enumerate(implicit_euler(default_potential(), problem, 100, settings, start=start), 1):
        assert step.report.converged.all()
        assert (step.report.iterations > 0) == (start is not None)
        torch.testing.assert_close(step.state.pos, free_fall(problem, k, dt), rtol=0, atol=1e-10)
        assert float(edge_strain(problem.cloth, step.state.pos).abs().max()) < 1e-10


def hanging_strip(rows: int, material: Material, length: float = 1.0) -> StepProblem:
    """A vertical strip held at its upper end y = 0; three vertices a row, mirror images left and right."""
    pos, faces = grid(rows, 3, length)
    pos = np.stack([pos[:, 1], -pos[:, 0], 0.1 * pos[:, 2]], axis=1)
    cloth = build_cloth(pos, faces, material, np.arange(3 * rows) < 3, dtype=F64)
    return replace(make_problem(cloth), gravity=torch.tensor([0.0, -G, 0.0], dtype=F64))


def depth_of_hanging_bar(material: Material, along: np.ndarray, length: float = 1.0) -> np.ndarray:
    """Depth of the points ``along`` (from the upper end, at rest) of a bar under its own weight.

    Without λ the bar keeps its width: what hangs below, ρ g s per width, is carried by h P = h μ (l³ - l) where l is the
    stretch at the distance s from the free end.
    """
    fine = np.linspace(0.0, length, 2001)
    load = material.density * G * (length - fine) / (material.lame_mu * material.thickness)
    stretch = np.array([optimize.brentq(lambda x, q=q: x**3 - x - q, 1.0, 10.0) for q in load])
    return np.interp(along, fine, integrate.cumulative_simpson(stretch, x=fine, initial=0.0))


def test_hanging_strip_is_the_solution_of_the_bar():
    material, rows = Material(lame_mu=8e3, lame_lambda=0.0), 41
    problem = hanging_strip(rows, material)
    terms = default_potential().terms
    static = Potential({name: term for name, term in terms.items() if name != "inertia"})
    pos, report = minimize(static, problem, settings=TIGHT)
    assert report.converged.all(), report.reason
    found = -pos[:, 1].numpy().reshape(rows, 3)
    exact = depth_of_hanging_bar(material, np.linspace(0.0, 1.0, rows))
    elongation = exact[-1] - 1.0
    np.testing.assert_allclose(found, np.broadcast_to(exact[:, None], found.shape), rtol=0, atol=5e-3 * elongation)
    # A linear bar would end 22% lower: the case tells them apart.
    linear = material.density * G / (4.0 * material.lame_mu * material.thickness)
    assert elongation > 0.1
    assert linear > 1.2 * elongation
    # Implicit Euler stays there.
    settled = replace(problem, state=State(pos, torch.zeros_like(pos), problem.state.origin))
    kept = last(implicit_euler(default_potential(), settled, 2, TIGHT))
    torch.testing.assert_close(kept.state.pos, pos, rtol=0, atol=1e-8)


def plate(normal: np.ndarray, slope: np.ndarray) -> Mesh:
    """A plane through 0 with ``normal`` and the direction ``slope`` in it, triangulated, 6 m wide."""
    pos, faces = grid(9, 9, 6.0)
    pos = pos - np.array([3.0, 0.0, 3.0])
    return pos[:, :1] * slope + pos[:, 1:2] * normal + pos[:, 2:] * np.array([0.0, 0.0, 1.0]), faces


@pytest.mark.parametrize("coefficient, factor, meshed", [(0.3, 1.0, False), (0.5, 1.0, True), (0.5, 0.6, True)])
@pytest.mark.parametrize("beyond", [-1.0, 1.0])
def test_sliding_starts_at_the_angle_of_friction(coefficient, factor, beyond, meshed):
    """One degree below it the sheet creeps slower than ε_v, one degree above it accelerates like a point mass."""
    friction = coefficient * factor
    angle = np.arctan(friction) + np.deg2rad(beyond)
    normal, slope = np.array([np.sin(angle), np.cos(angle), 0.0]), np.array([np.cos(angle), -np.sin(angle), 0.0])
    potential = default_potential(friction_coefficient=coefficient)
    term, duration, dt = potential.terms["friction"], 0.8, 1 / 30
    flat, faces = grid(4, 4, 0.15)
    rest = flat[:, :1] * slope + flat[:, 2:] * np.array([0.0, 0.0, 1.0])
    problem = problem_of((rest, faces), dt, Material(friction=factor))
    # The normal force is that of the step before: start with the depth at which contact carries each vertex.
    depth = (problem.cloth.mass * G * np.cos(angle) / (3.0 * term.weight)).sqrt()
    pos = problem.state.pos + (term.epsilon - depth)[:, None] * torch.as_tensor(normal)
    problem = replace(problem, state=replace(problem.state, pos=pos))
    if meshed:
        steps = implicit_euler(potential, over(problem, surface(plate(normal, slope))), 24, TIGHT)
    else:
        steps = implicit_euler(
            potential, problem, 24, TIGHT, contact=lambda _, state: plane_contact(state.pos, torch.as_tensor(normal))
        )
    vel = last(steps).state.vel @ torch.as_tensor(slope)
    speed = float((problem.cloth.mass * vel).sum() / problem.cloth.mass.sum())
    if beyond > 0:
        assert speed > 10 * term.slip_speed
        assert speed == pytest.approx(G * (np.sin(angle) - friction * np.cos(angle)) * duration, rel=0.02)
    else:
        creep = term.slip_speed * (1.0 - np.sqrt(1.0 - np.tan(angle) / friction))
        assert speed < term.slip_speed
        assert speed == pytest.approx(creep, rel=1e-3)


def ring(factor: float, density: float = 0.2, columns: int = 24, rows: int = 4) -> tuple[StepProblem, float, Callable]:
    """A ring of cloth about the vertical, cut with the radius 0.12 m, 0.03 m high, with elastic ``factor`` around it. Its step,
    its height, and the pull [N] of the whole ring at a radius: without λ it keeps its height, and h P = h μ (l³ - l)."""
    pos, faces = cylinder(columns, rows, 0.12, 0.03)
    material = Material(lame_mu=2e5, lame_lambda=0.0, density=density)
    edges = laid_out(torch.as_tensor(pos), torch.as_tensor(faces)).numpy()
    three = pos[faces][:, 1:] - pos[faces][:, :1]
    level = np.cross([0.0, 1.0, 0.0], np.cross(three[:, 0], three[:, 1]))
    shares = np.einsum("fxi,fx->fi", np.linalg.pinv(three), level)
    ways = np.einsum("fi,fix->fx", shares, edges)
    made = Construction(stretched_sides(edges, ways, factor))
    cloth = build_cloth(pos, faces, material, dtype=F64, made=made)
    problem = replace(make_problem(cloth), gravity=torch.tensor([0.0, -G, 0.0], dtype=F64))

    def pull(radius: float) -> float:
        stretch = radius / (0.12 * factor)
        return 0.03 * material.thickness * material.lame_mu * (stretch**3 - stretch)

    return problem, 0.03, pull


def post(pos: torch.Tensor, radius: float) -> Contact:
    """Contact with a vertical cylinder."""
    dist = pos[:, [0, 2]].norm(dim=1)
    normal = torch.stack([pos[:, 0] / dist, torch.zeros_like(dist), pos[:, 2] / dist], dim=1)
    point = pos - (dist - radius)[:, None] * normal
    plain = plane_contact(pos)
    return replace(
        plain,
        dist=dist - radius,
        vertex_dist=(dist - radius).abs(),
        point=point,
        normal=normal,
        next_point=point,
        next_normal=normal,
    )


def test_elastic_pulls_as_a_hoop_and_shrinks_to_its_length():
    problem, _, pull = ring(0.8)
    at = problem.state.pos.clone().requires_grad_()
    default_potential().terms["stretching"](problem, at, torch.zeros_like(at)).sum().backward()
    radial = (at.grad[:, [0, 2]] * at.detach()[:, [0, 2]]).sum(dim=1) / 0.12
    # The forces of a hoop of 24 straight pieces: 2 T sin(π / 24) in every column.
    assert float(radial.sum()) == pytest.approx(24 * 2.0 * pull(0.12) * np.sin(np.pi / 24), rel=1e-9)
    assert float(at.grad[:, 1].abs().max()) < 1e-12
    weight = float(problem.cloth.mass.sum())
    assert weight == pytest.approx(0.2 * 0.03 * 24 * 2 * 0.12 * np.sin(np.pi / 24))  # of what was cut
    free = replace(problem, gravity=torch.zeros(3, dtype=F64))
    step = last(
        implicit_euler(default_potential(), replace(free, step=replace(free.step, dt=torch.ones(1, dtype=F64))), 6, TIGHT)
    )
    torch.testing.assert_close(step.state.pos[:, [0, 2]].norm(dim=1), torch.full((96,), 0.096, dtype=F64), rtol=0, atol=1e-7)


@pytest.mark.parametrize("beyond", [0.9, 1.1])
def test_elastic_holds_what_its_friction_carries(beyond):
    """Around a post the ring presses with 2 π times its pull; it slides where its friction is below its weight."""
    problem, _, pull = ring(0.8, density=8.0)
    resting = replace(problem, gravity=torch.zeros(3, dtype=F64))
    around = lambda _, state: post(state.pos, 0.12)  # noqa: E731
    calm = last(implicit_euler(default_potential(friction_coefficient=0.0), resting, 30, TIGHT, contact=around)).state
    radius = float(calm.pos[:, [0, 2]].norm(dim=1).mean())
    weight = float(problem.cloth.mass.sum()) * G
    critical = weight / (24 * 2.0 * pull(radius) * np.sin(np.pi / 24))
    assert 0.1 < critical < 1.0
    hung = replace(problem, state=replace(calm, vel=torch.zeros_like(calm.vel)))
    potential = default_potential(friction_coefficient=beyond * critical)
    state = last(implicit_euler(potential, hung, 15, TIGHT, contact=around)).state
    speed, slow = -float(state.vel[:, 1].mean()), potential.terms["friction"].slip_speed
    if beyond > 1.0:
        assert speed == pytest.approx(slow * (1.0 - np.sqrt(1.0 - 1.0 / beyond)), rel=0.02)
    else:
        assert speed == pytest.approx(G * (1.0 - beyond) * 0.5, rel=0.05)


def folded(angle: float, bending: float = 1.0) -> StepProblem:
    """A flat strip of six rows, its first two held, with a fold across its middle."""
    pos, faces = grid(7, 3, 0.3)
    line = sides_between(faces, np.array([[9, 10], [10, 11]]))
    made = Construction(None, np.where(line, angle, np.nan), np.where(line, bending, 1.0))
    return make_problem(build_cloth(pos, faces, Material(), np.arange(len(pos)) < 6, dtype=F64, made=made))


@pytest.mark.parametrize("angle", [-2.5, 0.7, 1.6, 3.0])
def test_a_folded_strip_rests_at_its_angle(angle):
    problem = folded(angle)
    static = Potential({name: default_potential().terms[name] for name in ("stretching", "bending")})
    start = problem.state.pos.clone()
    pos, report = minimize(static, problem, start, NewtonSettings(target_rg=1e-11, linear="direct", max_iterations=400))
    cloth = problem.cloth
    found = dihedral_angles(pos, cloth.hinges)
    torch.testing.assert_close(found, cloth.rest_angle, rtol=0, atol=1e-6)
    assert set(cloth.rest_angle.abs().unique().tolist()) == {0.0, abs(angle)}
    # Bends away from where the faces look: from above, as they are wound, the free end goes down.
    up = face_normals(pos, cloth.faces[:1])[0]
    tip = (pos[-1] - pos[9]) @ up
    assert float(tip) * np.sign(angle) < 0.0


@pytest.mark.parametrize("factor", [0.5, 4.0])
def test_a_seam_resists_by_its_factor(factor):
    """The moment of a hinge, and how far a strip bends under a small weight."""
    plain, stiff = folded(0.0), folded(0.0, factor)
    on_seam = stiff.cloth.bending_stiffness / plain.cloth.bending_stiffness
    assert set(on_seam.tolist()) == {1.0, factor}
    pos, faces = grid(9, 3, 0.1)
    sags = []
    for made, stiffness in ((None, 1.0), (Construction(bending=np.full(faces.shape, factor)), 1.0), (None, factor)):
        material = Material(bending_stiffness=stiffness * 4e-3)
        cloth = build_cloth(pos, faces, material, np.arange(len(pos)) < 6, dtype=F64, made=made)
        problem = replace(make_problem(cloth), gravity=torch.tensor([0.0, -1e-3, 0.0], dtype=F64))
        static = Potential({name: term for name, term in default_potential().terms.items() if name != "inertia"})
        sags.append(-float(minimize(static, problem, settings=TIGHT)[0][-1, 1]))
    assert sags[0] == pytest.approx(factor * sags[1], rel=1e-3)
    assert sags[1] == pytest.approx(sags[2], rel=1e-9)


def draped(side: int, size: float, radius: float, subdivisions: int) -> StepProblem:
    """A level sheet 1 cm above a sphere about 0."""
    pos, faces = grid(side, side, size)
    pos = pos + np.array([-size / 2, radius + 0.01, -size / 2])
    return over(problem_of((pos, faces)), surface(sphere(subdivisions, radius)))


def kinetic_energies(problem: StepProblem, steps: int, settings: NewtonSettings) -> np.ndarray:
    energies = []
    for step in implicit_euler(default_potential(), problem, steps, settings):
        assert step.report.converged.all(), step.report.reason
        energies.append(float(0.5 * (problem.cloth.mass * step.state.vel.square().sum(1)).sum()))
    return np.array(energies)


def test_sheet_on_a_sphere_comes_to_rest():
    problem = draped(13, 0.5, 0.3, 2)
    energy = kinetic_energies(problem, 45, NewtonSettings(linear="direct"))
    fall = float(problem.cloth.mass.sum()) * G * 0.03
    assert energy.max() > 0.5 * fall
    assert energy[-5:].max() < 1e-6 * energy.max()


@pytest.mark.slow
def test_larger_sheet_on_a_sphere_comes_to_rest():
    energy = kinetic_energies(draped(33, 1.0, 0.3, 3), 300, NewtonSettings())
    assert energy[-5:].max() < 1e-6 * energy.max()


def test_contact_decides_between_falling_and_resting():
    mesh = wavy(6, 6, 0.25)
    problem = problem_of((mesh[0] + np.array([0.0, 0.06, 0.0]), mesh[1]))
    floor = surface(plate(np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])))
    steps, dt = 60, 1 / 30
    fallen = last(implicit_euler(default_potential(), problem, steps, TIGHT)).state
    torch.testing.assert_close(fallen.pos, free_fall(problem, steps, dt), rtol=0, atol=1e-10)
    settings = NewtonSettings(target_rg=1e-4, linear="direct")
    resting = last(implicit_euler(default_potential(), over(problem, floor), steps, settings)).state
    assert float(resting.pos[:, 1].min()) > 0.0015
    assert float(resting.pos[:, 1].max()) < 0.05  # the waves of its rest shape
    assert float(resting.vel.abs().max()) < 1e-3


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_pinned_and_massless_vertices_are_exactly_where_they_belong(dtype):
    pos, faces = grid(5, 5, 0.2)
    pos = np.concatenate([pos, [[0.1, -0.3, 0.1]]])
    cloth = build_cloth(pos, faces, Material(), np.arange(26) < 5, dtype=dtype)
    problem = make_problem(cloth)
    generator = torch.Generator().manual_seed(0)
    targets = [cloth.rest_pos + 0.01 * k + 0.003 * torch.rand(26, 3, generator=generator, dtype=dtype) for k in range(6)]
    steps = implicit_euler(default_potential(), problem, 6, step_input=lambda k: replace(problem.step, pin_target=targets[k]))
    for target, step in zip(targets, steps, strict=True):
        assert torch.equal(step.state.pos[:5], target[:5])
        assert torch.equal(step.state.pos[25], cloth.rest_pos[25])
        assert torch.equal(step.state.vel[25], torch.zeros(3, dtype=dtype))
        assert step.report.converged.all()
    assert float((step.state.pos - cloth.rest_pos)[5:25].norm(dim=1).min()) > 0.01


def collided(mesh: Mesh, body: Mesh) -> torch.Tensor:
    """Positions after four steps in which a swinging sheet meets the body."""
    problem = over(problem_of(mesh, vel=np.tile([0.0, -1.0, 0.0], (len(mesh[0]), 1))), surface(body))
    return last(implicit_euler(default_potential(), problem, 4, TIGHT)).state.pos


def swinging() -> tuple[Mesh, Mesh]:
    sheet, faces = wavy(6, 6, 0.25)
    return (sheet + np.array([-0.1, 0.21, -0.13]), faces), sphere(2, 0.15)


@pytest.fixture(scope="module")
def reference() -> torch.Tensor:
    """What :func:`swinging` comes to; the sheet has met the body, which holds edges of 50 mm 5 mm off a ball of 150 mm."""
    pos = collided(*swinging())
    assert float((pos.norm(dim=1) < 0.156).sum()) > 5
    return pos


def test_labels_play_no_role(reference):
    """To 1e-8 m: two ways to round a step, each solved to a relative gradient of 1e-8."""
    (pos, faces), body = swinging()
    rng = np.random.default_rng(0)
    flipped = faces.copy()
    flipped[::7] = flipped[::7, ::-1]
    torch.testing.assert_close(collided((pos, flipped), body), reference, rtol=0, atol=1e-8)
    order = rng.permutation(len(pos))
    relabelled = rng.permutation(np.argsort(order)[faces], axis=0)
    torch.testing.assert_close(collided((pos[order], relabelled), body), reference[order], rtol=0, atol=1e-8)


def test_turning_and_mirroring_the_scene_turns_and_mirrors_the_result(reference):
    (pos, faces), (body, body_faces) = swinging()
    angle = float(np.random.default_rng(1).uniform(0.3, 1.2))
    yaw = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
    turned = collided((pos @ yaw.T, faces), (body @ yaw.T, body_faces))
    torch.testing.assert_close(turned, reference @ torch.as_tensor(yaw.T), rtol=0, atol=1e-8)
    mirror = np.array([-1.0, 1.0, 1.0])
    mirrored = collided((pos * mirror, faces[:, ::-1].copy()), (body * mirror, body_faces[:, ::-1].copy()))
    torch.testing.assert_close(mirrored, reference * torch.as_tensor(mirror), rtol=0, atol=1e-8)


def test_partners_in_a_batch_play_no_role():
    """Three scenes of different size, time step and body; each to 1e-8 m as it is alone."""
    (pos, faces), body = swinging()
    turn = random_rotation(np.random.default_rng(2))
    scenes = [
        over(problem_of((pos, faces)), surface(body)),
        over(problem_of(wavy(4, 7, 0.2), 1 / 60, Material(density=0.1)), surface(sphere(1, 0.05))),
        over(problem_of((pos @ turn.T, faces), 1 / 120), surface(body)),
    ]
    together = StepProblem(
        concatenate_cloths([scene.cloth for scene in scenes]),
        concatenate_states([scene.state for scene in scenes]),
        StepInput(
            torch.cat([scene.step.dt for scene in scenes]), concatenate_obstacles([scene.step.obstacle for scene in scenes])
        ),
        gravity=scenes[0].gravity,
    )
    alone = [last(implicit_euler(default_potential(), scene, 4, TIGHT)).state.pos for scene in scenes]
    batch = last(implicit_euler(default_potential(), together, 4, TIGHT)).state.pos
    torch.testing.assert_close(batch, torch.cat(alone), rtol=0, atol=1e-8)

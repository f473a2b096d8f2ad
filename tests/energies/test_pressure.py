"""Air inside cloth: its volume, its forces, the balloon, and what it makes of a garment."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import hood
from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.energies.mass_points import Inertia
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential, default_potential, relative_gradient
from hood.energies.pressure import Pressure, pressure, surface_of
from hood.energies.problem import StepProblem
from hood.energies.term import Form, form_of, role_of
from hood.solver.derivatives.step_terms import StepTerms
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.plan import plan_for, quadratic_model
from hood.solver.vertex.block_jacobi import LocalTerms
from hood.testing import (
    Mesh,
    assert_finite_when_degenerate,
    assert_gradient,
    box,
    cylinder,
    grid,
    internal_energy_figures,
    make_problem,
    sphere,
)

RADIUS = 0.2


def problem_of(mesh: Mesh, dtype: torch.dtype = torch.float64, dt: float = 1 / 30) -> StepProblem:
    problem = make_problem(build_cloth(*mesh, Material(), dtype=dtype), dt=dt)
    return replace(problem, gravity=torch.zeros(3))


def energy(problem: StepProblem, pascal: float = 1.0) -> torch.Tensor:
    return Pressure(pascal)(problem, problem.state.pos, torch.zeros_like(problem.state.pos))


def crumpled(problem: StepProblem, size: float = 0.02) -> torch.Tensor:
    noise = np.random.default_rng(3).normal(size=problem.state.pos.shape)
    return problem.state.pos + size * torch.as_tensor(noise).to(problem.state.pos)


@pytest.mark.parametrize(
    ("mesh", "volume"),
    [
        (sphere(4, RADIUS), 4.0 / 3.0 * math.pi * RADIUS**3),
        (cylinder(96, 5, RADIUS, 0.5), math.pi * RADIUS**2 * 0.5),
        (box(4, 0.3), 0.3**3),
    ],
    ids=["sphere", "open cylinder", "box"],
)
def test_volume(mesh: Mesh, volume: float) -> None:
    assert float(energy(problem_of(mesh), 7.0)) == pytest.approx(-7.0 * volume, rel=4e-3)


def test_an_energy_of_shape_alone() -> None:
    """What every such energy must satisfy, but for being zero at rest, and for flat strips, which have the side of a face."""
    term = Pressure(50.0)
    figures = internal_energy_figures(term)
    del figures["at_rest"], figures["labels"]
    assert max(figures.values()) < 1e-6, figures
    assert {name: value for name, value in figures.items() if name.startswith("net_")}.keys() == {"net_force", "net_torque"}
    assert max(figures["net_force"], figures["net_torque"]) < 1e-14
    assert_gradient(term, np.random.default_rng(0))
    assert_finite_when_degenerate(term)


@pytest.mark.parametrize("pascal", [40.0, -40.0])
@pytest.mark.parametrize("mesh", [sphere(2, RADIUS), cylinder(10, 5), grid(5, 5)], ids=["closed", "open", "flat"])
def test_the_closed_form_is_that_of_autograd(mesh: Mesh, pascal: float) -> None:
    problem = problem_of(mesh)
    potential = Potential({"pressure": Pressure(pascal), "inertia": Inertia()})
    pos = crumpled(problem).requires_grad_(True)
    expected, energies = potential.gradient(problem, pos)
    form = Pressure(pascal).closed_form(problem)
    gradient, matrix = form.derivatives(pos.detach())
    torch.testing.assert_close(form.energy(pos), energies["pressure"])
    only = Potential({"pressure": Pressure(pascal)}).gradient(problem, pos)[0]
    torch.testing.assert_close(gradient, only, rtol=1e-10, atol=1e-14)
    assert bool((torch.linalg.eigvalsh(matrix) >= 0).all())
    # the solver, and what networks are shown
    acc = problem.acceleration(pos.detach())
    model = quadratic_model(potential, problem, plan_for(problem), pos.detach(), acc)
    torch.testing.assert_close(model.gradient, expected, rtol=1e-10, atol=1e-14)
    torch.testing.assert_close(sum(StepTerms(potential, problem).energies(pos.detach(), acc)), sum(energies.values()))
    torch.testing.assert_close(-LocalTerms(potential, problem)(pos.detach()).force, expected, rtol=1e-10, atol=1e-14)


def test_what_sucks_is_bounded_by_single_vertices() -> None:
    """The matrix is no less than the second derivative, where it is needed."""
    problem = problem_of(sphere(1, RADIUS))
    form, pos = Pressure(-30.0).closed_form(problem), crumpled(problem)
    exact = torch.autograd.functional.hessian(lambda x: form.energy(x).sum(), pos).reshape(pos.numel(), -1)
    bound = torch.block_diag(*form.derivatives(pos)[1])
    assert float(torch.linalg.eigvalsh(bound - exact).min()) > -1e-9 * float(bound.max())


def test_it_is_one_closed_form_among_others() -> None:
    term = Pressure(10.0)
    assert form_of(term) is Form.BLOCKS
    assert Potential({"pressure": term}).settings == {"pressure": {"term": "Pressure", "pascal": 10.0}}
    assert role_of(term) is not None


def test_winding_pieces_and_scenes_play_no_role() -> None:
    pos, faces = sphere(2, RADIUS)
    turned = faces.copy()
    turned[::3] = turned[::3, ::-1]
    one = float(energy(problem_of((pos, faces))))
    assert float(energy(problem_of((pos, faces[:, ::-1])))) == pytest.approx(one, rel=1e-12)
    assert float(energy(problem_of((pos, turned)))) == pytest.approx(one, rel=1e-12)
    tube = cylinder(12, 4)
    both = np.concatenate([pos, tube[0] + 1.0]), np.concatenate([faces, tube[1] + len(pos)])
    assert float(energy(problem_of(both))) == pytest.approx(one + float(energy(problem_of(tube))), rel=1e-12)
    cloths = [build_cloth(*mesh, Material(), dtype=torch.float64) for mesh in ((pos, faces), tube)]
    batch = make_problem(concatenate_cloths(cloths))
    assert energy(batch).tolist() == pytest.approx([one, float(energy(problem_of(tube)))], rel=1e-12)


@pytest.mark.parametrize("pascal", [2.0, 20.0, 100.0, 500.0])
def test_a_balloon_has_its_radius(pascal: float) -> None:
    """p = 2 T / R with the tension T = 2 h (μ + λ) G of the sheet, G = (s² - 1) / 2 at the stretch s = R / R₀."""
    problem = problem_of(sphere(3, RADIUS), dt=5.0)
    cloth = problem.cloth
    stiffness = float((cloth.thickness * (cloth.lame_mu + cloth.lame_lambda))[0])
    a = pascal * RADIUS / (2.0 * stiffness)
    stretch = 0.5 * (a + math.sqrt(a * a + 4.0))  # s² - a s - 1 = 0
    assert stretch > 1.0005
    potential = Potential({"stretching": Stretching(), "inertia": Inertia(), "pressure": Pressure(pascal)})
    settings = NewtonSettings(target_rg=1e-4, max_iterations=200)
    pos, report = minimize(potential, problem, settings=settings)
    assert bool(report.converged.all())
    radius = float((pos - pos.mean(dim=0)).norm(dim=1).mean())
    assert radius - RADIUS == pytest.approx((stretch - 1.0) * RADIUS, rel=0.03)


@pytest.mark.parametrize("pascal", [5.0, -0.1])
def test_the_compiled_solver_takes_it(pascal: float) -> None:
    """Of two scenes, each its own."""
    cloths = [build_cloth(*mesh, Material(), dtype=torch.float64) for mesh in (cylinder(10, 6), sphere(2, RADIUS))]
    problem = make_problem(concatenate_cloths(cloths))
    potential = default_potential().with_terms(pressure=Pressure(pascal))
    found, report = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-8, engine="compiled"))
    same, _ = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-8, engine="torch"))
    assert bool(report.converged.all())
    torch.testing.assert_close(found, same, rtol=0.0, atol=1e-8)
    true = relative_gradient(problem, potential.gradient(potential.prepare(problem), found)[0])
    torch.testing.assert_close(report.relative_gradient, true, rtol=1e-3, atol=1e-10)


@pytest.mark.parametrize("pascal", [-1e5, -1e3, -1.0, 1e-6, 1e3, 1e5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extreme_pressures_are_finite(pascal: float, dtype: torch.dtype) -> None:
    problem = problem_of(cylinder(8, 4), dtype)
    potential = default_potential().with_terms(pressure=Pressure(pascal))
    pos, report = minimize(potential, problem, settings=NewtonSettings(max_iterations=10, engine="torch"))
    assert bool(torch.isfinite(pos).all())
    assert bool(torch.isfinite(report.relative_gradient).all())


def test_cloth_without_a_volume() -> None:
    """Flat, or crushed to a point: no volume, finite forces."""
    flat = problem_of(grid(6, 6))
    assert float(energy(flat)) == 0.0
    point = problem_of(sphere(1, RADIUS))
    form = Pressure(100.0).closed_form(point)
    crushed = torch.zeros_like(point.state.pos)
    assert float(form.energy(crushed)) == 0.0
    assert not any(bool(values.any()) for values in form.derivatives(crushed))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e6])
def test_impossible_pressures_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="one atmosphere"):
        Pressure(value)


def test_the_term_of_a_config() -> None:
    assert pressure() is None
    assert pressure(0) is None
    assert isinstance(pressure(-3), Pressure)
    for wrong in ("high", True, [3]):
        with pytest.raises(ValueError, match=r"losses\.terms\.pressure\.pascal="):
            pressure(wrong)  # type: ignore[arg-type]


def test_cloth_without_an_inside_is_refused() -> None:
    pos, faces = grid(3, 3)
    fin = np.concatenate([pos, [[0.5, 0.5, 0.5]]])
    inner = build_cloth(pos, faces, Material()).hinges[0, :2].tolist()
    three = np.concatenate([faces, [[*inner, len(pos)]]])
    with pytest.raises(ValueError, match="three faces share an edge"):
        energy(problem_of((fin, three)))
    angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    across = np.stack([np.cos(angle / 2) * np.cos(angle), np.sin(angle / 2), np.cos(angle / 2) * np.sin(angle)], axis=1)
    middle = np.stack([np.cos(angle), np.zeros(12), np.sin(angle)], axis=1)
    low, high = np.arange(12), np.arange(12) + 12
    up, down = np.roll(high, -1), np.roll(low, -1)
    up[-1], down[-1] = 0, 12
    strip = np.concatenate([np.stack([low, down, high], axis=1), np.stack([high, down, up], axis=1)])
    with pytest.raises(ValueError, match="one side alone"):
        energy(problem_of((np.concatenate([middle - 0.2 * across, middle + 0.2 * across]), strip)))


def test_a_dress_is_blown_up() -> None:
    """Eight pascals under a dress widen its hem, and nothing breaks."""
    widths, strains = [], []
    for pascal in (None, 8.0):
        losses = {"terms": {"pressure": {"pascal": pascal}}}
        frames = list(hood.simulate("dress", "stand_sway", stepper="newton", num_frames=3, cloth_contact="off", losses=losses))
        hem = frames[-1].world_pos[frames[-1].world_pos[:, 1] < frames[-1].world_pos[:, 1].min() + 0.05]
        widths.append(np.linalg.norm(hem[:, [0, 2]] - hem[:, [0, 2]].mean(axis=0), axis=1).mean())
        strains.append(frames[-1].metrics["strain_p99"])
    assert widths[1] > 1.03 * widths[0]
    assert strains[1] < 0.15


def test_surfaces_are_made_once() -> None:
    problem = problem_of(cylinder(8, 4))
    assert surface_of(problem.cloth) is surface_of(replace(problem.cloth, mass=problem.cloth.mass * 2))

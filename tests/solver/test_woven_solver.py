"""Cloth with warp and weft in the solver: its matrices, the compiled form, and states that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_engine import COMPILED, TORCH, dense, dense_of, model_at
from test_plan import states, touching_sheet
from torch import Tensor

from hood.assets.material import Material, stretch_stiffness
from hood.cloth.cloth import Cloth, build_cloth, concatenate_cloths
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.mass_points import Gravity, Inertia
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.solver.compiled.system import CompiledSystem
from hood.solver.derivatives.elements import Corners, face_constants, face_model
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import Unknowns
from hood.solver.system.plan import plan_for, quadratic_model
from hood.solver.vertex.gauss_seidel import sweep
from hood.testing import cylinder, grid, make_problem, with_weave

F64 = torch.float64
WOVEN = Material(warp=40.0, weft=15.0, shear=0.3)
DAMPED = default_potential().with_terms(stretch_damping=StretchDamping(0.02), bend_damping=BendDamping(0.03))


def woven_sheet() -> StepProblem:
    """The touching sheet of the solver's tests, of which one half is woven and the other as it was."""
    problem = touching_sheet()
    cloth = with_weave(problem.cloth)
    centre = cloth.rest_pos[cloth.faces].mean(dim=1)[:, :1]
    return replace(problem, cloth=replace(cloth, weave=torch.where(centre > centre.mean(), cloth.weave, 1.0)))


@pytest.mark.parametrize("damped", [False, True])
@pytest.mark.parametrize("size", [0.01, 0.1])
def test_matrix_and_slack_are_the_hessian_and_the_matrix_is_positive(damped, size):
    cloth = build_cloth(*cylinder(5, 3), WOVEN, dtype=F64)
    pos = cloth.rest_pos + size * torch.as_tensor(np.random.default_rng(0).normal(size=tuple(cloth.rest_pos.shape)))
    problem, terms = make_problem(cloth), [Stretching(), *([StretchDamping(0.05)] if damped else [])]

    def energy(x: Tensor) -> Tensor:
        return sum(term(problem, x, x).sum() for term in terms)

    exact = torch.autograd.functional.hessian(energy, pos).reshape(pos.numel(), -1)
    eps = 1e-6
    rng = torch.Generator().manual_seed(1)
    way = torch.randn(pos.shape, generator=rng, dtype=F64)
    slopes = [torch.autograd.functional.jacobian(energy, pos + sign * eps * way) for sign in (1.0, -1.0)]
    differences = ((slopes[0] - slopes[1]) / (2 * eps)).reshape(-1)
    torch.testing.assert_close(exact @ way.reshape(-1), differences, rtol=1e-6, atol=1e-7 * float(exact.abs().max()))
    constants = face_constants(cloth)
    if damped:
        constants = constants.damped(0.05 / problem.step.dt[cloth.face_scene], problem.state.pos, cloth.faces)
    model = face_model(Corners(cloth.faces)(pos), constants)
    matrix, indefinite_part = torch.zeros_like(exact), torch.zeros_like(exact)
    rows, cols = torch.triu_indices(9, 9)
    corner_rows, corner_cols = torch.triu_indices(3, 3)
    for face, corners in enumerate(cloth.faces):
        index = (3 * corners[:, None] + torch.arange(3)).reshape(-1)
        block = torch.zeros(9, 9, dtype=F64)
        block[rows, cols] = block[cols, rows] = model.matrix[:, face]
        assert float(torch.linalg.eigvalsh(block).min()) > -1e-12 * float(block.abs().max())
        axial = torch.zeros(3, 3, dtype=F64)
        axial[corner_rows, corner_cols] = axial[corner_cols, corner_rows] = model.indefinite_part[:, face]
        assert float(torch.linalg.eigvalsh(axial).max()) < 1e-12 * float(block.abs().max())
        matrix[index[:, None], index] += block
        indefinite_part[index[:, None], index] += torch.kron(axial, torch.eye(3, dtype=F64))
    torch.testing.assert_close(matrix + indefinite_part, exact, rtol=1e-10, atol=1e-12 * float(exact.abs().max()))


@pytest.mark.usefixtures("compiled_solver")
@pytest.mark.parametrize("name", ["near", "stretched", "compressed", "folded", "coincident vertices"])
@pytest.mark.parametrize("potential", [default_potential(), DAMPED], ids=["elastic", "damped"])
def test_the_compiled_model_is_that_of_the_torch_form(name, potential):
    problem = woven_sheet()
    pos = states(problem)[name]
    if name == "coincident vertices":
        problem = replace(problem, state=replace(problem.state, pos=pos, vel=torch.zeros_like(pos)))
    there = Unknowns(potential, problem).at(pos)
    model = quadratic_model(potential, problem, plan_for(problem), there.pos, there.acc)
    scene = model_at(problem, potential, pos, wide=True)
    assert scene.values.phi == pytest.approx(float(there.phi), rel=1e-14, abs=float(there.noise))
    free = scene.tables.vertex[: scene.tables.num_rows]
    expected, found = model.gradient.numpy()[free], scene.array("gradient")[:, :3]
    assert np.abs(found - expected).max() <= 2e-13 * np.abs(expected).max()
    matrix = dense(scene, "matrix")
    for part, triples in (("matrix", model.triples), ("indefinite_part", model.indefinite_part)):
        error = np.abs(dense(scene, part) - dense_of(plan_for(problem), triples)).max()
        assert error <= 1e-14 * np.abs(matrix).max(), part
    half = model_at(problem, potential, pos, wide=False)
    assert np.abs(dense(half, "matrix") - matrix).max() <= 1e-6 * np.abs(matrix).max()


def hanging(material: Material = WOVEN, angle: float = 0.0) -> StepProblem:
    """A square sheet held at two corners; the warp is ``angle`` off the vertical of its texture."""
    pos, faces = grid(9, 9, 0.4)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    cloth = build_cloth(pos, faces, material, np.isin(np.arange(81), (0, 8)), dtype=F64, uv=(pos[:, [0, 2]] @ turn, faces))
    return make_problem(cloth, vel=torch.zeros_like(cloth.rest_pos) - torch.tensor([0.0, 0.5, 0.0], dtype=F64))


def together(problems: list[StepProblem]) -> StepProblem:
    """Steps as one of a batch."""
    cloth = concatenate_cloths([problem.cloth for problem in problems])
    pos, vel = (torch.cat([getattr(problem.state, name) for problem in problems]) for name in ("pos", "vel"))
    return make_problem(cloth, pos, vel)


@pytest.mark.usefixtures("compiled_solver")
def test_the_compiled_solver_finds_the_same_minimum_alone_and_in_a_batch():
    plain = hanging(Material())
    problems = [hanging(), hanging(angle=0.6), plain, hanging(Material(warp=1000.0, weft=300.0))]
    tight = {"target_rg": 1e-7, "max_iterations": 100}
    alone = []
    for problem in problems:
        there, expected = minimize(default_potential(), problem, settings=replace(TORCH, **tight))
        here, report = minimize(default_potential(), problem, settings=replace(COMPILED, **tight))
        assert expected.converged.all()
        assert report.converged.all()
        assert float((here - there).abs().max()) < 1e-7
        alone.append(here)
    pos, report = minimize(default_potential(), together(problems), settings=replace(COMPILED, **tight))
    assert report.converged.all()
    assert float((pos - torch.cat(alone)).abs().max()) < 1e-7  # plain cloth among woven: other formulas, the same energy
    woven, _ = minimize(default_potential(), together(problems[:2]), settings=replace(COMPILED, **tight))
    assert torch.equal(woven, torch.cat(alone[:2]))


@pytest.mark.usefixtures("compiled_solver")
def test_the_compiled_solver_sees_a_changed_weave():
    problem = hanging()
    softer = replace(problem, cloth=replace(problem.cloth, weave=0.1 * problem.cloth.weave))
    plain = replace(problem, cloth=replace(problem.cloth, weave=None, grain=None))
    found = [minimize(default_potential(), one, settings=COMPILED)[1] for one in (problem, softer, plain, problem)]
    energies = [float(report.phi) for report in found]
    assert energies[0] == energies[3]
    (scene,) = CompiledSystem(default_potential(), plain, plan_for(plain), 100)._engines
    assert scene.values.weave is None  # isotropic again: the compiled solver runs what it ran before
    assert len(set(energies)) == 3


def test_sweeps_lower_the_energy_of_woven_cloth():
    problem = hanging()
    _, exact = minimize(default_potential(), problem)
    values = [float(sweep(default_potential(), problem, None, count)[1].phi) for count in (0, 2, 8)]
    assert values[0] > values[1] > values[2] > float(exact.phi)


@pytest.mark.parametrize("settings", [TORCH, COMPILED], ids=["torch", "compiled"])
@pytest.mark.parametrize("factors", [(1000.0, 1.0, 1.0), (1.0, 1000.0, 1.0), (1000.0, 1000.0, 1.0), (1.0, 1.0, 1e-3)])
def test_stiffnesses_a_thousand_times_apart_converge(compiled_solver, settings, factors):
    material = Material(warp=factors[0], weft=factors[1], shear=factors[2])
    problem = hanging(material, angle=0.4)
    for _ in range(5):
        pos, report = minimize(default_potential(), problem, settings=settings)
        assert report.converged.all(), report.reason
        assert bool(torch.isfinite(pos).all())
        vel = (pos - problem.state.pos) / problem.vertex_dt
        problem = replace(problem, state=replace(problem.state, pos=pos, vel=vel))


# ---- a bar that hangs ----------------------------------------------------------------------------------------------------

LENGTH, LIGHT = 1.0, 0.01


def bar(material: Material, angle: float, width: float, rows: int) -> Cloth:
    """A bar in the plane z = 0 that hangs from y = 0; its warp is ``angle`` off the vertical."""
    sheet, faces = grid(rows, 5)
    pos = np.stack([width * sheet[:, 2], -LENGTH * sheet[:, 0], 0 * sheet[:, 0]], axis=1)
    warp = np.array([np.sin(angle), np.cos(angle)])
    uv = np.stack([pos[:, 0] * warp[1] - pos[:, 1] * warp[0], pos[:, :2] @ warp], axis=1)
    return build_cloth(pos, faces, material, pos[:, 1] > -1e-9, dtype=F64, uv=(uv, faces))


def drop(material: Material, angle: float, width: float = 0.04, rows: int = 61) -> float:
    """How far [m] the lower end of the bar sinks under its weight."""
    cloth = bar(material, angle, width, rows)
    potential = Potential({"stretching": Stretching(), "inertia": Inertia(), "gravity": Gravity()})
    problem = make_problem(cloth, dt=1e4)  # at rest
    settings = NewtonSettings(target_rg=1e-6, max_iterations=200, cg_iterations=3000)
    pos, report = minimize(potential, problem, problem.state.pos, settings)
    assert report.converged.all(), report.reason
    low = cloth.rest_pos[:, 1] < -LENGTH + 1e-9
    return float((cloth.rest_pos - pos)[low, 1].mean())


@pytest.mark.parametrize(("angle", "key"), [(0.0, "warp"), (np.pi / 2, "weft")])
def test_a_hanging_bar_is_as_long_as_its_stiffness_along_it_says(angle, key):
    """ρ g L² / 2 Y of a bar of stiffness Y along its threads: the whole strip, which narrows nowhere as λ = 0."""
    material = Material(density=LIGHT, lame_lambda=0.0, warp=100.0, weft=30.0, shear=0.5)
    stiffness = getattr(material, key) * stretch_stiffness(material.lame_mu, 0.0, material.thickness)
    expected = material.density * 9.81 * LENGTH**2 / (2.0 * stiffness)
    assert drop(material, angle) == pytest.approx(expected, rel=0.005)


def test_a_bar_on_the_bias_stretches_more_than_one_along_a_thread():
    """1/Y at 45° is ¼ (1/Y_warp + 1/Y_weft + 1/G) for λ = 0 in a long strip (Jones, chapter 2)."""
    material = Material(density=LIGHT, lame_lambda=0.0, warp=100.0, weft=60.0)
    warp, weft, bias = drop(material, 0.0), drop(material, np.pi / 2), drop(material, np.pi / 4, width=0.02, rows=161)
    assert bias > 10 * max(warp, weft)
    one, shear = stretch_stiffness(material.lame_mu, 0.0, material.thickness), material.lame_mu * material.thickness
    compliance = 0.25 * (1.0 / (100.0 * one) + 1.0 / (60.0 * one) + 1.0 / shear)
    assert bias == pytest.approx(0.5 * material.density * 9.81 * LENGTH**2 * compliance, rel=0.05)

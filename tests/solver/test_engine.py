"""The compiled solver is the torch solver."""

from __future__ import annotations

import warnings
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix, triu
from test_newton import batch, falling, hanging, pieces
from test_plan import states, touching_sheet

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.bending import Bending
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.potential import default_potential, reference_potential
from hood.energies.wind import Wind
from hood.native import build as native_build
from hood.native.build import BuildError
from hood.solver import newton
from hood.solver.compiled import newton as engine
from hood.solver.compiled import system as compiled_system
from hood.solver.compiled.system import CompiledScene, CompiledSystem
from hood.solver.compiled.tables import _by_levels, build_tables
from hood.solver.newton import NewtonSettings, TorchSystem, minimize
from hood.solver.system import linear
from hood.solver.system.iterate import Unknowns
from hood.solver.system.plan import plan_for, quadratic_model
from hood.tensors.batch import to_device
from hood.testing import grid, make_problem

pytestmark = pytest.mark.usefixtures("compiled_solver")
TORCH, COMPILED = NewtonSettings(engine="torch"), NewtonSettings(engine="compiled")


def model_at(problem, potential, pos, wide):
    """Engine of a problem with one scene, with the model at ``pos`` made."""
    system = CompiledSystem(potential, problem, plan_for(problem), 100)
    (scene,) = system._engines
    scene.widen(wide)
    system.begin(pos)
    scene.model()
    scene.matrix()
    return scene


def dense(scene: CompiledScene, name: str) -> np.ndarray:
    """``matrix`` or ``indefinite_part`` of an engine as (3N, 3N), unknowns in the order of the cloth."""
    tables, size = scene.tables, scene.tables.num_rows
    blocks = np.zeros((len(tables.cols), 3, 3))
    if name == "matrix":
        blocks += tables.blocks(scene.array("matrix"))
    else:
        blocks += scene.array("indefinite_part")[:, None, None] * np.eye(3)
        upper = scene.array("own_indefinite_part").reshape(-1, 6)
        blocks[tables.row_starts[:-1]] += upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    rows = np.repeat(np.arange(size), np.diff(tables.row_starts))
    rank = np.argsort(np.argsort(tables.vertex[:size]))
    result = np.zeros((size, 3, size, 3))
    result[rank[tables.cols], :, rank[rows], :] = blocks.transpose(0, 2, 1)
    result[rank[rows], :, rank[tables.cols], :] = blocks
    return result.reshape(3 * size, 3 * size)


def dense_of(plan, triples) -> np.ndarray:
    result = np.zeros((3 * plan.pattern.size, plan.pattern.size, 3))
    result[plan.pattern.triple_rows, plan.pattern.triple_cols] = triples.numpy()
    return result.reshape(3 * plan.pattern.size, -1)


BLOWN = default_potential().with_terms(
    wind=Wind([3.0, 1.0, -2.0], gusts=0.3), stretch_damping=StretchDamping(0.02), bend_damping=BendDamping(0.03)
)
#: To which linear systems are solved where iterations are compared, in float64.
CLOSELY = 1e-12


def after(potential, problem, settings, count):
    """Positions (V, 3) and potential [J] after so many iterations, with linear systems solved closely."""
    problem = potential.prepare(problem)
    with pytest.MonkeyPatch.context() as patch:
        for module in (linear, compiled_system):
            patch.setattr(module, "TOLERANCES", (CLOSELY, CLOSELY))
        system = newton.system_of(potential, problem, plan_for(problem), replace(settings, cg_iterations=10_000))
        for scene in getattr(system, "_engines", ()):
            scene.widen(True)
        system.begin(None)
        for _ in range(count):
            residual = system.model()
            assert system.move(residual, [True] * problem.num_scenes)
    return system.state()[0], system.phi


POTENTIALS = {"default": default_potential(), "reference": reference_potential(), "wind and damping": BLOWN}


@pytest.mark.parametrize("name", ["near", "stretched", "compressed", "folded", "coincident vertices"])
@pytest.mark.parametrize("kind", POTENTIALS)
def test_potential_gradient_and_matrix_are_those_of_the_torch_form(name, kind):
    problem, potential = touching_sheet(), POTENTIALS[kind]
    if kind == "reference":
        potential = potential.with_terms(collision=default_potential().terms["collision"])  # the sheet has no obstacle
    pos = states(problem)[name]
    if name == "coincident vertices":  # and stay so to the last bit: reached without acceleration
        problem = replace(problem, state=replace(problem.state, pos=pos, vel=torch.zeros_like(pos)))
    unknowns, plan = Unknowns(potential, problem), plan_for(problem)
    there = unknowns.at(pos)
    model = quadratic_model(potential, problem, plan, there.pos, there.acc)
    scene = model_at(problem, potential, pos, wide=True)
    assert scene.values.phi == pytest.approx(float(there.phi), rel=1e-15, abs=float(there.noise))
    assert scene.values.noise == pytest.approx(float(there.noise), rel=1e-12)
    free = scene.tables.vertex[: scene.tables.num_rows]
    expected, found = model.gradient.numpy()[free], scene.array("gradient")[:, :3]
    assert np.abs(found - expected).max() <= 2e-14 * np.abs(expected).max()
    matrix = dense(scene, "matrix")
    for part, triples in (("matrix", model.triples), ("indefinite_part", model.indefinite_part)):
        error = np.abs(dense(scene, part) - dense_of(plan, triples)).max()
        assert error <= 2e-15 * np.abs(matrix).max(), part
    half = model_at(problem, potential, pos, wide=False)
    assert np.abs(dense(half, "matrix") - matrix).max() <= 1e-6 * np.abs(matrix).max()


@pytest.mark.parametrize("potential", [default_potential(), BLOWN], ids=["default", "wind and damping"])
@pytest.mark.parametrize("make", [hanging, falling, touching_sheet])
def test_iterations_are_those_of_the_torch_form(make, potential):
    """With linear systems solved closely: the two have preconditioners of their own."""
    problem = make()
    for count in range(4):
        there, expected = after(potential, problem, TORCH, count)
        here, phi = after(potential, problem, COMPILED, count)
        assert float((here - there).norm()) <= 1e-4 * float((there - problem.state.pos).norm())
        assert phi == pytest.approx(expected, rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("make", [hanging, falling])  # the sheet in the air has many
def test_the_minimum_is_that_of_the_torch_form(make):
    problem = make()
    there, expected = minimize(default_potential(), problem, settings=replace(TORCH, target_rg=1e-6))
    here, report = minimize(default_potential(), problem, settings=replace(COMPILED, target_rg=1e-6))
    assert report.converged.all()
    assert expected.converged.all()
    assert float((here - there).norm()) <= 1e-5 * float((there - problem.state.pos).norm())
    torch.testing.assert_close(report.phi, expected.phi, rtol=1e-9, atol=1e-12)


def test_scenes_of_a_batch_do_not_touch_each_other():
    problems = pieces()
    alone = [minimize(default_potential(), problem, settings=COMPILED) for problem in problems]
    pos, report = minimize(default_potential(), batch(problems), settings=COMPILED)
    assert torch.equal(pos, torch.cat([positions for positions, _ in alone]))
    assert torch.equal(report.phi, torch.cat([single.phi for _, single in alone]))
    assert torch.equal(report.acc, torch.cat([single.acc for _, single in alone]))
    assert report.converged.all()


def test_runs_are_bit_identical_whatever_came_between():
    problem = touching_sheet()
    first, _ = minimize(default_potential(), problem, settings=COMPILED)
    minimize(default_potential(collision_weight=1e3), problem, 2.0 * problem.state.pos, COMPILED)
    assert torch.equal(minimize(default_potential(), problem, settings=COMPILED)[0], first)
    copy = replace(problem, cloth=to_device(problem.cloth, dtype=torch.float64), contact=problem.contact)
    assert torch.equal(minimize(default_potential(), copy, settings=COMPILED)[0], first)


def test_what_is_read_of_a_step_is_kept_for_the_same_problem_and_terms():
    potential, problem = default_potential(), touching_sheet()
    known = potential.prepare(problem)
    step = engine.compiled_step(potential, known)
    assert engine.compiled_step(potential, known) is step
    assert engine.compiled_step(potential.only(potential.terms), known) is step  # other potentials of the same terms
    other = potential.with_terms(stretching=copy(potential.terms["stretching"]))
    assert engine.compiled_step(other, known) is not step
    assert engine.compiled_step(potential, replace(known, gravity=2.0 * known.gravity)) is not step


@pytest.mark.parametrize("name", ["vel", "gravity", "dt", "mass"])
def test_what_is_changed_in_place_is_seen(name):
    potential, problem = default_potential(), hanging()
    known = potential.prepare(problem)
    before = minimize(potential, known, settings=COMPILED)[0]
    tensors = {"vel": known.state.vel, "gravity": known.gravity, "dt": known.step.dt, "mass": known.cloth.mass}
    tensors[name].mul_(2.0).add_(1e-3)
    found = minimize(potential, known, settings=COMPILED)[0]
    state = replace(known.state, vel=known.state.vel.clone())
    fresh = replace(known, state=state, gravity=known.gravity.clone())
    assert torch.equal(found, minimize(potential, fresh, settings=COMPILED)[0])
    assert float((found - before).abs().max()) > 1e-5


def test_pins_are_where_they_shall_be_and_a_changed_fabric_is_seen():
    problem = hanging()
    pinned = problem.cloth.pinned
    soft, _ = minimize(default_potential(), problem, settings=COMPILED)
    assert torch.equal(soft[pinned], problem.state.pos[pinned])
    stiff = replace(problem, cloth=replace(problem.cloth, bending_stiffness=1e4 * problem.cloth.bending_stiffness))
    harder, report = minimize(default_potential(), stiff, settings=COMPILED)
    assert report.converged.all()
    assert float((harder - soft).abs().max()) > 1e-5


def test_what_the_compiled_form_does_not_know_goes_to_torch():
    problem, plan = hanging(), None
    twice_bent = default_potential().with_terms(lining=Bending())
    assert not engine.applies(twice_bent, problem)
    for potential, settings in (
        (twice_bent, COMPILED),
        (default_potential(), replace(COMPILED, linear="direct")),
        (default_potential(), replace(COMPILED, double=False)),
    ):
        plan = plan_for(problem)
        plan.cache.pop("engines", None)
        _, report = minimize(potential, problem, settings=replace(settings, target_rg=1e-2))
        assert report.converged.all()
        assert "engines" not in plan.cache


def test_without_a_compiler_auto_is_torch_and_compiled_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("HOOD_CACHE", str(tmp_path))
    monkeypatch.setenv("CXX", "no-such-compiler")
    engine.library.cache_clear()
    problem = falling()
    problem.cloth.faces.add_(0)
    try:
        plan_for(problem).cache.clear()
        expected, _ = minimize(default_potential(), problem, settings=TORCH)
        newton._say_once.cache_clear()
        with pytest.warns(UserWarning, match=r"the solver runs in torch, .* no C\+\+ compiler: install g\+\+"):
            assert torch.equal(minimize(default_potential(), problem)[0], expected)
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # said once
            minimize(default_potential(), problem)
        with pytest.raises(
            BuildError, match=r"solver.engine=compiled: no C\+\+ compiler: install .* or use solver.engine=torch"
        ):
            minimize(default_potential(), problem, settings=COMPILED)
    finally:
        engine.library.cache_clear()


def test_a_damaged_library_is_built_anew(monkeypatch, tmp_path):
    monkeypatch.setenv("HOOD_CACHE", str(tmp_path))
    native_build.build(engine.SOURCE, (*native_build.NATIVE_FLAGS, "-O0"))
    (kept,) = tmp_path.rglob("*.so")
    kept.unlink()
    kept.write_bytes(b"half a file")
    assert native_build.build(engine.SOURCE, (*native_build.NATIVE_FLAGS, "-O0")).newton_face_record() > 0


def test_float64_takes_over_where_a_step_in_float32_leads_nowhere(monkeypatch):
    problem = hanging()
    system = CompiledSystem(default_potential(), problem, plan_for(problem), 100)
    (scene,) = system._engines
    system.begin(None)
    residual = system.model()
    move, tried = scene.move, []
    monkeypatch.setattr(scene, "move", lambda *args: tried.append(scene.wide) or (scene.wide and move(*args)))
    assert system.move(residual, [True]) == [True]
    assert tried == [False, True]
    assert system.move(system.model(), [True]) == [True]
    assert tried == [False, True, True]


def test_without_a_float64_form_the_step_ends_where_it_is(monkeypatch):
    problem = hanging()
    system = CompiledSystem(default_potential(), problem, plan_for(problem), 100)
    (scene,) = system._engines
    system.begin(None)
    residual = system.model()
    before = system.state()[0]
    single = engine.library()

    def gone(wide=False):
        if wide:
            raise BuildError("no C++ compiler")
        return single

    monkeypatch.setattr("hood.solver.compiled.system.library", gone)
    monkeypatch.setattr(scene, "move", lambda *args: False)
    assert system.move(residual, [True]) == [False]
    assert not scene.wide
    assert torch.equal(system.state()[0], before)


def test_a_scene_that_is_not_finite_is_left_alone():
    problem = batch([falling(), falling()])
    pos = problem.state.pos.clone()
    pos[3] = torch.nan
    broken = replace(problem, state=replace(problem.state, pos=pos))
    _, report = minimize(default_potential(), broken, settings=COMPILED)
    assert report.reason[0] == "not finite"
    assert report.reason[1] == ""


def test_the_torch_system_and_the_engine_tell_the_same_of_a_state():
    problem = falling()
    plan = plan_for(problem)
    systems = [TorchSystem(default_potential(), problem, plan, TORCH), CompiledSystem(default_potential(), problem, plan, 100)]
    for system in systems:
        system.begin(None)
    plain, compiled = systems
    torch.testing.assert_close(plain.phi, compiled.phi, rtol=1e-14, atol=0)
    torch.testing.assert_close(plain.model(), compiled.model(), rtol=1e-12, atol=0)
    for a, b in zip(plain.state(), compiled.state(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)


def test_a_cloth_without_free_vertices_or_hinges_is_left_as_it_is():
    pos, faces = grid(2, 2, 0.1)
    for pinned, mesh in ((np.ones(4, bool), faces), (np.zeros(4, bool), faces[:1])):
        cloth = build_cloth(pos, mesh, Material(), pinned, dtype=torch.float64)
        problem = make_problem(cloth)
        expected, _ = minimize(default_potential(), problem, settings=TORCH)
        found, report = minimize(default_potential(), problem, settings=COMPILED)
        assert report.converged.all()
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-7)


def test_a_vertex_may_have_hundreds_of_neighbours():
    count = 700
    angle = np.arange(count) * 2 * np.pi / count
    pos = np.concatenate([np.zeros((1, 3)), np.stack([np.cos(angle), 0.1 * np.sin(5 * angle), np.sin(angle)], axis=1)])
    rim = 1 + np.arange(count)
    faces = np.stack([np.zeros(count, np.int64), rim, np.roll(rim, -1)], axis=1)
    problem = make_problem(build_cloth(pos, faces, Material(), dtype=torch.float64))
    _, expected = minimize(default_potential(), problem, settings=replace(TORCH, max_iterations=1))
    _, report = minimize(default_potential(), problem, settings=replace(COMPILED, max_iterations=1))
    torch.testing.assert_close(report.phi, expected.phi, rtol=1e-6, atol=0)


def sizes_of_rows(tables) -> tuple[np.ndarray, np.ndarray]:
    """How far the first block beside the diagonal of every row is behind it, and how many blocks the row has."""
    count = np.diff(tables.row_starts)
    beside = np.append(tables.cols, -1)[tables.row_starts[:-1] + 1]
    return np.where(count > 1, beside - np.arange(tables.num_rows), tables.num_rows), count


def test_rows_wait_for_no_neighbour_in_the_order_and_end_where_the_one_before_did(tank_scene):
    behind, count = sizes_of_rows(build_tables(tank_scene.cloth, None, 0))
    assert np.mean(behind == 1) < 0.1  # 0.5 in the order of Cuthill and McKee alone
    assert np.mean(np.diff(count) != 0) < 0.6  # 0.8


def test_the_order_of_the_rows_leads_to_the_triangles_of_cuthill_and_mckee():
    generator = np.random.default_rng(0)
    size = 300
    rows, cols = generator.integers(0, size, (2, 1500))
    graph = csr_matrix((np.ones(1500, np.int8), (rows, cols)), shape=(size, size))
    graph = (graph + graph.T).tocsr()
    order = generator.permutation(size)
    place = np.empty(size, np.int64)
    place[_by_levels(graph, order)] = np.arange(size)
    assert sorted(place.tolist()) == list(range(size))
    before, after = triu(graph[order][:, order], k=1).nonzero()
    assert (place[before] < place[after]).all()


def strip(count):
    """A strip of triangles one by one, of which every vertex is a neighbour of the next two."""
    along = np.arange(count)
    pos = np.stack([0.01 * along, 0.02 * (along % 2), np.zeros(count)], axis=1)
    faces = np.stack([along[:-2], along[1:-1], along[2:]], axis=1)
    faces[1::2] = faces[1::2, ::-1]
    return build_cloth(pos, faces, Material(), dtype=torch.float64)


@pytest.mark.parametrize("make", [lambda: hanging().cloth, lambda: strip(40), lambda: strip(3)])
def test_pairs_have_every_row_once_and_no_neighbours(make):
    tables = build_tables(make(), None, 0)
    pairs = tables.pairs
    assert np.array_equal(pairs.row[pairs.slot], np.arange(tables.num_rows))
    assert len(pairs.row) == 2 * (len(pairs.starts) - 1)
    assert np.count_nonzero(pairs.row >= 0) == tables.num_rows
    rows = np.repeat(np.arange(tables.num_rows), np.diff(tables.row_starts))
    same_pair = pairs.slot[rows] // 2 == pairs.slot[tables.cols] // 2
    assert np.array_equal(same_pair, rows == tables.cols)
    for pair, (start, end) in enumerate(zip(pairs.starts[:-1], pairs.starts[1:], strict=True)):
        for half in range(2):
            row, cols = pairs.row[2 * pair + half], pairs.cols[start:end, half]
            own = np.full(end - start, 2 * pair + half)
            if row >= 0:
                known = pairs.slot[tables.cols[tables.row_starts[row] : tables.row_starts[row + 1]]]
                own[: len(known)] = known
            assert np.array_equal(cols, own)


def test_a_strip_in_which_every_row_waits_for_the_next_is_solved_as_in_torch():
    problem = make_problem(strip(40))
    _, expected = minimize(default_potential(), problem, settings=TORCH)
    _, report = minimize(default_potential(), problem, settings=COMPILED)
    torch.testing.assert_close(report.phi, expected.phi, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("make", [hanging, falling, touching_sheet])
def test_models_made_by_a_line_search_are_those_of_the_state(make):
    problem = make()
    (scene,) = (system := CompiledSystem(default_potential(), problem, plan_for(problem), 100))._engines
    system.begin(None)
    kept = []
    for _ in range(6):
        residual = system.model()
        found = scene.array("gradient").copy(), scene.array("face_model").copy(), scene.array("hinge_model").copy()
        scene.values.modelled = 0
        assert system.model() == residual
        for name, before in zip(("gradient", "face_model", "hinge_model"), found, strict=True):
            assert np.array_equal(scene.array(name), before), name
        if not system.move(residual, [True])[0]:
            break
        kept.append(scene.values.modelled)
    assert any(kept)


def test_a_step_that_float64_takes_over_has_models_of_its_own():
    problem = hanging()
    (scene,) = (system := CompiledSystem(default_potential(), problem, plan_for(problem), 100))._engines
    system.begin(None)
    residual = system.model()
    assert system.move(residual, [True])[0]
    single = system.model()[0]
    scene.widen(True)
    assert system.model()[0] == pytest.approx(single, rel=1e-12)
    assert np.frombuffer(scene.array("face_model").tobytes(), np.float64).any()

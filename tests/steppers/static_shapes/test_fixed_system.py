"""Newton's method in pieces of fixed shapes against the torch form, and that nothing in a piece depends on data."""

import copy
from dataclasses import replace

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from hood.cloth.cloth import concatenate_cloths
from hood.cloth.state import Attachments, concatenate_states, concatenate_step_inputs
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.potential import default_potential, scale
from hood.energies.problem import StepProblem
from hood.energies.wind import Wind
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings, minimize, run
from hood.solver.system.iterate import in_double
from hood.solver.system.plan import plan_for
from hood.steppers.static_shapes.newton_pieces import FixedSystem
from hood.tensors.dense import whole_arrays
from hood.testing import with_weave, without_values

POTENTIAL = default_potential()
BLOWN = POTENTIAL.with_terms(wind=Wind([3.0, 1.0, -2.0]), stretch_damping=StretchDamping(2e-3), bend_damping=BendDamping(2e-3))


def problem_of(scene: Scene, frame: int = 2) -> StepProblem:
    state = scene.start(frame)
    return default_potential().prepare(StepProblem(scene.cloth, state, scene.step_input(frame, state)))


def solve(problem, settings, start=None, potential=POTENTIAL):
    """Positions and report by the pieces."""
    work = in_double(problem)
    system = FixedSystem(potential.settled(work), lambda: work, plan_for(work), settings.cg_iterations)
    system.enter()
    system.begin(start)
    return run(system, work.state.pos, settings, 0.0, None)


def assert_same(problem, settings, start=None, potential=POTENTIAL):
    expected, reference = minimize(potential, in_double(problem), start, replace(settings, engine="torch"))
    pos, report = solve(problem, settings, start, potential)
    assert report.iterations == reference.iterations
    assert report.reason == reference.reason
    e0 = scale(in_double(problem))
    for now, then in zip(report.history, reference.history, strict=True):
        assert bool(((now.phi - then.phi).abs() <= 1e-6 * e0 + 1e-9 * then.phi.abs()).all())
    assert float((pos - expected).abs().max()) < 1e-6
    return report


def test_iterations_on_cloth_with_warp_and_weft_are_those_of_the_torch_form(band_scene):
    problem = problem_of(band_scene)
    assert_same(replace(problem, cloth=with_weave(problem.cloth)), NewtonSettings(max_iterations=6, target_rg=1e-6))


@pytest.mark.parametrize("name", ["band_scene", "skirt_scene", "tank_scene"])
@pytest.mark.parametrize("iterations", [1, 6])
def test_iterations_are_those_of_the_torch_form(name, iterations, request):
    settings = NewtonSettings(max_iterations=iterations, target_rg=1e-6)
    for frame in (0, 5):
        assert_same(problem_of(request.getfixturevalue(name), frame), settings)


def test_to_convergence_from_a_given_start(band_scene):
    problem = problem_of(band_scene)
    report = assert_same(problem, NewtonSettings(), problem.state.pos.double())
    assert bool(report.converged.all())


def test_wind_and_damping(band_scene):
    assert_same(problem_of(band_scene), NewtonSettings(max_iterations=4), potential=BLOWN)


def test_springs_and_no_body(tank_scene):
    problem = problem_of(tank_scene)
    buttons = Attachments(torch.tensor([[0, 70], [3, 60]]), torch.tensor([True, False]))
    step = replace(problem.step, attachments=buttons, obstacle=None)
    assert_same(replace(problem, step=step, contact=None), NewtonSettings(max_iterations=4))


def test_scenes_of_a_batch_stop_each_on_its_own(tank_scene, band_scene):
    scenes = (tank_scene, band_scene)
    problems = [problem_of(scene) for scene in scenes]
    counts = [scene.cloth.num_vertices for scene in scenes]
    cloth = concatenate_cloths([scene.cloth for scene in scenes])
    steps = concatenate_step_inputs([p.step for p in problems], counts)
    both = StepProblem(cloth, concatenate_states([p.state for p in problems]), steps)
    assert_same(default_potential().prepare(both), NewtonSettings(max_iterations=8, target_rg=1e-2))


@pytest.mark.parametrize("potential", [default_potential(), BLOWN], ids=["default", "wind and damping"])
def test_nothing_in_a_piece_depends_on_data(skirt_scene, potential):
    """Tensors without values, not on the CPU: whoever asks for one, or for an array whose size follows from one, fails."""
    problem = in_double(problem_of(skirt_scene))
    buttons = Attachments(torch.tensor([[0, 70], [3, 60]]), torch.tensor([True, False]))
    problem = replace(problem, step=replace(problem.step, attachments=buttons))
    potential, plan = potential.settled(problem), plan_for(problem)
    system = FixedSystem(potential, lambda: problem, plan, 100)
    scatters = ("matrix", "indefinite_part", "face_vertices", "hinge_vertices", "attachment_vertices")
    made = {name: getattr(plan, name) for name in scatters}
    with FakeTensorMode(allow_non_fake_inputs=False), whole_arrays():
        empty = without_values(problem)
        system._read = lambda: empty
        for name, value in list(vars(system).items()):
            if isinstance(value, torch.Tensor):
                setattr(system, name, without_values(value))
        system._plan = copy.copy(plan)
        tables = {name: without_values(getattr(plan, name)) for name in ("vertices", "scene", "centroids")}
        vars(system._plan).update({name: _empty_scatter(scatter) for name, scatter in made.items()} | tables)
        for piece in system.pieces.values():
            piece()
        assert system._model.triples.device.type == "meta"


def _empty_scatter(scatter):
    empty = object.__new__(type(scatter))
    vars(empty).update(vars(scatter))
    empty._source, empty._starts = without_values(scatter._source), without_values(scatter._starts)
    return empty

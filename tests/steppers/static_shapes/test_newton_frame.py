"""A whole step of Newton's method as one function: against the torch form, and that nothing in it depends on data."""

from dataclasses import replace

import pytest
import torch

from hood.cloth.cloth import concatenate_cloths
from hood.cloth.state import concatenate_states, concatenate_step_inputs
from hood.energies.potential import default_potential, scale
from hood.energies.problem import StepProblem
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import in_double
from hood.solver.system.plan import plan_for
from hood.steppers.newton import NewtonStepper
from hood.steppers.static_shapes.cuda_graph import trace
from hood.steppers.static_shapes.newton import CapturedNewton
from hood.steppers.static_shapes.newton_pieces import NewtonFrame
from hood.steppers.static_shapes.problem import settled_potential, step_inputs

POTENTIAL = default_potential()


def settings_of(iterations: int) -> NewtonSettings:
    return NewtonSettings(target_rg=1e-6, max_iterations=iterations, cg_iterations=100, engine="torch")


def problem_of(scene: Scene, frame: int = 2) -> StepProblem:
    state = scene.start(frame)
    return POTENTIAL.prepare(StepProblem(scene.cloth, state, scene.step_input(frame, state)))


def frame_of(problem: StepProblem, iterations: int, dense: bool = False) -> NewtonFrame:
    like = problem.with_fold()
    return NewtonFrame(settled_potential(POTENTIAL, problem), like, plan_for(like), 2000, settings_of(iterations), dense)


@pytest.mark.parametrize("name, iterations", [("band_scene", 1), ("tank_scene", 1), ("skirt_scene", 2)])
def test_the_first_iteration_is_that_of_the_torch_form(name, iterations, request):
    """Of the skirt the whole step is too long; the second iteration goes half of it, as the torch form's line search does."""
    problem = problem_of(request.getfixturevalue(name))
    expected, report = minimize(POTENTIAL, problem, settings=settings_of(1))
    pos, acc, residual, _ = frame_of(problem, iterations)(*step_inputs(problem, surface=True))
    assert float((pos - expected).abs().max()) < 1e-6
    assert float((acc - report.acc).norm() / report.acc.norm()) < 1e-5
    assert float(residual) == pytest.approx(float(report.relative_gradient), rel=1e-4)


@pytest.mark.parametrize("name", ["band_scene", "tank_scene"])
def test_five_iterations_come_as_far(name, request):
    """Within a hundredth of e0 of the torch form's, which takes a share of the indefinite part along."""
    problem = problem_of(request.getfixturevalue(name))
    expected, _ = minimize(POTENTIAL, problem, settings=settings_of(5))
    pos, *_ = frame_of(problem, 5)(*step_inputs(problem, surface=True))
    work = in_double(problem)
    reached, plain = (POTENTIAL.total(work, there.double()) for there in (pos, expected))
    assert float((reached - plain) / scale(work)) < 0.01


def test_iterations_beyond_the_minimum_change_nothing(band_scene):
    problem = problem_of(band_scene)
    lowest, _ = minimize(POTENTIAL, problem, settings=replace(settings_of(60)))
    pos, _, residual, _ = frame_of(problem, 20)(*step_inputs(problem, surface=True))
    assert float((pos - lowest).abs().max()) < 1e-5
    assert float(residual) < 1e-2


def test_scenes_of_a_batch_do_not_touch_each_other(band_scene):
    alone = [problem_of(band_scene, frame) for frame in (2, 5)]
    both = StepProblem(
        concatenate_cloths([one.cloth for one in alone]),
        concatenate_states([one.state for one in alone]),
        concatenate_step_inputs([one.step for one in alone], [one.cloth.num_vertices for one in alone]),
    )
    both = POTENTIAL.prepare(both)
    pos, _, residual, _ = frame_of(both, 3)(*step_inputs(both, surface=True))
    single = [frame_of(one, 3)(*step_inputs(one, surface=True)) for one in alone]
    assert float((pos - torch.cat([one[0] for one in single])).abs().max()) < 1e-6
    assert residual.tolist() == pytest.approx([float(one[2]) for one in single], rel=1e-3)


def test_nothing_in_it_depends_on_data(band_scene):
    """Traced with tensors without values; the trace of one state serves another."""
    problem, other = problem_of(band_scene), problem_of(band_scene, 5)
    module = trace(frame_of(problem, 2, dense=True), step_inputs(problem, surface=True))
    for given in (problem, other):
        expected = frame_of(problem, 2)(*step_inputs(given, surface=True))
        found = module(*step_inputs(given, surface=True))
        assert float((found[0] - expected[0]).abs().max()) < 1e-6


def test_more_iterations_than_a_frame_holds_are_refused():
    with pytest.raises(ValueError, match="solver.max_iterations=5 solver.cg_iterations=75"):
        CapturedNewton(NewtonStepper(POTENTIAL), "compiled")


@pytest.mark.slow
def test_the_compiled_frame_is_the_frame(band_scene):
    problem, settings = problem_of(band_scene), settings_of(2)
    compiled = CapturedNewton(NewtonStepper(POTENTIAL, settings), "compiled")
    found = compiled.predict(problem, None)
    expected = frame_of(problem, 2)(*step_inputs(problem, surface=True))
    assert float((found.next_pos - expected[0]).abs().max()) < 1e-6
    assert found.metrics["solver_iterations"] == 2.0
    assert found.metrics["solver_converged"] == 0.0

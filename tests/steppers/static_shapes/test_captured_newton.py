"""The solver's steps with fixed shapes are its plain ones."""

from dataclasses import replace

import pytest
import torch

from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import make_stepper
from hood.app.stepping.refinement import refined
from hood.energies.potential import default_potential, reference_potential, scale
from hood.energies.problem import StepProblem
from hood.rollouts.loop import simulate
from hood.scene.scene import build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.network import build_simulator
from hood.steppers.newton import NewtonStepper
from hood.steppers.refined import RefinedStepper, prepare_stepper
from hood.steppers.static_shapes.newton import CapturedNewton, FixedMinimizer, minimizer_for
from hood.steppers.stopping import Count, TargetResidual

SETTINGS = NewtonSettings(max_iterations=5, engine="torch")


def steppers(settings=SETTINGS, potential=None):
    plain = NewtonStepper(potential or default_potential(), settings)
    return plain, CapturedNewton(plain, "fixed")


def test_states_of_a_rollout_have_the_same_potential(garments, body, walk):
    """Five iterations on the states of a rollout: within a thousandth of e0."""
    scene = build_scene(garments["tank"], body, walk.window(0, 6), dtype=torch.float64)
    (plain, fixed), potential = steppers(), default_potential()
    state = scene.start(0)
    for frame in range(4):
        problem = StepProblem(scene.cloth, state, scene.step_input(frame, state))
        known = potential.prepare(problem)
        expected, found = plain.predict(problem, None), fixed.predict(problem, None)
        phi = [potential.total(known, prediction.next_pos) for prediction in (expected, found)]
        assert float((phi[1] - phi[0]).abs() / scale(problem)) < 1e-3
        assert found.metrics == expected.metrics
        state = replace(state, pos=expected.next_pos, vel=plain.next_velocity(problem, expected))


def test_a_rollout_is_the_plain_one(band_scene):
    frames = [list(simulate(stepper, band_scene, default_potential(), 3)) for stepper in steppers()]
    moved = float((frames[0][-1].world_pos - frames[0][0].world_pos).abs().max())
    for plain, fixed in zip(*frames, strict=True):
        assert float((fixed.world_pos - plain.world_pos).abs().max()) < 1e-3 * moved
        assert fixed.metrics.get("solver_iterations") == plain.metrics.get("solver_iterations")


def test_one_plan_serves_a_cloth_and_another_is_made_where_it_must(skirt_scene):
    _, fixed = steppers()
    plans = []
    for frame, gravity in ((2, -9.81), (6, -9.81), (6, -1.62)):
        state = skirt_scene.start(frame)
        step = skirt_scene.step_input(frame, state)
        problem = StepProblem(skirt_scene.cloth, state, step, gravity=torch.tensor([0.0, gravity, 0.0]))
        result = fixed.predict(problem, None).next_pos
        assert float((result - fixed.stepper.predict(problem, None).next_pos).abs().max()) < 1e-5
        plans.append(fixed._minimize._plan)
    assert plans[0] is plans[1]
    assert plans[1] is not plans[2]


def network():
    torch.manual_seed(0)
    return build_simulator("physical", "velocity_base", "1x(mesh+coarse0)", latent_dim=8, output_init=0.1).eval()


@pytest.mark.parametrize("goal", [Count(1), Count(4), TargetResidual(0.05)])
def test_iterations_after_a_network_are_the_plain_ones(skirt_scene, goal):
    """The same iterations from where the network led, in the precision of the scene, down to the same potential."""
    potential, inner = default_potential(), network()
    plain, fixed = (
        RefinedStepper(inner, potential, goal, settings=NewtonSettings(engine="torch"), minimizer=minimizer)
        for minimizer in (None, FixedMinimizer("fixed"))
    )
    for frame in (2, 6):
        state = skirt_scene.start(frame)
        problem = StepProblem(skirt_scene.cloth, state, skirt_scene.step_input(frame, state), gravity=inner.gravity)
        expected, found = (one.predict(problem, prepare_stepper(one, skirt_scene)) for one in (plain, fixed))
        assert float((found.next_pos - expected.next_pos).abs().max()) < 1e-5
        assert float((problem.acceleration(found.next_pos) - found.acc).abs().max()) < 0.1  # of 1 / dt² times a rounding
        for name in ("refine_iterations", "refine_reason"):
            assert found.metrics[name] == expected.metrics[name]
        for name in ("refine_phi_before", "refine_phi_after"):
            assert found.metrics[name] == pytest.approx(expected.metrics[name], rel=1e-4)
        assert found.metrics["refine_phi_after"] < found.metrics["refine_phi_before"]


def test_refinement_follows_the_step():
    def minimizer(*words):
        config = RolloutSettings.from_words(["refine=2", *words])
        return refined(network(), config, 1000)._minimizer

    assert minimizer("step=fixed").mode == "fixed"
    assert minimizer("step=compiled") is None  # a CPU has no graphs
    assert minimizer("step=plain") is None
    assert minimizer("step=fixed", "refine={goal: 2, method: sweeps}") is None
    assert minimizer_for("compiled", NewtonSettings(), torch.device("cuda")).mode == "captured"
    with pytest.raises(ValueError, match="solver.linear=direct has no form of fixed shapes; use cg or step=plain"):
        minimizer("step=fixed", "solver.linear=direct")


def test_what_has_no_such_form_is_refused(skirt_scene):
    plain, _ = steppers()
    with pytest.raises(ValueError, match="step=other is none of the solver's; choose plain, fixed or captured or compiled"):
        CapturedNewton(plain, "other")
    with pytest.raises(ValueError, match="step=captured needs device=cuda"):
        CapturedNewton(plain, "captured")
    with pytest.raises(ValueError, match="solver.linear=direct has no form of fixed shapes"):
        CapturedNewton(NewtonStepper(default_potential(), NewtonSettings(linear="direct")), "fixed")
    state = skirt_scene.start(2)
    problem = StepProblem(skirt_scene.cloth, state, skirt_scene.step_input(2, state))
    with pytest.raises(ValueError, match="use step=plain"):
        steppers(potential=reference_potential())[1].predict(problem, None)


def test_the_command_makes_it_or_refuses():
    config = RolloutSettings.from_words(["stepper=newton", "step=fixed"])
    assert isinstance(make_stepper(config)[0], CapturedNewton)
    with pytest.raises(ConfigError, match="steps of stepper=refine are plain"):
        make_stepper(RolloutSettings.from_words(["stepper=refine", "step=fixed"]))

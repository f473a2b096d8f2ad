"""Steps taken further down the potential: never up, as far as asked, by whatever stepper went before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from reference_oracle import make_state
from torch import Tensor

from hood.energies.potential import default_potential, reference_potential
from hood.energies.problem import StepProblem
from hood.rollouts.frame import Frame, metric_names
from hood.rollouts.loop import simulate, start_state
from hood.scene.scene import Scene
from hood.solver.system.iterate import Unknowns, first_iterate, in_double
from hood.steppers.network import Prediction, build_simulator
from hood.steppers.newton import Stepper
from hood.steppers.published import import_reference_weights
from hood.steppers.refined import METHODS, GuessStepper, RefinedStepper, prepare_stepper, unrefined
from hood.steppers.static_shapes.simulator import CapturedSimulator
from hood.steppers.stopping import Budget, Count, MaxStrain, StoppingCriterion, TargetResidual

POTENTIAL = default_potential()


def single_pass() -> Stepper:
    torch.manual_seed(0)
    return build_simulator("physical", "velocity_base", "1x(mesh+coarse0)", latent_dim=8, output_init=0.1).eval()


def passes() -> Stepper:
    torch.manual_seed(0)
    return build_simulator("local", "local_steps", "1x(mesh) | 1x(mesh)", latent_dim=8, output_init=0.3).eval()


def reference(layout: str = "fine15") -> Stepper:
    return import_reference_weights(make_state(layout, 4))[0].eval()


def fixed_shapes() -> Stepper:
    torch.manual_seed(0)
    return CapturedSimulator(build_simulator("paper", "acceleration", "1x(mesh)", latent_dim=8).eval(), "fixed")


def no_network() -> Stepper:
    return GuessStepper(POTENTIAL)


STEPPERS: dict[str, Callable[[], Stepper]] = {
    "single pass": single_pass, "passes": passes, "reference": reference, "fixed shapes": fixed_shapes, "guess": no_network,
}  # fmt: skip


def one_step(stepper: Stepper, scene: Scene) -> tuple[StepProblem, Prediction]:
    state = scene.start(2)
    problem = POTENTIAL.prepare(StepProblem(scene.cloth, state, scene.step_input(2, state), gravity=stepper.gravity))
    return problem, stepper.predict(problem, prepare_stepper(stepper, scene))


def phi(problem: StepProblem, pos: Tensor) -> float:
    return float(POTENTIAL.total(in_double(problem), pos.detach().double()))


@pytest.mark.parametrize("kind", STEPPERS)
def test_no_iteration_is_the_inner_stepper_to_the_bit(kind: str, band_scene: Scene) -> None:
    plain = list(simulate(STEPPERS[kind](), band_scene, POTENTIAL, 4))
    refined = list(simulate(RefinedStepper(STEPPERS[kind](), POTENTIAL, Count(0)), band_scene, POTENTIAL, 4))
    for before, after in zip(plain, refined, strict=True):
        assert torch.equal(before.world_pos, after.world_pos)
        assert torch.equal(before.state.vel, after.state.vel)
    assert refined[-1].metrics["refine_iterations"] == 0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", STEPPERS)
def test_the_potential_falls_with_every_iteration(kind: str, method: str, band_scene: Scene) -> None:
    problem, before = one_step(STEPPERS[kind](), band_scene)
    pinned, values = band_scene.cloth.pinned, [phi(problem, before.next_pos)]
    for count in (1, 2, 4):
        stepper = RefinedStepper(STEPPERS[kind](), POTENTIAL, Count(count), method)
        _, refined = one_step(stepper, band_scene)
        values.append(phi(problem, refined.next_pos))
        assert refined.metrics["refine_phi_before"] == pytest.approx(values[0], rel=1e-4)
        assert refined.metrics["refine_phi_after"] <= refined.metrics["refine_phi_before"]
        assert refined.metrics["refine_iterations"] == count
        assert torch.equal(refined.next_pos[pinned], problem.step.pin_target[pinned])
        moved = problem.acceleration(refined.next_pos) - refined.acc
        assert float(moved[~pinned].abs().max()) < 2e-3  # the acceleration is the one that leads there
    assert all(after < before for before, after in zip(values, values[1:], strict=False))


@pytest.mark.parametrize("method", METHODS)
def test_where_nothing_is_lower_the_step_stays_to_the_bit(method: str, band_scene: Scene) -> None:
    thorough = RefinedStepper(GuessStepper(POTENTIAL), POTENTIAL, TargetResidual(1e-9, 200))
    _, at_minimum = one_step(thorough, band_scene)

    class There(GuessStepper):
        def predict(self, *args: object) -> Prediction:
            return replace(at_minimum, metrics={})

    _, stayed = one_step(RefinedStepper(There(POTENTIAL), POTENTIAL, Count(5), method), band_scene)
    gained = stayed.metrics["refine_phi_before"] - stayed.metrics["refine_phi_after"]
    assert 0 <= gained < 1e-9
    if gained == 0:
        assert torch.equal(stayed.next_pos, at_minimum.next_pos)
        assert torch.equal(stayed.acc, at_minimum.acc)


def test_the_residual_falls_with_its_target_and_misses_are_told(band_scene: Scene) -> None:
    reached, iterations = [], []
    for target in (30.0, 3.0, 0.3, 0.03, 1e-6):
        stepper = RefinedStepper(single_pass(), POTENTIAL, TargetResidual(target))
        metrics = one_step(stepper, band_scene)[1].metrics
        assert metrics["refine_met"] == 1.0
        assert metrics["refine_rg"] <= target
        reached.append(metrics["refine_rg"])
        iterations.append(metrics["refine_iterations"])
    assert reached == sorted(reached, reverse=True)
    assert iterations == sorted(iterations)
    assert iterations[0] < iterations[-1]
    for method in METHODS:
        missed = one_step(RefinedStepper(single_pass(), POTENTIAL, TargetResidual(1e-3, most=1), method), band_scene)[1].metrics
        assert missed["refine_met"] == 0.0
        assert missed["refine_rg"] > 1e-3
        assert missed["refine_iterations"] == 1


def test_sweeps_reach_a_target_as_well(band_scene: Scene) -> None:
    stepper = RefinedStepper(single_pass(), POTENTIAL, TargetResidual(3.0, 50), "sweeps")
    metrics = one_step(stepper, band_scene)[1].metrics
    assert metrics["refine_met"] == 1.0
    assert metrics["refine_rg"] <= 3.0
    assert metrics["refine_iterations"] < 50


def test_the_guess_is_where_the_solver_starts(band_scene: Scene) -> None:
    problem, guess = one_step(no_network(), band_scene)
    expected = first_iterate(Unknowns(POTENTIAL, in_double(problem)))
    torch.testing.assert_close(guess.next_pos, expected.pos.float(), rtol=0, atol=0)
    contact = problem.contact
    assert contact is not None
    free = band_scene.cloth.free
    assert float(contact.next_dist(guess.next_pos)[free].min()) > 0


@pytest.mark.parametrize("kind", STEPPERS)
def test_a_refined_rollout_is_nearer_to_equilibrium(kind: str, band_scene: Scene) -> None:
    potential = reference_potential() if kind == "reference" else POTENTIAL
    # An untrained network throws the band metres away: the way back takes a dozen iterations.
    stepper = RefinedStepper(STEPPERS[kind](), potential, Count(12))
    refined = list(simulate(stepper, band_scene, potential, 4))
    plain = list(simulate(STEPPERS[kind](), band_scene, potential, 4))
    names = set(metric_names(potential, stepper))
    for frame, other in zip(refined[1:], plain[1:], strict=True):
        assert set(frame.metrics) <= names
        assert frame.metrics["relative_gradient"] < 0.5 * other.metrics["relative_gradient"]
        assert frame.metrics["relative_gradient"] == pytest.approx(frame.metrics["refine_rg"], abs=2e-2)
        assert frame.metrics["refine_phi_after"] == pytest.approx(frame.metrics["energy_total"], rel=1e-3)
        assert frame.metrics["ms_refine"] > 0


@pytest.mark.parametrize("goal", [lambda: Budget(1e4, 3), lambda: MaxStrain(0.02, 5)], ids=["budget", "strain"])
def test_other_goals_in_a_rollout(goal: Callable[[], StoppingCriterion], band_scene: Scene) -> None:
    frames = list(simulate(RefinedStepper(single_pass(), POTENTIAL, goal()), band_scene, POTENTIAL, 4, metrics="strain"))
    for frame in frames[1:]:
        assert frame.metrics["refine_iterations"] > 0
        if "refine_met" in frame.metrics:
            assert frame.metrics["refine_met"] == float(frame.metrics["strain_p99"] <= 0.02)


def test_what_was_learned_ends_with_the_rollout(band_scene: Scene) -> None:
    stepper = RefinedStepper(single_pass(), POTENTIAL, MaxStrain(10.0, floor=3))
    first = list(simulate(stepper, band_scene, POTENTIAL, 3, metrics="none"))
    assert stepper.goal.floor < 3
    again = list(simulate(stepper, band_scene, POTENTIAL, 3, metrics="none"))
    assert [f.metrics.get("refine_iterations") for f in first] == [f.metrics.get("refine_iterations") for f in again]
    assert torch.equal(first[-1].world_pos, again[-1].world_pos)


def test_a_network_that_fails_is_left_alone(band_scene: Scene) -> None:
    broken = single_pass()
    for parameter in broken.parameters():
        parameter.data.fill_(torch.nan)
    metrics = one_step(RefinedStepper(broken, POTENTIAL, Count(3)), band_scene)[1].metrics
    assert metrics["refine_iterations"] == 0


def test_models_that_keep_their_relaxing_step_keep_it_as_it_is(band_scene: Scene) -> None:
    plain = start_state(reference("postcvpr"), band_scene, POTENTIAL, 1)
    refined = start_state(RefinedStepper(reference("postcvpr"), POTENTIAL, Count(4)), band_scene, POTENTIAL, 1)
    assert torch.equal(plain.pos, refined.pos)
    assert torch.equal(plain.vel, refined.vel)


def test_names_and_choices() -> None:
    inner = single_pass()
    stepper = RefinedStepper(inner, POTENTIAL, TargetResidual(0.1))
    assert stepper.times == ("search", "features", "network", "refine", "rest", "total")
    assert unrefined(stepper) is inner
    assert unrefined(inner) is inner
    with pytest.raises(ValueError, match="method is 'jacobi'"):
        RefinedStepper(inner, POTENTIAL, Count(1), "jacobi")


def test_values_of_every_vertex(band_scene: Scene) -> None:
    """What is exported adds up to the relative gradient, whatever else is measured, and changes nothing."""
    for metrics in ("all", "none"):
        frames: list[Frame] = list(simulate(single_pass(), band_scene, POTENTIAL, 3, metrics=metrics, fields=("rg",)))
        assert bool(frames[0].fields["rg"].isnan().all())
        free, mass = band_scene.cloth.free, band_scene.cloth.mass
        for frame in frames[1:]:
            values = frame.fields["rg"]
            assert values.dtype == torch.float32
            assert float(values[~free].abs().max()) == 0
            if metrics == "all":
                mean_sq = ((values * mass)[free] ** 2).sum() / (mass[free] ** 2).sum()
                assert float(mean_sq.sqrt()) == pytest.approx(frame.metrics["relative_gradient"], rel=1e-4)
        plain = list(simulate(single_pass(), band_scene, POTENTIAL, 3, metrics=metrics))
        assert all(torch.equal(a.world_pos, b.world_pos) for a, b in zip(plain, frames, strict=True))
        assert plain[-1].fields == {}
    with pytest.raises(ValueError, match="export holds 'phi'"):
        next(simulate(single_pass(), band_scene, POTENTIAL, 3, fields=("phi",)))

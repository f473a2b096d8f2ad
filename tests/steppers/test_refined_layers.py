"""Refinement keeps layers of cloth apart, wherever the network that it starts from has led them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier
from hood.mesh.penetration.crossing import self_crossings
from hood.scene.scene import RELAXING_DT
from hood.solver.derivatives.self_contact import approached, layers_of
from hood.solver.newton import first_guess
from hood.solver.step_figures import strain_metrics
from hood.steppers.network import NetworkStepper, Prediction, build_simulator
from hood.steppers.protocol import Relaxing
from hood.steppers.refined import GuessStepper, RefinedStepper
from hood.steppers.stopping import Count, MaxStrain
from hood.testing import grid, make_problem

pytestmark = pytest.mark.usefixtures("compiled_layers")

POTENTIAL = default_potential().with_terms(layers=LayerBarrier())


def sheets(pinned: bool = False, dt: float = 1 / 30) -> StepProblem:
    """A sheet 1 cm over another one, one half on its way through it; its corners may be held. In float64."""
    pos, faces = grid(9, 9, 0.3)
    rest, both = np.concatenate([pos, pos]), np.concatenate([faces, faces + len(pos)])
    held = np.zeros(len(rest), dtype=bool)
    held[[81, 89, 153, 161]] = pinned
    cloth = build_cloth(rest, both, Material(), pinned=held, dtype=torch.float64)
    down = np.zeros_like(rest)
    down[len(pos) :, 1] = np.where(pos[:, 0] > 0.15, -0.9, 0.0)
    problem = make_problem(cloth, np.concatenate([pos, pos + [0.013, 0.01, 0.008]]), down, dt=dt)
    return replace(problem, step=replace(problem.step, pin_target=problem.state.pos)) if pinned else problem


def wild(**options: object) -> NetworkStepper:
    """A network with random weights that throws vertices about by centimetres."""
    torch.manual_seed(0)
    arguments = {"features": "physical", "output": "velocity_base", "output_scale": 0.02, "latent_dim": 8, **options}
    return build_simulator(schedule="1x(mesh+coarse0)", **arguments).eval()


def crossings(problem: StepProblem, pos: torch.Tensor) -> int:
    """Pairs of triangles that pass through each other."""
    return len(self_crossings(pos.double().numpy(), problem.cloth.faces.numpy()))


def under(pos: torch.Tensor) -> int:
    """Vertices of the upper sheet below all of the lower one around them."""
    lower, upper = pos[:81], pos[81:]
    near = torch.cdist(upper[:, [0, 2]], lower[:, [0, 2]]) < 0.04
    least = torch.where(near, lower[:, 1], torch.inf).amin(dim=1)
    return int((upper[:, 1] < least - 1e-3).sum())


@pytest.mark.parametrize("iterations", [0, 1, 5])
@pytest.mark.parametrize("pinned", [False, True])
def test_a_prediction_through_cloth_is_refined_from_this_side_of_it(iterations: int, pinned: bool) -> None:
    problem = sheets(pinned)
    stepper = RefinedStepper(wild(), POTENTIAL, Count(iterations))
    alone = RefinedStepper(wild(), default_potential(), Count(0))
    prepared = stepper.prepare(problem.cloth, problem.cloth.rest_pos.numpy())
    assert crossings(problem, problem.state.pos) == 0
    through = alone.predict(problem, prepared).next_pos
    assert crossings(problem, through) > 10
    assert under(through) > 20
    prediction = stepper.predict(problem, prepared)
    assert crossings(problem, prediction.next_pos) == under(prediction.next_pos) == 0
    torch.testing.assert_close(prediction.acc, problem.acceleration(prediction.next_pos), rtol=1e-6, atol=1e-6)
    if pinned:
        held = problem.cloth.pinned
        assert torch.equal(prediction.next_pos[held], problem.state.pos[held])


@pytest.mark.parametrize("iterations", [0, 1, 5])
def test_a_guess_through_cloth_is_refined_from_this_side_of_it(iterations: int) -> None:
    """Where a step begins apart, the way to the guess itself is not looked at, but to where the refinement ends."""
    problem = sheets()
    known = POTENTIAL.prepare(problem)
    through, there = (first_guess(POTENTIAL, known, crossing=crossing)[0] for crossing in (True, False))
    assert crossings(problem, through) > 10
    assert crossings(problem, there) == under(there) == 0
    alone = GuessStepper(POTENTIAL)
    assert torch.equal(alone.predict(known, None).next_pos, there)
    stepper = RefinedStepper(alone, POTENTIAL, Count(iterations))
    prediction = stepper.predict(problem, stepper.prepare(problem.cloth, problem.cloth.rest_pos.numpy()))
    assert crossings(problem, prediction.next_pos) == under(prediction.next_pos) == 0
    assert not alone.crossing


def test_a_refined_guess_on_a_free_way_takes_one_search_for_near_cloth() -> None:
    problem = sheets()
    problem = replace(problem, state=replace(problem.state, vel=0.0 * problem.state.vel))
    stepper = RefinedStepper(GuessStepper(POTENTIAL), POTENTIAL, Count(3))
    known = stepper.search(problem)
    stepper.predict(known, stepper.prepare(problem.cloth, problem.cloth.rest_pos.numpy()))
    assert known.layers[0].layers.work.searches == 1


@pytest.mark.parametrize("floor", [0, 2])
def test_a_goal_of_strain_sees_the_cloth_on_this_side_of_cloth(floor: int) -> None:
    """One sheet shifted through the other is not strained; on this side of it, it is, and beyond the limit."""
    problem = sheets()
    shifted = problem.state.pos.clone()
    shifted[81:, 1] -= 0.02

    class Through(GuessStepper):
        def predict(self, problem: StepProblem, prepared: None, watch: object = None) -> Prediction:
            return Prediction(shifted, problem.acceleration(shifted))

    known = POTENTIAL.prepare(problem)
    there = approached(layers_of(POTENTIAL, known), shifted)
    strains = [strain_metrics(problem.cloth, pos)["strain_p99"] for pos in (shifted, there)]
    assert strains[0] < 0.5 * strains[1]
    stepper = RefinedStepper(Through(POTENTIAL), POTENTIAL, MaxStrain(0.75 * strains[1], floor=floor))
    prediction = stepper.predict(problem, stepper.prepare(problem.cloth, problem.cloth.rest_pos.numpy()))
    assert prediction.metrics["refine_iterations"] > 0
    assert crossings(problem, prediction.next_pos) == 0


def test_several_steps_in_a_row_stay_apart() -> None:
    problem = sheets()
    stepper = RefinedStepper(wild(), POTENTIAL, Count(5))
    prepared = stepper.prepare(problem.cloth, problem.cloth.rest_pos.numpy())
    for _ in range(4):
        prediction = stepper.predict(problem, prepared)
        assert crossings(problem, prediction.next_pos) == 0
        state = replace(problem.state, pos=prediction.next_pos, vel=stepper.next_velocity(problem, prediction))
        problem = replace(problem, state=state)


def test_a_relaxing_step_that_is_not_refined_ends_before_the_cloth_as_well() -> None:
    problem = sheets(dt=RELAXING_DT)
    inner = wild(velocity="carried", frame_dt=1 / 30)
    assert inner.relaxing is Relaxing.CARRY
    stepper, alone = (RefinedStepper(inner, potential, Count(5)) for potential in (POTENTIAL, default_potential()))
    prepared = stepper.prepare(problem.cloth, problem.cloth.rest_pos.numpy())
    assert crossings(problem, alone.predict(problem, prepared).next_pos) > 10
    assert crossings(problem, stepper.predict(problem, prepared).next_pos) == 0


@pytest.mark.parametrize("iterations", [0, 5])
def test_a_network_is_shown_held_vertices_where_they_can_come_to(iterations: int) -> None:
    """The middles of both sheets are held, and the upper one's should go through the lower one's."""
    problem = sheets()
    middle = torch.tensor([30, 31, 32, 39, 40, 41, 48, 49, 50])
    held, target = torch.zeros(162, dtype=torch.bool), problem.state.pos.clone()
    held[middle], held[81 + middle] = True, True
    target[81 + middle, 1] -= 0.03
    cloth, step = replace(problem.cloth, pinned=held), replace(problem.step, pin_target=target)
    problem = replace(problem, cloth=cloth, step=step)
    stepper = RefinedStepper(wild(), POTENTIAL, Count(iterations))
    prepared = stepper.prepare(problem.cloth, problem.cloth.rest_pos.numpy())
    known = stepper.search(problem)
    prediction = stepper.predict(known, prepared)
    assert known.step.pin_target is not None
    assert torch.equal(prediction.next_pos[held], known.step.pin_target[held])
    assert float((prediction.next_pos - target)[held].norm(dim=1).min()) > 5e-3
    assert crossings(problem, prediction.next_pos) == under(prediction.next_pos) == 0
    # What has been prepared is not prepared again: the same step as from the bare problem.
    assert torch.equal(stepper.predict(problem, prepared).next_pos, prediction.next_pos)

"""The potential that a network's features look at is that of the rollout, or of the training."""

from __future__ import annotations

import pytest
import torch
from small_simulators import make
from torch import Tensor

from hood.assets.files.library import locate
from hood.energies.mass_points import Gravity
from hood.energies.potential import Potential, default_potential, reference_potential
from hood.energies.problem import StepProblem
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import NetworkStepper
from hood.steppers.refined import GuessStepper, RefinedStepper
from hood.steppers.static_shapes.simulator import CapturedSimulator, network_of
from hood.steppers.stopping import Count

LOOKING = {
    "physical": {},
    "local": {"features": "local", "output": "local_steps"},
    "passes": {"features": "local", "output": "local_steps", "schedule": "1x(mesh+coarse0) | 1x(mesh)"},
    "global": {"features": "local", "output": "global_steps", "schedule": "1x(mesh+coarse0) | 1x(mesh)"},
}
#: Contact from 1 cm on: cloth that starts at 2 mm is in contact, and friction acts.
SLIPPERY, ROUGH = (default_potential(collision_epsilon=1e-2, friction_coefficient=mu) for mu in (0.0, 10.0))

#: The same with contact of two stiffnesses: a base that sticks to the skin feels that, and no friction.
SOFT, HARD = (default_potential(collision_epsilon=1e-2, collision_weight=weight) for weight in (5e4, 5e5))


def simulator_of(kind: str) -> NetworkStepper:
    return make("physical", **LOOKING[kind]) if kind in LOOKING else make(kind)


def last_pos(simulator: NetworkStepper, scene: Scene, potential: Potential) -> Tensor:
    """(V, 3) m after three steps."""
    return list(simulate(simulator, scene, potential, 4))[-1].world_pos


class Breeze(Gravity):
    """A term without written-out derivatives."""


@pytest.mark.parametrize("kind", LOOKING)
def test_a_rollout_moves_by_the_potential_it_is_measured_with(kind: str, tank_scene: Scene) -> None:
    simulator = simulator_of(kind)
    assert simulator.looks_at_potential
    soft, hard = (last_pos(simulator, tank_scene, potential) for potential in (SOFT, HARD))
    assert float((soft - hard).norm(dim=1).max()) > 1e-6
    assert torch.equal(last_pos(simulator, tank_scene, SOFT), soft)  # nothing of the other one is left


def test_the_shipped_networks_feel_friction(tank_scene: Scene) -> None:
    simulator = load_simulator(locate("weights", "small-ours"))
    slippery, rough = (last_pos(simulator, tank_scene, potential) for potential in (SLIPPERY, ROUGH))
    assert float((slippery - rough).norm(dim=1).max()) > 1e-4


@pytest.mark.parametrize("kind", ["paper", "base"])
def test_the_papers_features_look_at_no_potential(kind: str, tank_scene: Scene) -> None:
    simulator = simulator_of(kind)
    assert not simulator.looks_at_potential
    simulator.use_potential(SLIPPERY.with_terms(breeze=Breeze()))  # none of their business
    problem = step_of(tank_scene, simulator)
    prepared = simulator.prepare(tank_scene.cloth, tank_scene.garment.rest_pos)
    steps = []
    for potential in (SLIPPERY, ROUGH):
        simulator.use_potential(potential)
        steps.append(simulator.predict(problem, prepared).next_pos)
    assert torch.equal(*steps)


@pytest.mark.parametrize("kind", LOOKING)
def test_the_default_potential_is_what_it_is_without_one(kind: str, tank_scene: Scene) -> None:
    simulator = simulator_of(kind)
    problem, prepared = step_of(tank_scene, simulator), simulator.prepare(tank_scene.cloth, tank_scene.garment.rest_pos)
    before = simulator.predict(problem, prepared).next_pos
    simulator.use_potential(default_potential())
    assert torch.equal(simulator.predict(problem, prepared).next_pos, before)


@pytest.mark.parametrize("kind", LOOKING)
def test_terms_that_ask_for_more_than_contact_get_it(kind: str, tank_scene: Scene) -> None:
    simulator = simulator_of(kind)
    reference = last_pos(simulator, tank_scene, reference_potential())
    assert bool(torch.isfinite(reference).all())
    assert float((reference - last_pos(simulator, tank_scene, default_potential())).norm(dim=1).max()) > 1e-6


def test_a_copy_looks_at_the_same_potential(tank_scene: Scene) -> None:
    simulator = simulator_of("passes")
    simulator.use_potential(ROUGH)
    problem, prepared = step_of(tank_scene, simulator), simulator.prepare(tank_scene.cloth, tank_scene.garment.rest_pos)
    expected = simulator.predict(problem, prepared).next_pos
    assert torch.equal(simulator.clone().predict(problem, prepared).next_pos, expected)


def test_potentials_that_local_steps_cannot_tell_are_refused(tank_scene: Scene) -> None:
    simulator = simulator_of("local")
    with pytest.raises(ValueError, match=r"losses\.terms\.breeze is a Breeze: its second derivatives.*features=local"):
        next(simulate(simulator, tank_scene, default_potential().with_terms(breeze=Breeze())))
    weightless = default_potential()
    del weightless.terms["inertia"]
    with pytest.raises(ValueError, match=r"losses\.terms: no inertia"):
        simulator.use_potential(weightless)


def test_gradients_alone_serve_the_physical_features(tank_scene: Scene) -> None:
    """They ask for the residual, which every term has that can be differentiated."""
    simulator = simulator_of("physical")
    doubled = last_pos(simulator, tank_scene, default_potential().with_terms(breeze=Breeze()))
    assert float((doubled - last_pos(simulator, tank_scene, default_potential())).norm(dim=1).max()) > 1e-6


def test_the_network_behind_a_stepper() -> None:
    simulator, potential = make("paper"), default_potential()
    captured = CapturedSimulator(simulator, "fixed")
    refined = RefinedStepper(captured, potential, Count(1), "newton", NewtonSettings())
    assert network_of(simulator) is network_of(captured) is network_of(refined) is simulator
    assert network_of(GuessStepper(potential)) is None


def test_settings_tell_potentials_apart() -> None:
    default = default_potential().settings
    assert default == default_potential().settings
    assert default["friction"] | {"coefficient": 10.0, "epsilon": 1e-2} == ROUGH.settings["friction"]
    assert default["collision"] == {
        "term": "Collision",
        "weight": 5e5,
        "epsilon": 2e-3,
        "contact": "vertices",
        "sides": "both",
        "reach": "curvature",
    }
    assert reference_potential().settings["collision"]["term"] != default["collision"]["term"]


def step_of(scene: Scene, simulator: NetworkStepper) -> StepProblem:
    state = scene.start(2)
    return StepProblem(scene.cloth, state, scene.step_input(2, state), gravity=simulator.gravity)

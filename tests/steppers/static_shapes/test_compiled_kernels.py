"""Simulators by compiled kernels: which steps may be taken so, and what a copy does."""

import pytest
import torch

from hood.energies.problem import StepProblem
from hood.model.graph.static_shapes import Capacity
from hood.model.kernels.block import check_kernels
from hood.scene.scene import Scene
from hood.steppers.network import build_simulator
from hood.steppers.static_shapes.simulator import CapturedSimulator


def reason() -> str:
    """Why this machine cannot have them; empty where it can."""
    try:
        check_kernels("compiled", "fp32", 64)
    except ValueError as error:
        return str(error)
    return ""


REASON = reason()
pytestmark = pytest.mark.skipif(bool(REASON), reason=REASON)


@pytest.mark.parametrize("kernels", ["compiled", "fused"])
def test_steps_of_any_shape_are_those_of_the_plain_network(kernels: str, skirt_scene: Scene) -> None:
    torch.manual_seed(0)
    simulator = build_simulator(schedule="2x(mesh+coarse0)", latent_dim=64).eval()
    state = skirt_scene.start(0)
    step = skirt_scene.step_input(0, state)
    prepared = simulator.prepare(skirt_scene.cloth, skirt_scene.garment.rest_pos)
    problem = StepProblem(skirt_scene.cloth, state, step, gravity=simulator.gravity)
    with torch.no_grad():
        plain = simulator.predict(problem, prepared).acc
        simulator.network.use_kernels(kernels)
        assert simulator.clone().network.kernels == kernels
        for stepper in (simulator, CapturedSimulator(simulator, "fixed")):
            found = stepper.predict(problem, prepared).acc
            assert not torch.equal(found, plain)
            assert float((found - plain).norm()) < 1e-5 * float(plain.norm())


def test_a_fixed_set_may_have_more_rows_than_there_are_nodes(skirt_scene: Scene) -> None:
    """Its spare node stands once for every place that is not taken, and places are as many as cloth vertices and one."""
    torch.manual_seed(0)
    simulator = build_simulator(schedule="2x(mesh+coarse0)", latent_dim=64).eval()
    state = skirt_scene.start(0)
    prepared = simulator.prepare(skirt_scene.cloth, skirt_scene.garment.rest_pos)
    problem = StepProblem(skirt_scene.cloth, state, skirt_scene.step_input(0, state), gravity=simulator.gravity)
    everywhere = Capacity(4000, skirt_scene.cloth.num_vertices + 1)
    with torch.no_grad():
        plain = simulator.predict(problem, prepared).acc
        simulator.network.use_kernels("fused")
        found = CapturedSimulator(simulator, "fixed", everywhere).predict(problem, prepared).acc
    assert float((found - plain).abs().max()) < 1e-5 * float(plain.abs().max())


def test_steps_that_are_traced_are_refused() -> None:
    simulator = build_simulator(schedule="1x(mesh)", latent_dim=64)
    simulator.network.use_kernels("compiled")
    with pytest.raises(ValueError, match="step=compiled compiles torch's operations and needs kernels=torch"):
        CapturedSimulator(simulator, "compiled")

"""Forces predicted, positions solved for: what the network's output does, and its gradient."""

from __future__ import annotations

from dataclasses import replace

import torch
from test_passes import step_of
from torch import Tensor

from hood.energies.potential import default_potential
from hood.model.readout.network_step import Dirichlet
from hood.model.readout.output import GlobalStepOutput
from hood.scene.scene import Scene
from hood.steppers.network import NetworkStepper, build_simulator


class Dense:
    """A matrix of our own: every vertex is coupled to all."""

    def solve(self, pos: Tensor, force: Tensor, damping: Tensor) -> Tensor:
        count = len(pos)
        matrix = 3.0 * torch.eye(count, dtype=pos.dtype) - torch.ones(count, count, dtype=pos.dtype) / count
        return torch.linalg.solve(matrix + torch.diag(damping), force)


def make(schedule: str = "1x(mesh+coarse0) | 1x(mesh)", output_init: float = 0.3) -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator("local", "global_steps", schedule, latent_dim=16, output_init=output_init)


def test_the_derivative_is_that_of_the_positions(band_scene: Scene) -> None:
    problem, _ = step_of(band_scene, make())
    problem = replace(problem, contact=None, cloth=replace(problem.cloth, mass=problem.cloth.mass.double()))
    last = problem.state.pos.double()
    output, held, force = GlobalStepOutput(), Dirichlet(problem.cloth.free, last), 1e-3 * torch.randn_like(last)

    def positions(raw: Tensor) -> Tensor:
        return output.positions(problem, raw, last, force, held, Dense())

    raw = torch.randn(len(last), output.width, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(positions, raw, fast_mode=True)


def test_without_a_network_it_goes_down_to_the_minimum(tank_scene: Scene) -> None:
    """As Newton's method does without a line search, once it knows what touches the body."""
    left = []
    for passes in (1, 5, 17):
        simulator = make(" | ".join(passes * ["1x(mesh)"]), output_init=0.0).eval()
        problem, prediction = step_of(tank_scene, simulator)
        gradient, _ = default_potential().gradient(problem, prediction.next_pos.detach())
        left.append(float((gradient * problem.cloth.free.unsqueeze(1)).norm()))
    assert left[1] < 0.3 * left[0]
    assert left[2] < 0.01 * left[1]


def test_every_pass_trains_every_parameter_of_its_own(band_scene: Scene) -> None:
    simulator = make()
    _, prediction = step_of(band_scene, simulator)
    assert len(prediction.early) == 1
    (prediction.early[0][0].square().sum() + prediction.next_pos.square().sum()).backward()
    assert [name for name, p in simulator.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_pins_are_where_they_are_held(band_scene: Scene) -> None:
    problem, prediction = step_of(band_scene, make())
    pinned = problem.cloth.pinned
    assert pinned.any()
    for pos in (prediction.early[0][0], prediction.next_pos):
        assert torch.equal(pos[pinned], problem.step.pin_target[pinned])

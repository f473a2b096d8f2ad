"""Models of several passes: each pass answers for its own correction, and nothing depends on names or places."""

from dataclasses import replace

import pytest
import torch

from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.scene.scene import Scene
from hood.steppers.checkpoint import load_simulator, save_simulator
from hood.steppers.network import NetworkStepper, Prediction, build_simulator

SCHEDULE = "1x(mesh+coarse0) 1x(coarse0) | 1x(mesh+coarse0) | 1x(mesh)"


def make(schedule: str = SCHEDULE) -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator("local", "local_steps", schedule, latent_dim=16, output_init=0.3)


def step_of(scene: Scene, simulator: NetworkStepper) -> tuple[StepProblem, Prediction]:
    state = scene.start(2)
    problem = StepProblem(scene.cloth, state, scene.step_input(2, state), gravity=simulator.gravity)
    problem = default_potential().prepare(problem)
    return problem, simulator.predict(problem, simulator.prepare(scene.cloth, scene.garment.rest_pos))


def test_forces_are_those_of_the_positions_after_a_pass(band_scene: Scene) -> None:
    problem, prediction = step_of(band_scene, make())
    assert len(prediction.early) == 2
    for pos, force in prediction.early:
        gradient, _ = default_potential().gradient(problem, pos.detach())
        gradient = gradient * band_scene.cloth.free.unsqueeze(1)
        assert float((force + gradient).norm() / gradient.norm()) < 1e-4
        assert torch.equal(pos[band_scene.cloth.pinned], problem.step.pin_target[band_scene.cloth.pinned])
    assert torch.equal(prediction.next_pos[band_scene.cloth.pinned], problem.step.pin_target[band_scene.cloth.pinned])


def test_no_pass_ends_inside_the_body(tank_scene: Scene) -> None:
    problem, prediction = step_of(tank_scene, make())
    for pos in [pos for pos, _ in prediction.early] + [prediction.next_pos]:
        dist = problem.contact.next_dist(pos.detach())[problem.contact.valid]
        assert float(dist.min()) > 1e-3


def test_a_pass_answers_for_its_own_correction(band_scene: Scene) -> None:
    """Positions after a later pass start from those before it without a gradient: the first decoder has none from them."""
    simulator = make()
    _, prediction = step_of(band_scene, simulator)
    prediction.next_pos.sum().backward()
    assert simulator.network.decoder.third.weight.grad is None
    assert simulator.network.late_decoders[0].third.weight.grad is None
    assert simulator.network.late_decoders[1].third.weight.grad.any()
    assert simulator.network.steps[0].node_mlp.first.weight.grad.any()  # its latents are used by all passes


def test_every_pass_trains_every_parameter_of_its_own(band_scene: Scene) -> None:
    simulator = make()
    _, prediction = step_of(band_scene, simulator)
    (sum(pos.square().sum() for pos, _ in prediction.early) + prediction.next_pos.square().sum()).backward()
    without = [name for name, p in simulator.named_parameters() if p.grad is None]
    assert without == []


def test_place_in_the_world_does_not_matter(band_scene: Scene) -> None:
    simulator = make().eval()
    problem, prediction = step_of(band_scene, simulator)
    shift = torch.tensor([0.25, -0.5, 0.125])
    step, obstacle = problem.step, problem.step.obstacle
    moved = {name: getattr(obstacle, name) + shift for name in ("pos", "next_pos", "prev_pos")}
    there = StepProblem(
        problem.cloth,
        replace(problem.state, pos=problem.state.pos + shift),
        replace(step, obstacle=replace(obstacle, **moved), pin_target=step.pin_target + shift),
        gravity=simulator.gravity,
    )
    other = simulator.predict(there, simulator.prepare(band_scene.cloth, band_scene.garment.rest_pos))
    assert float((other.next_pos - shift - prediction.next_pos).detach().abs().max()) < 2e-5


def test_weights_travel(tmp_path, band_scene: Scene) -> None:
    simulator = make().eval()
    save_simulator(tmp_path / "m.safetensors", simulator)
    again = load_simulator(tmp_path / "m.safetensors").eval()
    assert again.config == simulator.config
    assert torch.equal(step_of(band_scene, again)[1].next_pos, step_of(band_scene, simulator)[1].next_pos)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("physical", "velocity_base", SCHEDULE), "several passes"),
        (("local", "velocity_base", "1x(mesh)"), "these features model.output=local_steps or global_steps"),
        (("physical", "local_steps", "1x(mesh)"), "velocity_base"),
        (("local", "local_steps", "1x(mesh) | | 1x(mesh)"), "pass 1 of 3 has no steps"),
    ],
)
def test_what_does_not_fit_together_is_refused(arguments, words) -> None:
    with pytest.raises(ValueError, match=words):
        build_simulator(*arguments)

"""Steps kept out of a rollout are those of the rollout, and keeping them changes nothing."""

from __future__ import annotations

import pytest
import torch

from hood.energies.potential import default_potential
from hood.evaluation.gap import StepSample
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene
from hood.steppers.network import Prediction, build_simulator


def test_kept_steps_are_the_rollouts(band_scene: Scene) -> None:
    torch.manual_seed(0)
    simulator = build_simulator("physical", "velocity_base", "1x(mesh)", latent_dim=4, output_init=0.1).eval()
    sample = StepSample(range(1, 8), 3)
    frames = list(simulate(simulator, band_scene, default_potential(), 8, observe=sample))
    plain = list(simulate(simulator, band_scene, default_potential(), 8))
    assert all(torch.equal(a.world_pos, b.world_pos) for a, b in zip(frames, plain, strict=True))
    assert len(sample.steps) == 3
    for index, (problem, prediction) in zip((2, 4, 6), sample.steps, strict=True):
        origin = problem.state.origin[0]
        assert torch.equal(problem.state.pos.double() + origin, frames[index - 1].world_pos)
        assert float((prediction.next_pos.double() + origin - frames[index].world_pos).abs().max()) < 1e-6


@pytest.mark.parametrize(
    "frames, count, wanted",
    [
        (range(3, 30), 5, {5, 11, 16, 21, 27}),
        (range(3, 6), 9, {3, 4, 5}),
        (range(3, 30), 1, {16}),
        (range(1, 9), 0, set()),
        (range(3, 3), 5, set()),
    ],
)
def test_states_spread_over_the_frames(frames: range, count: int, wanted: set[int]) -> None:
    assert StepSample(frames, count).wanted == wanted


def test_broken_steps_are_passed_over(band_scene: Scene) -> None:
    sample = StepSample(range(1, 3), 2)
    good, bad = torch.zeros(4, 3), torch.full((4, 3), float("nan"))
    sample(1, None, Prediction(bad, bad))  # type: ignore[arg-type]
    sample(2, None, Prediction(good, good))  # type: ignore[arg-type]
    assert len(sample.steps) == 1

"""The stepper without a network: converged steps, honest reports, the same interface as a simulator."""

from __future__ import annotations

import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.load import load_sequence
from hood.energies.potential import default_potential
from hood.rollouts.frame import metric_names
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import NewtonStepper


@pytest.fixture(scope="module")
def scene(body: Body, garments: dict[str, Garment]) -> Scene:
    return build_scene(garments["skirt"], body, load_sequence("walk_proud"))


def test_every_frame_is_a_converged_step(scene: Scene) -> None:
    potential = default_potential()
    stepper = NewtonStepper(potential, NewtonSettings(target_rg=1e-2))
    frames = list(simulate(stepper, scene, potential, 4))
    assert all(torch.isfinite(frame.world_pos).all() for frame in frames)
    for frame in frames[1:]:
        assert frame.metrics["solver_converged"] == 1.0
        assert frame.metrics["solver_iterations"] >= 1
        # The rollout's own measure, in float32, confirms what the solver says.
        assert frame.metrics["relative_gradient"] < 2e-2
        assert frame.metrics["energy_total"] < frame.metrics["energy_inertial_guess"]
        assert frame.metrics["penetration_count"] == 0
        assert set(frame.metrics) <= set(metric_names(potential, stepper))


def test_steps_that_miss_the_target_are_counted(scene: Scene) -> None:
    potential = default_potential()
    stepper = NewtonStepper(potential, NewtonSettings(target_rg=1e-9, max_iterations=1))
    last = list(simulate(stepper, scene, potential, 2, relaxing_steps=0))[-1]
    assert last.metrics["solver_converged"] == 0.0
    assert last.metrics["solver_iterations"] == 1.0


def test_pinned_vertices_reach_their_targets(scene: Scene) -> None:
    potential = default_potential()
    stepper = NewtonStepper(potential, NewtonSettings(max_iterations=2))
    frames = list(simulate(stepper, scene, potential, 3, relaxing_steps=0))
    pinned = scene.cloth.pinned
    origin = frames[-1].state.origin[0]
    target = scene.motion.skinned(scene.garment, 2, origin.numpy())[pinned].double() + origin
    torch.testing.assert_close(frames[-1].world_pos[pinned], target, atol=1e-6, rtol=0)

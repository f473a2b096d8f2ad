"""Rollouts under the energies of HOOD's published code: one extra search per step, the same network."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.energies import contact as collision
from hood.energies.potential import default_potential, reference_potential
from hood.energies.problem import StepProblem
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings
from hood.steppers.network import build_simulator
from hood.steppers.newton import NewtonStepper


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Number of points of every search for centroids so far."""
    calls: list[int] = []
    search = collision.find_centroid_contact

    def counted(contact, pos, *rest):  # type: ignore[no-untyped-def]
        calls.append(len(pos))
        return search(contact, pos, *rest)

    monkeypatch.setattr(collision, "find_centroid_contact", counted)
    return calls


def test_newton_takes_steps_with_one_search_each(tank_scene: Scene, searches: list[int]) -> None:
    potential = reference_potential()
    stepper = NewtonStepper(potential, NewtonSettings(target_rg=1e-2))
    frames = list(simulate(stepper, tank_scene, potential, num_frames=3))
    assert all(bool(torch.isfinite(frame.world_pos).all()) for frame in frames)
    assert [frame.metrics["solver_converged"] for frame in frames[1:]] == [1.0, 1.0]
    assert np.all([frame.metrics["relative_gradient"] < 3e-2 for frame in frames[1:]])
    assert searches == [tank_scene.cloth.num_vertices] * 3  # every step, the relaxing one included


def test_the_network_does_not_see_which_losses_are_used(tank_scene: Scene, searches: list[int]) -> None:
    torch.manual_seed(0)
    simulator = build_simulator(features="physical", output="velocity_base", latent_dim=8).eval()
    scene = tank_scene
    state = scene.start(3)
    step = scene.step_input(3, state)
    prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
    problem = simulator.search(StepProblem(scene.cloth, state, step))
    assert default_potential().prepare(problem) is problem
    assert searches == []
    with torch.no_grad():
        outputs = [simulator.predict(p, prepared).next_pos for p in (problem, reference_potential().prepare(problem))]
    assert torch.equal(*outputs)
    assert len(searches) == 1

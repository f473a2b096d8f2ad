"""Small simulators of every kind with random weights, and a step of theirs."""

from __future__ import annotations

import torch

from hood.cloth.state import State
from hood.scene.scene import Scene
from hood.steppers.network import NetworkStepper, build_simulator

SCHEDULE = "1x(mesh+coarse0) 1x(coarse0)"
KINDS = {
    "paper": {"features": "paper", "output": "acceleration"},
    "base": {"features": "paper", "output": "velocity_base"},
    "physical": {"features": "physical", "output": "velocity_base"},
    "edges": {"features": "physical", "output": "edges"},
}


def make(kind: str, seed: int = 0, **options: object) -> NetworkStepper:
    torch.manual_seed(seed)
    arguments = {"schedule": SCHEDULE, "latent_dim": 8, "output_init": 0.1, **KINDS[kind], **options}
    return build_simulator(**arguments).eval()


def take(simulator: NetworkStepper, scene: Scene, frame: int = 0) -> tuple[State, State]:
    """The start of ``scene`` and the state one step later."""
    with torch.no_grad():
        state = scene.start(frame)
        prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
        return state, simulator.step(scene.cloth, prepared, state, scene.step_input(frame, state))

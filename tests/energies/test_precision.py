"""Float32 energies 10 km from the world's origin, measured against float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import Cloth, build_cloth
from hood.cloth.state import State
from hood.energies.mass_points import Inertia
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential
from hood.scene.scene import recentre
from hood.testing import grid, make_problem

G = 9.81
FAR = torch.tensor([1e4 + 0.1371, -5e3 + 0.2345, 1e4 + 0.3777], dtype=torch.float64)


def local_state(world: torch.Tensor) -> State:
    """Float32 state of float64 world positions (V, 3), in the frame that a rollout keeps next to the cloth."""
    origin = world.mean(dim=0).round()
    state = State((world - origin).float(), torch.zeros(len(world), 3), origin.unsqueeze(0))
    return recentre(state, torch.zeros(len(world), dtype=torch.int64))


def membrane_force(cloth: Cloth, pos: torch.Tensor) -> torch.Tensor:
    return Potential({"stretching": Stretching()}).gradient(make_problem(cloth), pos)[0].double()


@pytest.mark.parametrize("edge, limit", [(1e-3, 1e-2), (1e-2, 1e-3), (1e-1, 1e-3)])
def test_membrane_forces_far_away(edge, limit):
    """Against the force at the state as it is stored, origin + pos; in world coordinates the error is 290 weights at 1 cm."""
    pos, faces = grid(21, 21, 20 * edge)
    pos[:, 1] = edge * np.sin(pos[:, 0] / edge / 2)
    single, double = (build_cloth(pos, faces, Material(), dtype=dtype) for dtype in (torch.float32, torch.float64))
    world = torch.as_tensor(pos) + FAR
    state = local_state(world)
    written = state.origin[0] + state.pos.double()
    assert float((written - world).abs().max()) < 1e-7
    weight = G * float(double.mass.median())
    error = membrane_force(single, state.pos) - membrane_force(double, written - state.origin[0])
    assert float(error.norm(dim=1).max()) < limit * weight
    naive = membrane_force(single, world.float()) - membrane_force(double, torch.as_tensor(pos))
    assert float(naive.norm(dim=1).max()) > 1000 * limit * weight


def test_inertia_of_a_given_acceleration_far_away():
    """To 1e-6 g at 1/240 s; second differences of world positions in float32 are off by g itself."""
    rng, dt = np.random.default_rng(0), 1 / 240
    pos, faces = grid(10, 10, 0.2)
    acc = torch.as_tensor(G * rng.normal(size=pos.shape))
    vel = torch.as_tensor(rng.normal(size=pos.shape))
    world = torch.as_tensor(pos) + FAR
    cloth = build_cloth(pos, faces, Material())
    state = replace(local_state(world), vel=vel.float())
    problem = make_problem(cloth, state.pos, state.vel, dt)
    next_pos = state.pos + dt * state.vel + dt * dt * acc.float()
    gradient, _ = Potential({"inertia": Inertia()}).gradient(problem, next_pos, acc.float())
    error = gradient.double() / cloth.mass.double()[:, None] - acc
    assert float(error.square().mean().sqrt()) < 1e-6 * G
    after, before = world + dt * vel + dt * dt * acc, world - dt * vel
    naive = (after.float() - 2 * world.float() + before.float()).double() / dt**2 - acc
    assert float(naive.square().mean().sqrt()) > 0.1 * G

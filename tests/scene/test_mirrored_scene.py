"""A mirrored scene is the mirror image of the scene in everything: starts, energies and forces."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.assets.body.body import Body
from hood.assets.garment.binding import bind_garment
from hood.assets.garment.garment import Garment
from hood.assets.garment.mirror import mirror_body, mirror_garment, reflect
from hood.assets.material import Material, sample_material
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.state import State
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.scene.scene import Scene, build_scene
from hood.training.scenes import SceneSampler


@pytest.fixture(scope="module", params=["tank", "skirt"])
def pair(request: pytest.FixtureRequest, body: Body, garments: dict[str, Garment], walk: PoseSequence) -> tuple[Scene, Scene]:
    """A scene of a lopsided body in the middle of a step and its image, in float64."""
    garment, window = bind_garment(garments[request.param], body), walk.window(60, 64)
    betas = np.random.default_rng(0).uniform(-2, 2, 10)
    material: Material = sample_material(np.random.default_rng(1), garment.rest_pos, 1.0)
    scene = build_scene(garment, body, window, material, betas, 1.05, torch.float64)
    image = build_scene(mirror_garment(garment), mirror_body(body), window, material, betas, 1.05, torch.float64)
    return scene, image


def pressed(pos: Tensor, seed: int) -> Tensor:
    """``pos`` with every vertex displaced by millimetres: in and out of the body, strained and bent."""
    return pos + torch.as_tensor(np.random.default_rng(seed).normal(scale=5e-3, size=pos.shape))


def test_starts_are_images(pair: tuple[Scene, Scene]) -> None:
    states = [scene.start(1) for scene in pair]
    torch.testing.assert_close(states[1].pos, reflect(states[0].pos), rtol=0, atol=1e-9)
    torch.testing.assert_close(states[1].vel, reflect(states[0].vel), rtol=0, atol=1e-9)
    torch.testing.assert_close(states[1].origin, reflect(states[0].origin), rtol=0, atol=0)


def test_energies_are_equal_and_forces_are_images(pair: tuple[Scene, Scene]) -> None:
    scene, image = pair
    state = scene.start(1)
    state = State(pressed(state.pos, 2), state.vel, state.origin)  # friction is that of contact at t
    mirrored = State(reflect(state.pos), reflect(state.vel), reflect(state.origin))
    next_pos = pressed(state.pos, 3)
    results = []
    for one, start, pos in ((scene, state, next_pos), (image, mirrored, reflect(next_pos))):
        potential = default_potential()
        problem = potential.prepare(StepProblem(one.cloth, start, one.step_input(1, start)).with_contact())
        results.append(potential.gradient(problem, pos))
    (force, energies), (image_force, image_energies) = results
    assert energies.keys() == image_energies.keys()
    assert float(energies["collision"]) > 0
    assert float(energies["friction"]) > 0
    for name, energy in energies.items():
        torch.testing.assert_close(image_energies[name], energy, rtol=1e-9, atol=1e-14, msg=name)
    torch.testing.assert_close(image_force, reflect(force), rtol=1e-8, atol=1e-9)
    # The comparison can fail: a force that was not reflected is far from its image.
    assert float((image_force - force).abs().max()) > 1e-3


def test_half_of_the_scenes_are_mirrored_and_nothing_else_changes(
    body: Body, garments: dict[str, Garment], walk: PoseSequence
) -> None:
    args = (body, [garments["tank"]], [walk])
    plain, mirroring = SceneSampler(*args, mirror=False), SceneSampler(*args)
    mirrored = 0
    for seed in range(40):
        one, other = (sampler.sample(np.random.default_rng(seed), 3) for sampler in (plain, mirroring))
        assert not one.mirrored
        mirrored += other.mirrored
        image = reflect(one.scene.cloth.rest_pos) if other.mirrored else one.scene.cloth.rest_pos
        assert torch.equal(other.scene.cloth.rest_pos, image)
        assert torch.equal(other.scene.cloth.vertex_fabric, one.scene.cloth.vertex_fabric)
        assert one.start_frame == other.start_frame
    assert 10 <= mirrored <= 30

"""Searches that begin with what the step before found give the frames of searches that begin with nothing, to the bit."""

from __future__ import annotations

import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import resample
from hood.energies.potential import default_potential
from hood.energies.self_contact import LayerBarrier
from hood.mesh.closest_point import tree as surface_tree
from hood.rollouts.loop import simulate
from hood.scene.scene import build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import NewtonStepper
from hood.testing import cylinder

pytestmark = pytest.mark.skipif(surface_tree.library() is None, reason="no C++ compiler")


@pytest.mark.parametrize("radius", [0.21, 0.45])
@pytest.mark.parametrize(
    ("motion", "first", "fps", "stiffer", "layered"),
    [("walk_proud", 60, 30.0, 1.0, False), ("plie", 20, 120.0, 1.0, True), ("dance_mixed", 100, 30.0, 20.0, False)],
)
def test_a_band_of_300_vertices_moves_the_same(
    radius: float, motion: str, first: int, fps: float, stiffer: float, layered: bool, body: Body
) -> None:
    pos, faces = cylinder(30, 10, radius, 0.2)
    usual = Material()
    fabric = Material(lame_mu=stiffer * usual.lame_mu, lame_lambda=stiffer * usual.lame_lambda)
    garment = Garment("band", pos, faces, pos[:, 1] > 0.099)
    sequence = resample(load_sequence(motion), fps).window(first, first + 6)
    scene = build_scene(garment, body, sequence, fabric)
    potential = default_potential()
    if layered:
        potential = potential.with_terms(layers=LayerBarrier())
    stepper = NewtonStepper(potential, NewtonSettings())
    surface_tree.forget_searches()
    remembered = list(simulate(stepper, scene, potential, 6, relaxing_steps=0, metrics="none"))
    assert any(scene.cloth.num_vertices in tree._near for _, _, tree in surface_tree._TREES)
    fresh = list(simulate(stepper, scene, potential, 6, relaxing_steps=0, metrics="none", afresh=True))
    assert all(torch.equal(one.world_pos, other.world_pos) for one, other in zip(remembered, fresh, strict=True))
    assert not torch.equal(fresh[0].world_pos, fresh[-1].world_pos)

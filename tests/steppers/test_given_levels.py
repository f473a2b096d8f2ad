"""Coarse levels that came with a garment are those the network works on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.scene.scene import build_scene
from hood.steppers.network import build_simulator
from hood.steppers.refined import prepare_stepper


def test_levels_of_the_garment_are_used(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    simulator = build_simulator(schedule="1x(mesh+coarse0)", latent_dim=2)
    tank = garments["tank"]
    own = prepare_stepper(simulator, build_scene(tank, body, walk.window(0, 3))).hierarchy.coarse_edges[0]
    levels = (np.array([[0, 5], [5, 9], [9, 3]]), np.array([[0, 9]]))
    given = prepare_stepper(simulator, build_scene(replace(tank, coarse_edges=levels), body, walk.window(0, 3)))
    assert len(given.hierarchy.coarse_edges) == simulator.num_coarse == 1
    np.testing.assert_array_equal(given.hierarchy.coarse_edges[0], [[0, 5], [3, 9], [5, 9]])
    assert len(own) > 100
    shallow = build_simulator(schedule="1x(mesh+coarse0) 1x(coarse0+coarse1) 1x(coarse1+coarse2)", latent_dim=2)
    assert shallow.num_coarse == 3
    computed = prepare_stepper(shallow, build_scene(replace(tank, coarse_edges=levels), body, walk.window(0, 3)))
    assert len(computed.hierarchy.coarse_edges) == 3


def test_levels_of_another_garment_are_refused(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    """Where the garment is given, and where a scene has one in the place of its own."""
    other = replace(garments["tank"], coarse_edges=(np.array([[0, 99999]]),))
    with pytest.raises(ValueError, match=r"garment 'tank': coarse edge 0 of level 0 is \[0, 99999\]"):
        build_scene(other, body, walk.window(0, 3))
    scene = replace(build_scene(garments["tank"], body, walk.window(0, 3)), garment=other)
    with pytest.raises(ValueError, match="99999"):
        prepare_stepper(build_simulator(schedule="1x(mesh+coarse0)", latent_dim=2), scene)

"""Outfits of which several garments are held."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.garment.outfit import join_garments
from hood.assets.motion.sequence import PoseSequence
from hood.scene.held_layers import MOST_MOVED, with_held_layers_apart
from hood.scene.scene import Scene, build_scene
from hood.scene.untangle import TangledError


def outfit(names: list[str], garments: dict[str, Garment], body: Body, sequence: PoseSequence) -> Scene:
    return build_scene(join_garments([garments[name] for name in names]), body, sequence, dtype=torch.float64)


def test_a_skirt_over_shorts_starts_apart(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    scene = outfit(["shorts", "skirt"], garments, body, walk)
    with pytest.raises(TangledError):
        scene.taken_apart(scene.start(thorough=True))
    with pytest.warns(UserWarning, match="the places at which 'skirt' is held are moved off the garment below by up to"):
        lifted = with_held_layers_apart(scene)
    _, found = lifted.taken_apart(lifted.start(thorough=True))
    assert found is not None
    assert found.after == 0
    assert found.stretch < 0.15
    # Held places alone have moved, by millimetres, and no rest shape has.
    moved = np.linalg.norm(lifted.garment.tpose(np.zeros(10)) - scene.garment.tpose(np.zeros(10)), axis=1)
    assert 1e-3 < moved.max() < MOST_MOVED
    assert not moved[~scene.garment.pinned].any()
    assert lifted.cloth is scene.cloth
    np.testing.assert_array_equal(lifted.motion.rest_pos(lifted.garment), scene.motion.rest_pos(scene.garment))
    # They follow the body: in every frame they are as far from where they were held before.
    late = walk.num_frames // 2
    origin = scene.motion.translation[late]
    now = lifted.motion.skinned(lifted.garment, late, origin) - scene.motion.skinned(scene.garment, late, origin)
    torch.testing.assert_close(now.norm(dim=1), torch.as_tensor(moved), rtol=0.1, atol=1e-9)


@pytest.mark.parametrize("names", [["skirt"], ["tank", "skirt"]])
def test_other_scenes_are_as_they_were(names: list[str], garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    scene = outfit(names, garments, body, walk)
    assert with_held_layers_apart(scene) is scene

"""Starts of garments that were made in another pose than the one they start in."""

from __future__ import annotations

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.garment.binding import bind_posed, posed_body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.sequence_edit import arms_down
from hood.scene.scene import build_scene
from hood.scene.worn import fit_figures


@pytest.mark.parametrize("name", ["tshirt", "dress"])
def test_a_garment_made_in_a_walk_starts_in_the_t_pose(
    garments: dict[str, Garment], body: Body, walk: PoseSequence, name: str
) -> None:
    """Settling as training does leaves it overstretched; a rollout's start brings it near its lengths, outside the body."""
    template = garments[name]
    state = build_scene(template, body, walk).start(37, relaxed=False)
    given = state.pos.double().numpy() + state.origin[0].numpy()
    mesh = Garment(name, given, template.faces, np.zeros(len(given), dtype=bool))
    scene = build_scene(bind_posed(mesh, posed_body(body, walk, 37, np.zeros(10))), body, arms_down(0.0))
    skinned, start = fit_figures(scene, settled=False), fit_figures(scene)
    assert skinned.stretch_max > 0.2
    assert start.stretch_max < 0.1
    assert start.depth_max < 2e-3
    plain = scene.start(0, relaxed=False).pos
    assert float((plain - scene.start(0, relaxed=False, thorough=True).pos).norm(dim=1).max()) > 1e-3


def test_nothing_changes_where_nothing_is_stretched(garments: dict[str, Garment], body: Body) -> None:
    scene = build_scene(garments["skirt"], body, arms_down(0.0))
    plain, thorough = (scene.start(0, relaxed=False, thorough=flag).pos for flag in (False, True))
    assert bool((plain == thorough).all())

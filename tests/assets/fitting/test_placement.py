"""Garment meshes are put where they belong on a body, or refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.assets.body.body import Body
from hood.assets.fitting.placement import surrounds
from hood.assets.garment.garment import Garment


@pytest.mark.parametrize("name", ["tank", "tshirt", "longsleeve", "dress", "skirt", "trousers", "shorts"])
def test_garments_surround_the_body_where_they_belong_and_nowhere_else(
    garments: dict[str, Garment], body: Body, name: str
) -> None:
    pos = garments[name].tpose(np.zeros(10))
    worn = surrounds(pos, body.v_template, body.faces)
    assert worn.problem is None
    assert worn.inside == 0.0
    assert worn.roundness > 0.9
    for shift, word in (([3.0, 0, 0], "away"), ([0, 0, 0.5], "away"), ([0, 0, 0.2], "one side")):
        assert word in str(surrounds(pos + shift, body.v_template, body.faces).problem)


def test_surrounding_does_not_depend_on_the_frame(garments: dict[str, Garment], body: Body) -> None:
    pos, turn = garments["tank"].tpose(np.zeros(10)) + [0.1, 0, 0], Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    here = surrounds(pos, body.v_template, body.faces)
    there = surrounds(pos @ turn.T + 2.0, body.v_template @ turn.T + 2.0, body.faces)
    np.testing.assert_allclose(there, here, atol=1e-9)
    assert here.inside > 0


def test_a_garment_in_the_body_is_said_to_be_inside(body: Body) -> None:
    middle = body.v_template.mean(axis=0)
    shrunk = middle + 0.9 * (body.v_template - middle)
    assert "inside" in str(surrounds(shrunk, body.v_template, body.faces).problem)

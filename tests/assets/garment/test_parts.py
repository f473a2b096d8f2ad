"""Parts of garments by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.garment.outfit import join_garments
from hood.assets.garment.parts import part_faces
from hood.assets.garment.pins import JOINTS


def test_above_and_below_a_joint_are_the_whole(garments: dict[str, Garment], body: Body) -> None:
    dress = garments["dress"]
    above, below = (part_faces(f"{side}_waistband", dress, body) for side in ("above", "below"))
    np.testing.assert_array_equal(above, ~below)
    height = body.shaped(np.zeros(0))[1][JOINTS.index("spine1"), 1]
    centres = dress.rest_pos[dress.faces, 1].mean(axis=1)
    assert centres[below].max() <= height < centres[above].min()
    np.testing.assert_array_equal(part_faces("above_spine1", dress, body), above)


def test_sleeves_lie_farther_out_than_the_shoulders(garments: dict[str, Garment], body: Body) -> None:
    shirt = garments["longsleeve"]
    both, left, right = (part_faces(name, shirt, body) for name in ("sleeves", "sleeve_left", "sleeve_right"))
    np.testing.assert_array_equal(both, left | right)
    assert not (left & right).any()
    centres = shirt.tpose(np.zeros(0))[shirt.faces].mean(axis=1)
    shoulder = body.shaped(np.zeros(0))[1][JOINTS.index("left_shoulder"), 0]
    assert centres[left, 0].min() > shoulder > 0 > -shoulder > centres[right, 0].max()
    assert 0.3 < both.mean() < 0.7
    with pytest.raises(ValueError, match="part 'sleeves': no face of garment 'skirt'"):
        part_faces("sleeves", garments["skirt"], body)


def test_garments_of_an_outfit(garments: dict[str, Garment]) -> None:
    outfit = join_garments([garments["tank"], garments["skirt"]])
    tank, skirt = (part_faces(name, outfit, None) for name in ("tank", "skirt"))
    np.testing.assert_array_equal(tank, np.arange(len(outfit.faces)) < len(garments["tank"].faces))
    np.testing.assert_array_equal(skirt, ~tank)
    assert part_faces("tank", garments["tank"], None).all()


def test_painted_and_listed_parts_are_the_faces_with_most_corners_there(tmp_path: Path, garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    inside = tank.rest_pos[:, 0] > 0
    expected = inside[tank.faces].sum(axis=1) >= 2
    painted = replace(tank, colours=np.where(inside[:, None], [0.1, 0.9, 0.2], [0.8, 0.8, 0.8]))
    np.testing.assert_array_equal(part_faces("green", painted, None), expected)
    (tmp_path / "left.txt").write_text(" ".join(map(str, np.flatnonzero(inside))))
    np.testing.assert_array_equal(part_faces(str(tmp_path / "left.txt"), tank, None), expected)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("sleeve", "garment 'tank': unknown part 'sleeve': did you mean 'sleeves'"),
        ("collar", "garment 'tank': unknown part 'collar'.*known are tank, above_JOINT"),
        ("below_wristband", "part 'below_wristband': unknown joint 'wristband': did you mean 'waistband'"),
        ("red", "part 'red': 'tank' has no vertex colours; paint the part"),
        ("above_head", "part 'above_head': no face of garment 'tank' is in it"),
    ],
)
def test_parts_that_a_garment_does_not_have(part: str, message: str, garments: dict[str, Garment], body: Body) -> None:
    with pytest.raises(ValueError, match=message):
        part_faces(part, garments["tank"], body)


def test_what_needs_more_says_so(tmp_path: Path, garments: dict[str, Garment]) -> None:
    with pytest.raises(ValueError, match="places of joints need a body with joints"):
        part_faces("above_waistband", garments["tank"], None)
    (tmp_path / "far.txt").write_text("5 99999")
    with pytest.raises(ValueError, match=r"far.txt: vertex 99999 of 1016"):
        part_faces(str(tmp_path / "far.txt"), garments["tank"], None)

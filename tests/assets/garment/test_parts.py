"""Parts of garments by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hood.assets.body.body import JOINTS, Body
from hood.assets.garment.garment import Garment
from hood.assets.garment.outfit import join_garments
from hood.assets.garment.parts import part_faces


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


def test_colours_of_an_image_are_the_faces_whose_centres_lie_there(tmp_path: Path, garments: dict[str, Garment]) -> None:
    from PIL import Image

    tank, path = garments["tank"], tmp_path / "map.png"
    assert tank.uv is not None
    assert tank.uv_faces is not None
    pixels = np.zeros((40, 30, 3), np.uint8)
    pixels[:30, :] = [255, 30, 40]  # the upper three quarters
    pixels[30:, 20:] = [10, 200, 30]
    pixels[30:, :20] = [250, 200, 60]  # none of the three
    Image.fromarray(pixels).save(path)
    u, v = tank.uv[tank.uv_faces].mean(axis=1).T
    upper = v % 1.0 > 0.25
    np.testing.assert_array_equal(part_faces(f"red@{path}", tank, None), upper)
    np.testing.assert_array_equal(part_faces(f"green@{path}", tank, None), ~upper & (u % 1.0 >= 2 / 3))
    assert 0 < upper.mean() < 1
    shifted = replace(tank, uv=tank.uv + [2.0, -3.0])
    np.testing.assert_array_equal(part_faces(f"red@{path}", shifted, None), upper)
    with pytest.raises(ValueError, match="no face of garment 'tank' is in it"):
        part_faces(f"blue@{path}", tank, None)
    bare = replace(garments["skirt"], uv=None, uv_faces=None)
    with pytest.raises(ValueError, match="garment 'skirt' has no texture coordinates"):
        part_faces(f"red@{path}", bare, None)
    Image.new("RGB", (2, 2), (255, 0, 0)).save(path)
    outfit = join_garments([tank, bare])
    np.testing.assert_array_equal(part_faces(f"red@{path}", outfit, None), part_faces("tank", outfit, None))


def test_images_that_cannot_be_used_are_refused(tmp_path: Path, garments: dict[str, Garment]) -> None:
    tank, path = garments["tank"], tmp_path / "map.png"
    for part, said in (
        (f"red@{path}", "no such file"),
        (f"rde@{path}", "did you mean 'red'"),
        (f"@{path}", "give COLOUR@IMAGE"),
    ):
        with pytest.raises(ValueError, match=said):
            part_faces(part, tank, None)
    path.write_text("no image")
    with pytest.raises(ValueError, match="neither PNG nor JPEG"):
        part_faces(f"red@{path}", tank, None)


def test_panels_count_before_other_parts(garments: dict[str, Garment], body: Body) -> None:
    shirt = garments["longsleeve"]
    front = shirt.rest_pos[shirt.faces, 2].mean(axis=1) > 0
    panelled = replace(shirt, panels={"front": front, "sleeve_left": ~front})
    np.testing.assert_array_equal(part_faces("front", panelled, None), front)
    np.testing.assert_array_equal(part_faces("sleeve_left", panelled, body), ~front)
    with pytest.raises(ValueError, match="unknown part 'frnt': did you mean 'front'"):
        part_faces("frnt", panelled, None)
    outfit = join_garments([panelled, garments["skirt"], replace(garments["tank"], panels={"front": np.arange(1901) < 5})])
    np.testing.assert_array_equal(part_faces("front", outfit, None)[: len(front)], front)
    assert part_faces("front", outfit, None).sum() == front.sum()
    np.testing.assert_array_equal(np.flatnonzero(part_faces("front_2", outfit, None)), len(outfit.faces) - 1901 + np.arange(5))


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

"""Tables of pins: weights, and what pins follow."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.garment.pins import PinGroup, pin_groups, pin_mask, pin_numbers


def only(pins: Any, garment: Garment, body: Body | None = None) -> PinGroup:
    (group,) = pin_groups(pins, garment, body)
    return group


def test_a_table_says_how_its_vertices_are_held(garments: dict[str, Garment], body: Body) -> None:
    tank = garments["tank"]
    group = only({"vertices": [5, 3, 9], "weights": [0.5, 1, 0.0], "follows": "spine1"}, tank)
    assert (group.vertices.tolist(), group.weights.tolist(), group.follows) == ([5, 3], [0.5, 1.0], "spine1")
    assert group.exact.tolist() == [False, True]
    region = only({"vertices": ["neckline", 7], "weights": 0.25, "follows": [1, 2, 3]}, tank, body)
    assert np.array_equal(np.sort(region.vertices), np.flatnonzero(pin_mask(["neckline", 7], tank, body)))
    assert set(region.weights.tolist()) == {0.25}
    assert (region.follows, region.whom) == ((1, 2, 3), "3 vertices of the body")
    plain = only({"vertices": 4}, tank)
    assert (plain.vertices.tolist(), plain.weights.tolist(), plain.follows) == ([4], [1.0], None)


def test_tables_and_words_together(garments: dict[str, Garment], body: Body) -> None:
    """Of a vertex in several groups the last counts; what springs hold is not pinned."""
    groups = pin_groups([1, 2, {"vertices": [2, 3], "weights": 0.5}, {"vertices": [3, 4]}], garments["tank"], body)
    assert [group.vertices.tolist() for group in groups] == [[1, 2], [2, 3], [3, 4]]
    mask = pin_mask([1, 2, {"vertices": [2, 3], "weights": 0.5}, {"vertices": [3, 4]}], garments["tank"], body)
    assert np.flatnonzero(mask).tolist() == [1, 3, 4]
    assert pin_groups("none", garments["tank"], body) == []


def test_files_of_one_table_or_of_several(garments: dict[str, Garment], tmp_path: Path) -> None:
    (tmp_path / "held.txt").write_text("7 8\n")
    one = {"vertices": str(tmp_path / "held.txt"), "weights": [0.1, 0.2], "follows": "skin"}
    for content in (one, [one]):
        (tmp_path / "pins.json").write_text(json.dumps(content))
        group = only(str(tmp_path / "pins.json"), garments["tank"])
        assert (group.vertices.tolist(), group.weights.tolist(), group.follows) == ([7, 8], [0.1, 0.2], "skin")
    (tmp_path / "pins.json").write_text(json.dumps([one, {"vertices": [1], "wieghts": 1}]))
    with pytest.raises(ValueError, match=r"pins.json: entry 1: unknown key 'wieghts': did you mean 'weights'\?"):
        pin_groups(str(tmp_path / "pins.json"), garments["tank"], None)
    (tmp_path / "pins.json").write_text("[3, 4]")
    assert only(str(tmp_path / "pins.json"), garments["tank"]).vertices.tolist() == [3, 4]


def test_painted_weights_are_how_red_vertices_are(garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    colours = np.ones((len(tank.rest_pos), 3))
    colours[[2, 5, 8], 1:] = np.array([0.0, 0.7, 0.4])[:, None]
    tank = replace(tank, colours=colours)
    group = only({"vertices": "painted", "weights": "painted"}, tank)
    assert group.vertices.tolist() == [2, 5, 8]
    np.testing.assert_allclose(group.weights, [1.0, 0.3, 0.6])
    assert only({"vertices": "painted"}, tank).vertices.tolist() == [2, 8]
    assert only({"vertices": "painted"}, tank).exact.all()
    assert only({"vertices": [5, 6], "weights": "painted"}, tank).vertices.tolist() == [5]


def test_vertices_that_repairs_removed_take_their_weights_along(garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    numbers = np.arange(len(tank.rest_pos) + 1) - 1  # the first of the file is gone
    group = only({"vertices": [0, 3], "weights": [0.2, 0.4]}, replace(tank, file_numbers=numbers))
    assert (group.vertices.tolist(), group.weights.tolist()) == ([2], [0.4])


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"vertices": [1, 2], "weights": [0.5]}, "1 weights of 2 vertices; give one for each, or one for all"),
        ({"vertices": [1, 2], "weights": [0.5, 1.5]}, "weights\\[1\\]: the weight 1.5 is none; give 0 \\(free\\) to 1"),
        ({"vertices": [1], "weights": -0.1}, "the weight -0.1 is none"),
        ({"vertices": [1], "weights": float("nan")}, "the weight nan is none"),
        ({"vertices": [1], "weights": "half"}, "the weight half is none"),
        ({"vertices": [1], "weights": True}, "the weight True is none"),
        ({"vertices": "neckline", "weights": [0.5]}, "a list of weights needs vertex numbers, not 'neckline'"),
        ({"vertices": [10**6], "weights": [0.5]}, "vertex 1000000 of 1016; they are numbered from 0"),
        ({"vertices": [-1]}, "vertex -1 of 1016"),
        ({"vertices": "knee"}, "unknown region 'knee'"),
        ({"vertices": "none"}, "vertices=none are none of 'tank'; name some, or leave the table out"),
        ({"vertices": {"a": 1}}, "vertices is {'a': 1}; give numbers, a region, painted or a list"),
        ({"follows": "skin"}, "vertices is None; give numbers, a region"),
        ({"vertices": [1], "follows": 3}, "follows is 3; give skin, a bone, a part of the body or a list of body vertices"),
        ({"vertices": [1], "follows": []}, "follows is \\[\\]; give skin"),
        ({"vertices": [1], "weights": "painted"}, "'tank' has no vertex colours; paint the held vertices red"),
    ],
)
def test_what_is_no_table_is_told(table: dict[str, Any], sentence: str, garments: dict[str, Garment], body: Body) -> None:
    with pytest.raises(ValueError, match=f"^pins: {sentence}"):
        pin_groups(table, garments["tank"], body)


def test_where_vertices_alone_are_meant_tables_are_refused() -> None:
    with pytest.raises(ValueError, match="^pins: tables of weights and of what pins follow are for pins= of hood rollout"):
        pin_numbers([1, {"vertices": [1]}])

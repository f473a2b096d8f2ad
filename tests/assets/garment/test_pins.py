"""Held vertices by number, opening, colour and list."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.files.text import read_indices
from hood.assets.garment.garment import Garment
from hood.assets.garment.pins import opening_names, pin_mask
from hood.mesh import topology


def test_the_waistband_of_the_skirt_is_what_it_is_held_by(garments: dict[str, Garment], body: Body) -> None:
    skirt = garments["skirt"]
    mask = pin_mask("waistband", skirt, body)
    assert mask.sum() > 20
    # The template holds its waistband, some of it more than a loop wide.
    assert (skirt.pinned[mask]).mean() > 0.9


def test_openings_of_a_shirt(garments: dict[str, Garment], body: Body) -> None:
    shirt = garments["longsleeve"]
    loops = [set(loop.tolist()) for loop in topology.boundary_loops(shirt.faces)]
    masks = {name: pin_mask(name, shirt, body) for name in ("neckline", "cuff_left", "cuff_right", "hem")}
    found = [frozenset(np.flatnonzero(mask).tolist()) for mask in masks.values()]
    assert len(set(found)) == 4
    assert all(set(loop) in loops for loop in found)
    assert shirt.rest_pos[masks["cuff_left"], 0].min() > 0.3 > -0.3 > shirt.rest_pos[masks["cuff_right"], 0].max()
    assert shirt.rest_pos[masks["neckline"], 1].min() > shirt.rest_pos[masks["hem"], 1].max()
    np.testing.assert_array_equal(pin_mask("left_wrist", shirt, body), masks["cuff_left"])


def test_names_of_openings(garments: dict[str, Garment], body: Body) -> None:
    """Below the hips is a hem, whatever joint is nearest; one opening at most is the waistband."""
    joints = body.shaped(np.zeros(10))[1]
    expected = {
        "skirt": ["hem", "waistband"], "shorts": ["hem", "hem", "waistband"],
        "trousers": ["hem_left", "hem_right", "waistband"], "dress": ["armhole_left", "armhole_right", "hem", "neckline"],
        "tank": ["armhole_left", "armhole_right", "hem", "neckline"],
    }  # fmt: skip
    for name, regions in expected.items():
        garment = garments[name]
        centres = [garment.rest_pos[loop].mean(axis=0) for loop in topology.boundary_loops(garment.faces)]
        assert sorted(opening_names(np.stack(centres), joints)) == regions, name
    # A sash around the waist has two openings above the hips: the lower edge is its hem.
    assert opening_names(joints[3] + [[0.0, 0.02, 0.0], [0.0, -0.06, 0.0]], joints) == ["waistband", "hem"]
    with pytest.raises(ValueError, match="no opening of 'dress' is a waistband: they are at the heights"):
        pin_mask("waistband", garments["dress"], body)


def test_lists_numbers_and_words_add_up(tmp_path: Path, garments: dict[str, Garment], body: Body) -> None:
    tank = garments["tank"]
    (tmp_path / "held.txt").write_text("# hem\n7, 8\n9 10  # end\n")
    (tmp_path / "held.json").write_text("[11, 12]")
    mask = pin_mask([3, "4", str(tmp_path / "held.txt"), str(tmp_path / "held.json")], tank, None)
    np.testing.assert_array_equal(np.flatnonzero(mask), [3, 4, 7, 8, 9, 10, 11, 12])
    both = pin_mask([3, "neckline"], tank, body)
    np.testing.assert_array_equal(both, pin_mask(3, tank, body) | pin_mask("neckline", tank, body))
    assert not pin_mask("none", tank, None).any()


def test_painted_vertices(garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    colours = np.full((len(tank.rest_pos), 3), 0.8)
    colours[[5, 6]] = [1.0, 0.1, 0.2]
    colours[7] = [1.0, 0.9, 0.2]
    mask = pin_mask("painted", replace(tank, colours=colours), None)
    np.testing.assert_array_equal(np.flatnonzero(mask), [5, 6])


REFUSED = {
    "region": ("wasteband", "did you mean 'waistband'"),
    "far": ("hem_left", "openings of 'tank' is"),
    "number": (10**6, "vertex 1000000 of 1016"),
    "unpainted": ("painted", "no vertex colours"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(garments: dict[str, Garment], body: Body, case: str) -> None:
    pins, words = REFUSED[case]
    with pytest.raises(ValueError, match=words):
        pin_mask(pins, garments["tank"], body)


def test_regions_need_a_body_and_an_opening(garments: dict[str, Garment], body: Body) -> None:
    with pytest.raises(ValueError, match="regions need a body"):
        pin_mask("neckline", garments["tank"], None)
    closed = Garment("ball", body.v_template, body.faces, np.zeros(len(body.v_template), dtype=bool))
    with pytest.raises(ValueError, match="is closed"):
        pin_mask("neckline", closed, body)


@pytest.mark.parametrize("text", ["[1, 2.5]", "{}", "[true]", "[1", '"12"', "[" * 5000])
def test_broken_lists_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "held.json").write_text(text)
    with pytest.raises(ValueError, match=r"held\.json: not a list of vertex numbers"):
        read_indices(tmp_path / "held.json")

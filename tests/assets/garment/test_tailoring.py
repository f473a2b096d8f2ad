"""Parts of a garment cut larger or smaller."""

from __future__ import annotations

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.garment.outfit import join_garments
from hood.assets.garment.parts import lengths_of, part_faces, tailored
from hood.mesh.topology import unique_edges


def test_all_of_a_garment_larger_is_the_garment_scaled(garments: dict[str, Garment]) -> None:
    dress = garments["dress"]
    larger = tailored(dress, {"dress": 1.2})
    edges = unique_edges(dress.faces)
    before, after = (np.linalg.norm(g.rest_pos[edges[:, 0]] - g.rest_pos[edges[:, 1]], axis=1) for g in (dress, larger))
    np.testing.assert_allclose(after, 1.2 * before, rtol=1e-4)
    np.testing.assert_array_equal(larger.tpose(np.zeros(0)), dress.tpose(np.zeros(0)))  # worn where it was


def test_sleeves_grow_and_the_trunk_stays(garments: dict[str, Garment], body: Body) -> None:
    shirt = garments["longsleeve"]
    wide = tailored(shirt, {"sleeves": 1.2}, body)
    assert lengths_of(shirt, wide, "sleeves", body) == pytest.approx(1.2, abs=0.02)
    assert lengths_of(shirt, wide, "below_spine2", body) == pytest.approx(1.0, abs=0.005)
    cuffs = np.abs(shirt.rest_pos[:, 0]) > 0.95 * np.abs(shirt.rest_pos[:, 0]).max()
    moved = np.abs(wide.rest_pos[cuffs, 0]) - np.abs(shirt.rest_pos[cuffs, 0])
    assert moved.min() > 0.04  # the sleeves are longer on both sides


def test_the_last_of_parts_that_overlap_counts(garments: dict[str, Garment], body: Body) -> None:
    dress = garments["dress"]
    one = tailored(dress, {"below_waistband": 0.8, "dress": 1.1}, body)
    other = tailored(dress, {"dress": 1.1})
    np.testing.assert_array_equal(one.rest_pos, other.rest_pos)


def test_a_piece_of_an_outfit_is_cut_alone(garments: dict[str, Garment]) -> None:
    outfit = join_garments([garments["tank"], garments["skirt"]])
    cut = tailored(outfit, {"skirt": 0.9})
    tank = np.unique(outfit.faces[part_faces("tank", outfit, None)])
    np.testing.assert_allclose(cut.rest_pos[tank], outfit.rest_pos[tank], atol=1e-9)
    assert lengths_of(outfit, cut, "skirt") == pytest.approx(0.9, abs=1e-4)

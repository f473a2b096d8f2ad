"""Fronts that open: what is cut, what closes it, what lies below; collars and lapels that are sewn on turned down."""

from __future__ import annotations

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.garment.fasteners import ROOM
from hood.assets.pattern.designs import draft
from hood.assets.pattern.fronts import CLOSURES, opened
from hood.assets.pattern.measures import Measures, measure_body
from hood.assets.pattern.sheet import PatternSheet, sheet_of
from hood.mesh import topology

_EDGE = 0.03


@pytest.fixture(scope="module")
def measures(body: Body) -> Measures:
    vertices, joints = body.shaped(np.zeros(1))
    return measure_body(vertices, body.faces, joints)


def _flat_area(sheet: PatternSheet) -> float:
    return 0.5 * float(np.abs(np.linalg.det(sheet.flat[:, 1:] - sheet.flat[:, :1])).sum())


@pytest.mark.parametrize(("name", "row"), [("blouse", "front_buttons"), ("bomber", "front_zip"), ("blazer", "front_buttons")])
def test_a_front_is_cut_open_and_closed_again(name: str, row: str, measures: Measures) -> None:
    sheet = sheet_of(draft(name, measures), _EDGE, name)
    cut, pos, before = opened(sheet, sheet.pos)
    assert list(cut.rows) == [row]
    half = cut.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(half, axis=0)) == len(half)  # one sheet, wound alike
    assert len(np.unique(topology.connected_components(len(pos), topology.unique_edges(cut.faces)))) == 1
    # Neck, front and hem are one opening beside the sleeves; closed, there are two of them.
    assert len(topology.boundary_loops(cut.faces)) == 3
    assert cut.closed is not None
    assert len(topology.boundary_loops(cut.closed)) == 4
    assert len(cut.closed) == len(sheet.faces)
    apart = np.linalg.norm(pos[cut.rims[:, 0]] - pos[cut.rims[:, 1]], axis=1)
    assert apart.min() >= ROOM
    assert (before[cut.rims[:, 0]] == before[cut.rims[:, 1]]).all()
    assert {tuple(pair) for pair in cut.rows[row].tolist()} <= {tuple(pair) for pair in cut.rims.tolist()}
    # The left edge is above the right one, and below it a strip that goes on from the right one.
    assert (pos[cut.rims[:, 0], 2] > pos[cut.rims[:, 1], 2]).all()
    strips = [key for key in cut.panels if "underlap" in key]
    assert len(strips) == len(sheet.fastened)
    wide = next(fastener.overlap for fastener, _ in sheet.fastened)
    ways = [np.linalg.norm(np.diff(sheet.uv[points[:, 0]], axis=0), axis=1).sum() for _, points in sheet.fastened]
    assert _flat_area(cut) - _flat_area(sheet) == pytest.approx(wide * sum(ways), rel=1e-6)


def test_buttons_are_apart_and_a_zip_is_everywhere(measures: Measures) -> None:
    for front, row in (("buttons", "front_buttons"), ("zip", "front_zip")):
        sheet = sheet_of(draft("blouse", measures, {"front": front}), 0.02, "blouse")
        cut, _, _ = opened(sheet, sheet.pos)
        pairs = cut.rows[row]
        height = cut.pos[pairs[:, 0], 1]
        assert (np.diff(height) < 0.0).all()  # from the top down
        if front == "zip":
            assert len(pairs) == len(cut.rims)
        else:
            assert np.abs(np.diff(height[1:]) + CLOSURES["buttons"].every).max() < 0.02
            assert height[-1] - cut.pos[cut.rims].min(axis=(0, 1))[1] > 0.5 * CLOSURES["buttons"].every


def test_a_closed_front_is_one_panel(measures: Measures) -> None:
    pattern = draft("blouse", measures, {"front": "closed"})
    assert {"front", "collar_front"} <= set(pattern.panels)
    assert sheet_of(pattern, _EDGE, "blouse").fastened == ()


@pytest.mark.parametrize("name", ["blouse", "blazer"])
def test_collars_and_lapels_are_folded_outwards(name: str, measures: Measures) -> None:
    pattern = draft(name, measures)
    folds = [stitch for stitch in pattern.stitches if stitch.angle is not None]
    assert len(folds) == {"blouse": 4, "blazer": 6}[name]
    sheet = sheet_of(pattern, _EDGE, name)
    depth = {key: panel.translation[2] for key, panel in pattern.panels.items()}
    for stitch in folds:
        assert stitch.same  # the two pieces lie on each other
        assert np.degrees(stitch.angle) < -120.0
        standing, turned = stitch.first[0], stitch.second[0]
        outwards = -1.0 if standing.endswith("back") else 1.0
        assert outwards * (depth[turned] - depth[standing]) > 5e-3
    angles = sheet.made.fold
    assert angles is not None
    assert np.unique(np.round(np.degrees(np.abs(angles[np.isfinite(angles)])))).tolist() == [155.0]


def test_quilting_is_level_and_meets_at_the_sides(measures: Measures) -> None:
    for tube in (0.06, 0.08, 0.15):
        pattern = draft("gilet", measures, {"tube": tube})
        heights = {
            key: np.array([fold.start[1] for fold in panel.folds]) for key, panel in pattern.panels.items() if panel.folds
        }
        assert set(heights) == {"back", "left_front", "right_front"}
        np.testing.assert_array_equal(heights["left_front"], heights["right_front"])
        low = min(len(own) for own in heights.values()) - 1
        np.testing.assert_array_equal(heights["back"][:low], heights["left_front"][:low])
        np.testing.assert_allclose(np.diff(np.unique(heights["back"])), tube)
        sheet = sheet_of(pattern, 0.04, "gilet")
        edges = np.linalg.norm(sheet.flat - np.roll(sheet.flat, 1, axis=1), axis=2)
        assert edges.min() > 2e-3  # both sides of a seam have one vertex for one fold
        inner = np.isnan(sheet.outline[sheet.uv_faces]).all(axis=1) & sheet.panels["back"]
        assert np.ptp(sheet.pos[sheet.faces[inner]][..., 2]) < 1e-9  # it begins flat, as no pleat does


def test_ribbing_is_shorter_at_rest(measures: Measures) -> None:
    tight, wide = (draft("bomber", measures, {"rib": rib}).panels for rib in (0.8, 1.0))
    for key in ("ribbing_back", "left_ribbing_front", "left_cuff_front"):
        assert tight[key].elastic[0] == pytest.approx(0.8 * wide[key].elastic[0])
        assert tight[key].elastic[1] == 1.0
    assert wide["back"].elastic == (1.0, 1.0)

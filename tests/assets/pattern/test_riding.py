"""Pockets and buttons of a pattern ride on the garment, and are read from files and written to them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from hood.assets.body.body import Body
from hood.assets.pattern.designs import draft
from hood.assets.pattern.making import Fold, folded
from hood.assets.pattern.measures import Measures, measure_body
from hood.assets.pattern.pattern import read_pattern, write_pattern
from hood.assets.pattern.riding import riders_of
from hood.assets.pattern.sheet import sheet_of
from hood.mesh.geometry import vertex_normals


@pytest.fixture(scope="module")
def measures(body: Body) -> Measures:
    vertices, joints = body.shaped(np.array([0.0]))
    return measure_body(vertices, body.faces, joints)


def square(tmp_path: Path, hood: object) -> Path:
    """A panel of 20 cm by 20 cm that says something of what rides on it."""
    panel = {
        "vertices": [[0, 0], [20, 0], [20, 20], [0, 20]],
        "edges": [{"endpoints": [k, (k + 1) % 4]} for k in range(4)],
        "hood": hood,
    }
    path = tmp_path / "square.json"
    path.write_text(json.dumps({"pattern": {"panels": {"front": panel}, "stitches": []}}))
    return path


POCKET = {"name": "pocket", "outline": [[4, 4], [16, 4], [16, 14], [4, 14]]}


def test_a_pocket_lies_on_its_panel_and_follows_it(tmp_path: Path) -> None:
    pattern = read_pattern(square(tmp_path, {"patches": [POCKET], "buttons": [[10, 17]], "radius": 1.0}))
    sheet = sheet_of(pattern, 0.02, "square")
    riders = riders_of(pattern, sheet, sheet.pos)
    assert riders is not None
    np.testing.assert_allclose(riders.positions(sheet.pos, sheet.pos), riders.pos, atol=1e-9)
    cloth = riders.pos[:, 1] < 0.15
    np.testing.assert_allclose(riders.pos[cloth].min(axis=0), [0.04, 0.04, 1.5e-4], atol=1e-9)
    np.testing.assert_allclose(riders.pos[cloth].max(axis=0), [0.16, 0.14, 1.5e-3], atol=1e-9)
    button = riders.pos[~cloth]
    assert np.ptp(button[:, 0]) == pytest.approx(0.02, abs=1e-9)
    assert button[:, 2].max() == pytest.approx(3.5e-3, abs=1e-9)
    # Rolled up, the cloth carries the pocket along at its height; the button stays as it is.
    angle = sheet.pos[:, 0] / 0.1
    rolled = np.stack([0.1 * np.sin(angle), sheet.pos[:, 1], 0.1 * np.cos(angle)], axis=1)
    there = riders.positions(rolled, sheet.pos)
    assert np.linalg.norm(there[cloth][:, [0, 2]], axis=1) == pytest.approx(0.1008, abs=1.3e-3)
    pair = np.linalg.norm(there[~cloth][0] - there[~cloth][8])
    assert pair == pytest.approx(np.linalg.norm(button[0] - button[8]), rel=1e-9)


def test_upper_sides_face_outwards_on_every_panel(measures: Measures) -> None:
    pattern = draft("jeans", measures)
    sheet = sheet_of(pattern, 0.03, "jeans")
    riders = riders_of(pattern, sheet, sheet.pos)
    assert riders is not None
    above = vertex_normals(torch.as_tensor(sheet.pos), torch.as_tensor(sheet.faces)).numpy()
    corners = riders.pos[riders.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, nearest = cKDTree(sheet.pos).query(corners.mean(axis=1))
    share = (normal * above[nearest]).sum(axis=1) / np.linalg.norm(normal, axis=1)
    assert (share > 0.8).mean() > 0.3  # upper sides, the rest are rims
    assert (share < -0.8).mean() < 0.01
    names = [patch.name for panel in pattern.panels.values() for patch in panel.patches]
    assert (names.count("pocket"), names.count("coin_pocket"), names.count("button"), names.count("turn_up")) == (2, 1, 1, 4)


def test_what_rides_is_written_and_read_back(measures: Measures, tmp_path: Path) -> None:
    pattern = draft("jeans", measures)
    write_pattern(tmp_path / "jeans.json", pattern)
    again = read_pattern(tmp_path / "jeans.json")
    for name, panel in pattern.panels.items():
        assert [patch.name for patch in again.panels[name].patches] == [patch.name for patch in panel.patches]
        for own, other in zip(panel.patches, again.panels[name].patches, strict=True):
            np.testing.assert_allclose(other.outline, own.outline, atol=1e-9)
            assert other.rigid == own.rigid


@pytest.mark.parametrize(
    ("hood", "message"),
    [
        ({"patches": "pocket"}, "panel 'front': hood.patches is 'pocket'; write"),
        ({"patches": [{"outline": [[0, 0], [1, 1]]}]}, r"patch 0: outline is .*; give 3 points \[x, y\] or more"),
        ({"patches": [{"line": []}]}, "hood.patches is"),
        ({"buttons": [1, 2]}, r"hood.buttons is \[1, 2\]; give 1 points"),
        ({"buttons": [[1, 2]], "radius": 50}, "hood.radius is 50; give a number from 0.1 to 10"),
    ],
)
def test_mistakes_are_named(hood: object, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        read_pattern(square(tmp_path, hood))


def test_laid_pleats_keep_lengths_and_are_as_wide_as_what_is_seen(measures: Measures) -> None:
    for pleat in ("knife", "box"):
        panel = draft("pleated", measures, {"pleat": pleat}).panels["skirt_front_left"]
        points = np.concatenate([edge.evenly(8)[:-1] for edge in panel.edges])
        laid = folded(points, panel.folds, 1.0)
        # From one fold to the next the cloth is flat: every side of the outline keeps its chord.
        chords = [np.linalg.norm(np.diff(table[k : k + 9], axis=0), axis=1) for k in (0, 8) for table in (points, laid)]
        np.testing.assert_allclose(chords[1], chords[0], rtol=1e-9)
        np.testing.assert_allclose(chords[3], chords[2], rtol=1e-9)
        assert np.ptp(laid[:, 0]) < 0.75 * np.ptp(points[:, 0])
        assert 0.005 < np.ptp(laid[:, 2]) < 0.06
    flat = np.array([[0.0, 0.0], [1.0, 2.0]])
    one = Fold(np.array([0.5, 0.0]), np.array([0.5, 1.0]), 2.0)
    other = Fold(np.array([0.0, 0.5]), np.array([1.0, 0.5]), 2.0)  # crosses it: these are no pleats
    for folds in ([one], [one, other]):
        np.testing.assert_array_equal(folded(flat, folds, 1.0), [[0.0, 0.0, 0.0], [1.0, 2.0, 0.0]])

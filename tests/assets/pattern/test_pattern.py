"""Sewing patterns: what is read, what is refused by name, and the sheet that their panels make."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sewing_patterns import PATTERNS, panel, skirt, specification, write

from hood.assets.material import Material
from hood.assets.pattern.making import with_elastic
from hood.assets.pattern.pattern import Edge, read_pattern, write_pattern
from hood.assets.pattern.sheet import PatternSheet, carry_over, sheet_of
from hood.cloth.cloth import build_cloth
from hood.mesh import topology
from hood.mesh.flat import stretched_sides

#: Openings of every pattern.
_OPENINGS = {"skirt": 2, "tshirt": 4, "bodice": 4, "trousers": 3}


def _sheet(tmp_path: Path, content: dict[str, Any], edge: float = 0.04) -> PatternSheet:
    path = write(tmp_path / "pattern.json", content)
    return sheet_of(read_pattern(path), edge, str(path))


def test_a_side_that_is_much_shorter_than_the_edges_has_its_two_ends(tmp_path: Path) -> None:
    corner = panel([[0, 0], [40, 0], [40, 39.7], [39.7, 40], [0, 40]])
    sheet = _sheet(tmp_path, specification({"front": corner}, []), 0.05)
    edges = topology.unique_edges(sheet.faces)
    assert np.linalg.norm(sheet.pos[edges[:, 0]] - sheet.pos[edges[:, 1]], axis=1).min() == pytest.approx(0.003 * 2**0.5)


@pytest.mark.parametrize("name", PATTERNS)
def test_panels_weld_to_an_oriented_sheet_with_the_lengths_of_the_pattern(name: str, tmp_path: Path) -> None:
    content = PATTERNS[name]()
    sheet = _sheet(tmp_path, content)
    half = sheet.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(half, axis=0)) == len(half)  # every edge is passed once each way
    assert len(topology.boundary_loops(sheet.faces)) == _OPENINGS[name]
    assert len(np.unique(topology.connected_components(len(sheet.pos), topology.unique_edges(sheet.faces)))) == 1
    area = 0.5 * np.abs(np.linalg.det(sheet.flat[:, 1:] - sheet.flat[:, :1]))
    pattern = read_pattern(tmp_path / "pattern.json")
    for key, mask in sheet.panels.items():
        fine = np.concatenate([edge.evenly(200)[:-1] for edge in pattern.panels[key].edges])
        x, y = fine.T
        whole = 0.5 * abs((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
        assert area[mask].sum() == pytest.approx(whole, rel=0.02)  # chords of curves
    assert sum(mask.sum() for mask in sheet.panels.values()) == len(sheet.faces)


def test_a_unit_is_one_of_length(tmp_path: Path) -> None:
    content = skirt()
    centimetres = _sheet(tmp_path, content)
    for own in content["pattern"]["panels"].values():
        own["vertices"] = [[3.0 * x, 3.0 * y] for x, y in own["vertices"]]
        own["translation"] = [3.0 * x for x in own["translation"]]
    content["properties"]["units_in_meter"] = 300
    np.testing.assert_allclose(_sheet(tmp_path, content).pos, centimetres.pos, atol=1e-12)
    assert np.ptp(centimetres.pos[:, 1]) == pytest.approx(0.5)


def test_curves_bulge_to_the_side_that_they_say() -> None:
    start, end, none = np.zeros(2), np.array([2.0, 0.0]), np.zeros((0, 2))
    middle = np.array([0.5])
    for right, y in ((True, -1.0), (False, 1.0)):
        arc = Edge(start, end, none, (1.0, False, right))
        np.testing.assert_allclose(arc.at(middle), [[1.0, y]], atol=1e-12)
        assert arc.length == pytest.approx(np.pi, rel=1e-3)
    large = Edge(start, end, none, (2.0, True, True))
    small = Edge(start, end, none, (2.0, False, True))
    assert large.length + small.length == pytest.approx(4.0 * np.pi, rel=1e-3)
    np.testing.assert_allclose(Edge(start, end, np.array([[1.0, 1.0]])).at(middle), [[1.0, 0.5]])
    steps = np.linalg.norm(np.diff(Edge(start, end, np.array([[0.2, 1.0]])).evenly(9), axis=0), axis=1)
    assert np.ptp(steps) < 0.02 * steps.mean()


def test_both_forms_of_a_curve_are_one(tmp_path: Path) -> None:
    content = skirt()
    old = _sheet(tmp_path, content)
    for own in content["pattern"]["panels"].values():
        for edge in own["edges"]:
            if "curvature" in edge:
                edge["curvature"] = {"type": "quadratic", "params": [edge["curvature"]]}
    np.testing.assert_array_equal(_sheet(tmp_path, content).pos, old.pos)


def test_a_placement_turns_about_x_then_y_then_z(tmp_path: Path) -> None:
    square = panel([[0, 0], [50, 0], [50, 50], [0, 50]], None, (0, 100, 0), (90, 90, 0))
    sheet = _sheet(tmp_path, specification({"square": square}, []))
    # y goes to z about x, which goes to x about y; x goes to -z.
    assert np.ptp(sheet.pos, axis=0) == pytest.approx([0.5, 0.0, 0.5])
    assert sheet.pos[:, 0].max() == pytest.approx(0.5)
    assert sheet.pos[:, 2].min() == pytest.approx(-0.5)


def test_gathers_are_spread_by_share_of_length(tmp_path: Path) -> None:
    points = [[-20, 0], [20, 0], [20, 30], [-20, 30]]
    wide = [[-40, 30], [40, 30], [40, 60], [-40, 60]]
    content = specification({"a": panel(points), "b": panel(wide)}, [("a", 2, "b", 0)])
    sheet = _sheet(tmp_path, content, 0.05)
    assert len(topology.boundary_loops(sheet.faces)) == 1
    with pytest.raises(ValueError, match=r"stitch 0 joins panel 'a', edge 2 \(40.0 cm\) and panel 'b', edge 0 \(80.0 cm\)"):
        read_pattern(tmp_path / "pattern.json", most_gathered=1.5)


def test_right_to_wrong_runs_in_one_direction(tmp_path: Path) -> None:
    points = [[0, 0], [40, 0], [40, 30], [0, 30]]
    content = specification({"a": panel(points), "b": panel(points, None, (0, 0, 5))}, [("a", 1, "b", 1)])
    content["pattern"]["stitches"][0].append("right_wrong")
    sheet = _sheet(tmp_path, content)
    half = sheet.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(half, axis=0)) == len(half)  # one of the panels was turned over
    seam = sheet.pos[sheet.seam]
    assert np.allclose(seam[:, 0], 0.4)
    assert np.allclose(seam[:, 2], 0.025)
    assert np.allclose(np.sort(seam[:, 1]), np.linspace(0.0, 0.3, len(seam)))


@pytest.mark.parametrize("name", PATTERNS)
def test_a_mesh_lies_on_itself(name: str, tmp_path: Path) -> None:
    sheet = _sheet(tmp_path, PATTERNS[name]())
    np.testing.assert_allclose(carry_over(sheet, sheet.pos, sheet), sheet.pos, atol=1e-9)


def test_a_finer_mesh_keeps_its_place_in_the_panel(tmp_path: Path) -> None:
    curved = {0: [0.5, -0.3], 1: {"type": "circle", "params": [25.0, 0, 1]}, 3: [0.5, 0.3]}
    content = specification({"a": panel([[0, 0], [40, 0], [40, 30], [0, 30]], curved)}, [])
    coarse, fine = _sheet(tmp_path, content, 0.05), _sheet(tmp_path, content, 0.013)
    assert len(fine.pos) > 5 * len(coarse.pos)
    found = carry_over(coarse, coarse.pos, fine)
    assert np.abs(found - fine.pos).max() < 4e-3  # the chords of the curves
    inside = np.linalg.norm(fine.pos[:, :2] - [0.2, 0.13], axis=1) < 0.08
    assert inside.sum() > 50
    np.testing.assert_allclose(found[inside], fine.pos[inside], atol=1e-9)


def _spoiled(change: Any) -> dict[str, Any]:
    content = copy.deepcopy(skirt())
    change(content["pattern"])
    return content


_FAULTS = {
    r"panel 'front': its outline crosses itself, edge 1 and edge 3; move": lambda p: p["panels"]["front"][
        "vertices"
    ].__setitem__(slice(None), [[-30, 0], [30, 0], [-20, 50], [20, 50]]),
    r"panel 'front', edge 2: no edge begins at its end, vertex 3; close": lambda p: p["panels"]["front"]["edges"].pop(),
    r"panel 'front', edge 1: the outline is no loop there; let": lambda p: p["panels"]["front"]["edges"][2].update(
        endpoints=[1, 3]
    ),
    r"stitch 0: there is no panel 'side'; remove": lambda p: p["stitches"][0][0].update(panel="side"),
    r"stitch 0: panel 'front' has no edge 9; remove the stitch": lambda p: p["stitches"][0][0].update(edge=9),
    r"panel 'front', edge 1 is in stitches 0 and 1; divide": lambda p: p["stitches"][1][0].update(edge=1),
    r"panel 'front', edge 1 has no length; merge": lambda p: p["panels"]["front"]["vertices"].__setitem__(2, [33.0, 0.0]),
    r"panel 'front': vertices is not n × 2 finite numbers": lambda p: p["panels"]["front"].update(vertices=[[0, "x"]]),
    r"panel 'front', edge 0: endpoints are \[0, 7\]": lambda p: p["panels"]["front"]["edges"][0].update(endpoints=[0, 7]),
    r"edge 1: its curvature is of type 'spline'": lambda p: p["panels"]["front"]["edges"][1].update(
        curvature={"type": "spline", "params": []}
    ),
}


@pytest.mark.parametrize("message", _FAULTS)
def test_faults_are_named(message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"pattern\.json: .*" + message):
        _sheet(tmp_path, _spoiled(_FAULTS[message]))


def test_a_lining_in_the_seam_of_a_waistband_is_refused(tmp_path: Path) -> None:
    """An edge has one stitch; what works is worn below."""
    points = [[0, 0], [40, 0], [40, 30], [0, 30]]
    panels = {"shell": panel(points), "lining": panel(points, None, (0, 0, -1)), "band": panel(points, None, (0, 30, 0))}
    content = specification(panels, [("shell", 2, "band", 0), ("lining", 2, "band", 0)])
    with pytest.raises(ValueError, match=r"panel 'band', edge 0 is in stitches 0 and 1; .* lining .* garment=\[lining\.npz"):
        _sheet(tmp_path, content)


@pytest.mark.parametrize("name", ["shirt.dxf", "shirt.SVG"])
def test_drawings_are_refused_by_what_they_lack(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("0\nSECTION\n")
    kind = name[-3:].upper()
    with pytest.raises(ValueError, match=rf"shirt\.\w+: {kind} files draw outlines and do not say what is sewn to what; give"):
        read_pattern(tmp_path / name)


@pytest.mark.parametrize("text", ["", "[1]", '{"pattern": {}}', '{"pattern": {"panels": {"a": 3}}}'])
def test_other_files_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(ValueError, match=r"other\.json: "):
        read_pattern(tmp_path / "other.json")


def test_three_layers_in_a_seam_are_refused(tmp_path: Path) -> None:
    points = [[0, 0], [30, 0], [30, 30], [0, 30]]
    content = specification({key: panel(points) for key in "abc"}, [("a", 1, "b", 3), ("a", 3, "c", 1), ("c", 3, "b", 1)])
    assert len(topology.boundary_loops(_sheet(tmp_path, content).faces)) == 2  # a ring of three
    closed = specification({"a": panel(points), "b": panel(points)}, [("a", k, "b", k) for k in range(4)])
    assert not topology.boundary_loops(_sheet(tmp_path, closed).faces)
    tube = specification({"a": panel(points), "b": panel(points)}, [("a", 0, "a", 2), ("a", 1, "b", 3)])
    refusal = r"more than two layers of cloth meet in one seam, of panels 'a'; remove one of stitches 0; a lining is a garment"
    with pytest.raises(ValueError, match=refusal):
        _sheet(tmp_path, tube, 0.15)
    with pytest.raises(ValueError, match="panel 'a' is sewn to itself over one edge; give a smaller edge="):
        _sheet(tmp_path, tube, 0.3)


def _made(**hood: Any) -> dict[str, Any]:
    """A square of 40 cm sewn to another above it."""
    points = [[0, 0], [40, 0], [40, 40], [0, 40]]
    lower, upper = panel(points), panel(points, None, (0, 40, 0))
    return specification({"a": lower | {"hood": hood}, "b": upper}, [("a", 2, "b", 0)])


def test_elastic_of_a_panel_and_of_an_edge(tmp_path: Path) -> None:
    sheet = _sheet(tmp_path, _made(elastic=[0.85, 1.1]), 0.05)
    edges = sheet.flat[:, 1:] - sheet.flat[:, :1]
    assert sheet.made.elastic is not None
    wanted = stretched_sides(edges, np.tile([1.0, 0.0], (len(edges), 1)), 0.85, 1.1)
    np.testing.assert_allclose(sheet.made.elastic[sheet.panels["a"]], wanted[sheet.panels["a"]])
    assert (sheet.made.elastic[sheet.panels["b"]] == 1.0).all()
    content = _made()
    content["pattern"]["panels"]["b"]["edges"][2]["hood"] = {"elastic": 0.7, "bending": 4, "width": 6}
    sheet = _sheet(tmp_path, content, 0.02)
    low = sheet.pos[sheet.faces].mean(axis=1)[:, 1] < 0.73
    assert sheet.made.elastic is not None
    assert sheet.made.bending is not None
    assert (sheet.made.elastic[low] == 1.0).all()
    rim = sheet.pos[:, 1] > 0.8 - 1e-9
    on_rim = np.stack([np.roll(rim[sheet.faces], -1, axis=1), np.roll(rim[sheet.faces], -2, axis=1)]).all(axis=0)
    np.testing.assert_allclose(sheet.made.elastic[on_rim], 0.7)
    assert (sheet.made.bending[on_rim] == 4.0).all()
    held = with_elastic(_sheet(tmp_path, _made(), 0.02), rim, 0.9, 0.03)
    assert held.made.elastic is not None
    np.testing.assert_allclose(held.made.elastic[on_rim], 0.9)


@pytest.mark.parametrize("edge", [0.05, 0.021])
def test_edges_lie_along_folds_and_seams_have_angles_and_layers(tmp_path: Path, edge: float) -> None:
    fold = {"from": [13, 0], "to": [17, 40], "angle": 120, "bending": 2}
    inner = {"from": [25, 10], "to": [33, 30], "angle": -90}
    content = _made(folds=[fold, inner])
    content["pattern"]["stitches"][0][0]["hood"] = {"angle": 45, "bending": 5}
    sheet = _sheet(tmp_path, content, edge)
    cloth = build_cloth(sheet.pos, sheet.faces, Material(), dtype=torch.float64, flat=sheet.flat, made=sheet.made)
    ends = cloth.rest_pos[cloth.hinges[:, :2]]
    for degrees, start, end, factor in ((120, (0.13, 0), (0.17, 0.4), 2), (-90, (0.25, 0.1), (0.33, 0.3), 1)):
        found = ends[(cloth.rest_angle.abs() - np.radians(abs(degrees))).abs() < 1e-9]
        length = float((found[:, 1] - found[:, 0]).norm(dim=1).sum())
        assert length == pytest.approx(float(np.hypot(end[0] - start[0], end[1] - start[1])), rel=1e-9)
        way = np.subtract(end, start)
        off = (found[..., 0] - start[0]) * way[1] - (found[..., 1] - start[1]) * way[0]
        assert float(off.abs().max()) < 1e-9
        assert factor in (cloth.bending_stiffness / Material().bending_stiffness).unique().tolist()
    seam = (cloth.rest_angle.abs() - np.radians(45)).abs() < 1e-9
    assert float((ends[seam][:, 1] - ends[seam][:, 0]).norm(dim=1).sum()) == pytest.approx(0.4)
    torch.testing.assert_close(
        cloth.bending_stiffness[seam], torch.full((int(seam.sum()),), 5 * Material().bending_stiffness).double()
    )
    # The sewn sides share the place where the fold ends.
    assert np.isclose(sheet.pos, [0.17, 0.4, 0.0], atol=1e-9).all(axis=1).sum() == 1
    assert len(topology.boundary_loops(sheet.faces)) == 1


def test_a_fold_keeps_its_side_where_its_panel_is_turned_over(tmp_path: Path) -> None:
    content = _made(folds=[{"from": [20, 0], "to": [20, 40], "angle": 30}])
    plain = _sheet(tmp_path, content, 0.1)
    content["pattern"]["panels"]["a"]["edges"] = [
        {"endpoints": edge["endpoints"][::-1]} for edge in content["pattern"]["panels"]["a"]["edges"][::-1]
    ]
    for side in content["pattern"]["stitches"][0]:
        side["edge"] = 1 if side["panel"] == "a" else 0
    content["pattern"]["stitches"][0].append("right_wrong")
    other = _sheet(tmp_path, content, 0.1)
    assert plain.made.fold is not None
    assert other.made.fold is not None
    assert float(np.nanmean(plain.made.fold)) == pytest.approx(np.radians(30))
    # The outline runs the other way, so its outer side is the other one; its faces look as those of the other panel do.
    facing = np.cross(*(other.pos[other.faces[:, k]] - other.pos[other.faces[:, 0]] for k in (1, 2)))[:, 2]
    assert np.sign(np.nanmean(other.made.fold)) == -np.sign(facing[other.panels["a"]].mean())


@pytest.mark.parametrize(
    ("hood", "message"),
    [
        ({"elastic": 0}, r"panel 'a': hood.elastic is 0; give a number from 0.2 to 2"),
        ({"elastic": [0.8]}, r"hood.elastic is \[0.8\]; give one factor along x, or two"),
        ({"pleats": 3}, r"panel 'a': hood is {'pleats': 3}; give a table of elastic, folds"),
        ({"folds": 3}, r"hood.folds is no list"),
        ({"folds": [{"from": [0, 0]}]}, r"fold 0 is .*give from: \[x, y\], to: \[x, y\], angle"),
        ({"folds": [{"from": [0, 0], "to": [0, 0], "angle": 9}]}, r"fold 0 has no length"),
        ({"folds": [{"from": [0, 0], "to": [9, 9], "angle": 180}]}, r"fold 0: its angle is 180; give degrees between"),
        ({"folds": [{"from": [0, 0], "to": [90, 9], "angle": 18}]}, r"the end \(90.0, 9.0\) cm of a fold is outside; move it"),
        (
            {"folds": [{"from": [20, 0], "to": [20, 40], "angle": 9}, {"from": [0, 20], "to": [40, 21], "angle": 9}]},
            r"panel 'a': fold \d .* too near to its outline or to another fold for edges of 40 mm",
        ),
    ],
)
def test_what_cannot_be_made_is_told(tmp_path: Path, hood: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _sheet(tmp_path, _made(**hood))


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"every": 8}, r"hood.every is 8 without a fastener; name its row"),
        ({"fastener": "front zip"}, r"hood.fastener is 'front zip'; give the name of a row"),
        ({"fastener": "zip", "overlap": 0.2}, r"hood.overlap is 0.2; give a number from 0.5 to 100"),
    ],
)
def test_a_fastener_that_cannot_be_is_told(tmp_path: Path, own: dict[str, Any], message: str) -> None:
    content = skirt()
    content["pattern"]["stitches"][0][0]["hood"] = own
    with pytest.raises(ValueError, match=f"stitch 0: {message}"):
        _sheet(tmp_path, content)


def test_how_a_pattern_is_made_is_written(tmp_path: Path) -> None:
    content = skirt()
    own = content["pattern"]["panels"]["front"]
    says = [
        (own, {"elastic": [0.85, 1.1], "folds": [{"from": [-3, 10.3], "to": [3.1, 30], "angle": 150, "bending": 2}]}),
        (own["edges"][0], {"elastic": 0.7, "bending": 3, "width": 1.7}),
        (own["edges"][1], {"width": 4}),
        (content["pattern"]["stitches"][0][0], {"angle": -33.3, "bending": 4, "fastener": "side", "every": 8, "overlap": 3}),
    ]
    for table, made in says:
        table["hood"] = made
    pattern = read_pattern(write(tmp_path / "skirt.json", content))
    write_pattern(tmp_path / "again.json", pattern)
    again = json.loads((tmp_path / "again.json").read_text(encoding="utf-8"))["pattern"]
    front = again["panels"]["front"]
    kept = [front["hood"], front["edges"][0]["hood"], front["edges"][1]["hood"], again["stitches"][0][0]["hood"]]
    assert kept == [made for _, made in says]
    assert json.dumps(again).count('"hood"') == 4
    other = read_pattern(tmp_path / "again.json")
    sheets = [sheet_of(one, 0.04, "skirt").made for one in (pattern, other)]
    for name, table in vars(sheets[0]).items():
        assert np.allclose(table, vars(sheets[1])[name], rtol=1e-9, equal_nan=True)

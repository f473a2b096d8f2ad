"""Own designs: over the ranges of their options and on several bodies they are patterns that can be sewn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.pattern.designs import DESIGNS, draft
from hood.assets.pattern.measures import Measures, measure_body
from hood.assets.pattern.options import MEANINGS
from hood.assets.pattern.pattern import Pattern, check_pattern, read_pattern, write_pattern
from hood.assets.pattern.sheet import sheet_of
from hood.mesh import topology

#: Openings of every design without sleeves; sleeves change none of them.
OPENINGS = {
    **dict.fromkeys(("tank", "tshirt", "shirt", "blouse", "bomber", "gilet", "blazer"), 4),
    **dict.fromkeys(("bodice", "sheath", "dress", "swing", "shift"), 4),
    **dict.fromkeys(("skirt", "pencil", "circle", "gathered", "tiered", "pleated", "wrap", "poncho", "cape"), 2),
    **dict.fromkeys(("trousers", "leggings", "shorts", "jeans", "apron"), 3),
    "hoodie": 4,
    "jumpsuit": 5,
}
#: Sides that are longer than what they are sewn to, on purpose.
GATHERED = ("tier", "sleeve")


@pytest.fixture(scope="module")
def bodies(body: Body) -> list[Measures]:
    shapes = [body.shaped(np.array([beta])) for beta in (0.0, 2.0, -2.0)]
    return [measure_body(vertices, body.faces, joints) for vertices, joints in shapes]


def corners(name: str) -> list[dict[str, Any]]:
    """Options at their defaults, their least, their most, and at random."""
    known, rng = DESIGNS[name].options, np.random.default_rng(5)
    low = {key: own[1] for key, own in known.items() if len(own) > 1}
    high = {key: own[-1] for key, own in known.items()}
    some = [
        {
            key: str(rng.choice(own)) if isinstance(own[0], str) else float(rng.uniform(own[1], own[2]))
            for key, own in known.items()
        }
        for _ in range(2)
    ]
    return [{}, low, high, *some]


def ends(pattern: Pattern) -> list[tuple[str, str, float, float]]:
    """Panels and lengths [m] of what is sewn to what."""
    found = []
    for stitch in pattern.stitches:
        sides = [(name, pattern.panels[name].edges[place].length) for name, place in (stitch.first, stitch.second)]
        found.append((sides[0][0], sides[1][0], sides[0][1], sides[1][1]))
    return found


@pytest.mark.parametrize("name", DESIGNS)
def test_seams_fit_over_the_ranges_of_the_options(name: str, bodies: list[Measures]) -> None:
    for number, options in enumerate(corners(name)):
        for measures in bodies if number == 0 else bodies[:1]:
            pattern = draft(name, measures, options)
            check_pattern(name, pattern)
            for first, second, own, other in ends(pattern):
                gathered = first.startswith(GATHERED) or second.startswith(GATHERED) or "_sleeve_" in first + second
                gathered |= ("ribbing" in first) != ("ribbing" in second)
                if not gathered:
                    assert own == pytest.approx(other, rel=2e-3), (options, first, second)
            taken = {side for stitch in pattern.stitches for side in (stitch.first, stitch.second)}
            assert len(taken) == 2 * len(pattern.stitches)


@pytest.mark.parametrize("name", DESIGNS)
def test_panels_weld_to_an_oriented_sheet(name: str, bodies: list[Measures]) -> None:
    for options in corners(name)[:3]:
        pattern = draft(name, bodies[0], options)
        sheet = sheet_of(pattern, 0.035, name)
        half = sheet.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        assert len(np.unique(half, axis=0)) == len(half)  # every edge is passed once each way
        assert len(topology.boundary_loops(sheet.faces)) == OPENINGS[name] + (options.get("straps") == "back")
        assert len(np.unique(topology.connected_components(len(sheet.pos), topology.unique_edges(sheet.faces)))) == 1
        normal = np.cross(*(sheet.pos[sheet.faces[:, k]] - sheet.pos[sheet.faces[:, 0]] for k in (1, 2)))
        forward = [mask for key, mask in sheet.panels.items() if "front" in key and "sleeve" not in key]
        assert all(normal[mask][:, 2].mean() > 0 for mask in forward)  # drawn as they are seen from outside


@pytest.mark.parametrize("name", DESIGNS)
def test_a_written_design_is_read_back(name: str, bodies: list[Measures], tmp_path: Path) -> None:
    pattern, path = draft(name, bodies[1]), tmp_path / f"{name}.json"
    write_pattern(path, pattern)
    again = read_pattern(path)
    assert again.name == name
    assert again.stitches == pattern.stitches
    assert again.height == pytest.approx(bodies[1].height, abs=1e-9)
    assert list(again.panels) == list(pattern.panels)
    for key, panel in pattern.panels.items():
        other = again.panels[key]
        assert (other.label, [edge.label for edge in other.edges]) == (panel.label, [edge.label for edge in panel.edges])
        np.testing.assert_allclose(other.rotation, panel.rotation, atol=1e-11)
        np.testing.assert_allclose(other.translation, panel.translation, atol=1e-11)
        for own, edge in zip(other.edges, panel.edges, strict=True):
            np.testing.assert_allclose(own.start, edge.start, atol=1e-11)
            np.testing.assert_allclose(own.curve, edge.curve, atol=1e-11)


def test_a_waistband_is_as_long_as_the_waist(bodies: list[Measures]) -> None:
    for measures in bodies:
        for name in ("skirt", "pencil", "circle", "gathered", "tiered", "pleated"):
            pattern = draft(name, measures)
            rim = [edge.length for panel in pattern.panels.values() for edge in panel.edges if panel.name.startswith("band")]
            top = [
                edge.length
                for panel in pattern.panels.values()
                for edge in panel.edges
                if panel.name.startswith("band") and edge.label == "lower_interface"
            ]
            assert sum(top) == pytest.approx(1.02 * measures.waist, rel=2e-3), name
            assert len(rim) > len(top) == 2


def test_a_cap_is_as_long_as_its_armhole_and_a_little(bodies: list[Measures]) -> None:
    for measures in bodies:
        for first, second, own, other in ends(draft("tshirt", measures, {"sleeve": 0.8})):
            if {"front", "back"} & {first, second} and "sleeve" in first + second:
                assert own / other == pytest.approx(1.01, abs=2e-3)


def lengths(name: str, measures: Measures, options: dict[str, Any]) -> list[float]:
    """Of every edge [m], with where elastic, folds and patches are."""
    found: list[float] = []
    for panel in draft(name, measures, options).panels.values():
        found += [*(edge.length for edge in panel.edges), *panel.elastic, *(x for fold in panel.folds for x in fold.start)]
        found += [value for patch in panel.patches for value in patch.outline.reshape(-1)]
    return [round(float(value), 6) for value in found]


@pytest.mark.parametrize("name", DESIGNS)
def test_every_option_changes_the_pattern(name: str, bodies: list[Measures]) -> None:
    options = DESIGNS[name].options
    base = {"sleeve": 0.4} if "puff" in options or name == "shift" else {}
    plain = lengths(name, bodies[0], base)
    for key, known in options.items():
        value = next(value for value in reversed(known) if value != base.get(key, known[0]))
        assert lengths(name, bodies[0], base | {key: value}) != plain, key
        assert key in MEANINGS


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("tshrt", {}, "unknown design 'tshrt': did you mean 'tshirt'"),
        ("tshirt", {"slevee": 0.4}, r"design:tshirt: unknown option 'slevee': did you mean 'sleeve \(0.15 to 1\)'"),
        ("tshirt", {"sleeve": 3}, "design:tshirt: sleeve is 3; give a number from 0.15 to 1: length of the sleeves"),
        ("tshirt", {"sleeve": True}, "sleeve is True; give a number"),
        ("tshirt", {"sleeve": float("nan")}, "sleeve is nan; give a number"),
        ("tshirt", {"shape": "star"}, "design:tshirt: shape is 'star'; give one of round, v"),
        ("skirt", {"sleeve": 0.5}, r"known are ease \(0.02 to 0.3\)"),
    ],
)
def test_mistakes_are_named(name: str, options: dict[str, Any], message: str, bodies: list[Measures]) -> None:
    with pytest.raises(ValueError, match=message):
        draft(name, bodies[0], options)

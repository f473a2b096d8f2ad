"""Patterns sewn around the default body: the verdict on them, and what a file of them keeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sewing_patterns import PATTERNS, skirt, write

from hood.assets.body.body import Body
from hood.assets.garment.binding import posed_body
from hood.assets.material import Material
from hood.assets.motion.sequence_edit import arms_down
from hood.assets.pattern.pattern import read_pattern
from hood.assets.pattern.sheet import PatternSheet, sheet_of
from hood.rollouts.sewing import Sewn, SewnFigures, sew_around, waist_of


def _sewn(name: str, tmp_path: Path, body: Body, edge: float) -> tuple[PatternSheet, Sewn]:
    path = write(tmp_path / f"{name}.json", PATTERNS[name]())
    sheet = sheet_of(read_pattern(path), edge, str(path))
    angle = 45.0 if name == "tshirt" else 0.0
    return sheet, sew_around(sheet, posed_body(body, arms_down(angle), 0, np.zeros(10)), Material())


@pytest.mark.parametrize("name", ["skirt", "tshirt"])
@pytest.mark.usefixtures("compiled_layers")
def test_a_pattern_is_sewn_and_worn(name: str, tmp_path: Path, body: Body) -> None:
    sheet, sewn = _sewn(name, tmp_path, body, 0.06 if name == "skirt" else 0.04)
    assert sewn.figures.faults == []
    assert sewn.figures.openings == (2 if name == "skirt" else 4)
    assert sewn.held.any() == (name == "skirt")
    start, end = sheet.pos.min(axis=0), sheet.pos.max(axis=0)
    assert np.ptp(sewn.pos[:, 2]) > 0.2  # around the body
    assert np.abs(np.ptp(sewn.pos[:, 1]) - (end - start)[1]) < 0.12


@pytest.mark.slow
@pytest.mark.parametrize("name", PATTERNS)
@pytest.mark.usefixtures("compiled_layers")
def test_every_pattern_is_sewn(name: str, tmp_path: Path, body: Body) -> None:
    assert _sewn(name, tmp_path, body, 0.03)[1].figures.faults == []


def test_a_waist_is_held_where_there_is_one(tmp_path: Path) -> None:
    held = {}
    for name, make in PATTERNS.items():
        path = write(tmp_path / f"{name}.json", make())
        sheet = sheet_of(read_pattern(path), 0.05, name)
        held[name] = sheet.pos[waist_of(sheet, 1.72)][:, 1]
        unlabelled = replace(sheet, edge_labels={})
        assert np.array_equal(waist_of(sheet, 1.72), waist_of(unlabelled, 1.72))
    assert len(held["tshirt"]) == len(held["bodice"]) == 0
    assert np.allclose(held["skirt"], 1.07)
    assert np.allclose(held["trousers"], 1.04)


def test_every_fault_is_told() -> None:
    good = SewnFigures(0, 0, 0.1, 4, 0, 0.01, 1e-4)
    assert good.faults == []
    for change, words in (
        ({"body_crossings": 3}, "3 pairs of triangles pass through the body"),
        ({"self_crossings": 2}, "2 pairs of its own triangles"),
        ({"strain_p99": 0.31}, "stretched by 31%"),
        ({"strain_p99": float("nan")}, "stretched by nan%"),
        ({"empty_openings": 1}, "1 of 4 openings hold no part"),
        ({"sunk": 0.4}, "its top has sunk by 40 cm"),
        ({"speed": 0.01}, "still moves by 10.0 mm a second"),
    ):
        (text,) = replace(good, **change).faults
        assert words in text


@pytest.mark.usefixtures("compiled_layers")
def test_a_skirt_too_narrow_for_the_body_is_not_passed(tmp_path: Path, body: Body) -> None:
    path = write(tmp_path / "narrow.json", skirt(waist=50, hem=56))
    sheet = sheet_of(read_pattern(path), 0.05, str(path))
    assert sew_around(sheet, posed_body(body, arms_down(0.0), 0, np.zeros(10)), Material()).figures.faults

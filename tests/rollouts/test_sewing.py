"""Patterns sewn around the default body: the verdict on them, and what a file of them keeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from sewing_patterns import PATTERNS, skirt, tshirt, write

from hood.assets.body.body import JOINTS, Body
from hood.assets.garment.binding import posed_body
from hood.assets.material import Material
from hood.assets.motion.sequence_edit import arms_down
from hood.assets.pattern.pattern import read_pattern
from hood.assets.pattern.sheet import PatternSheet, sheet_of
from hood.cloth.cloth import build_cloth
from hood.mesh.flat import Construction, laid_out
from hood.mesh.topology import boundary_loops
from hood.rollouts.sewing import sew_around, sew_pattern, sewing_starts
from hood.rollouts.sewn import Sewn, SewnFigures, joints_of, judged, limbs_in, strapless, waist_of


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
        held[name] = sheet.pos[waist_of(sheet)][:, 1]
        unlabelled = replace(sheet, edge_labels={})
        assert np.array_equal(waist_of(sheet), waist_of(unlabelled))
    bandeau = sheet_of(read_pattern(write(tmp_path / "bandeau.json", skirt(92, 92, 30, 128))), 0.05, "bandeau")
    assert np.allclose(bandeau.pos[waist_of(bandeau)][:, 1], 1.28)
    assert strapless(bandeau)
    assert not strapless(sheet)
    assert len(held["tshirt"]) == len(held["bodice"]) == 0
    assert np.allclose(held["skirt"], 1.07)
    assert np.allclose(held["trousers"], 1.04)


def test_every_fault_is_told() -> None:
    good = SewnFigures(0, 0, 0.1, 4, 0, 0.01, 1e-4)
    slid = {"sunk": 0.9, "under": 0.05, "empty_openings": 1, "speed": 0.2}
    assert good.faults == []
    for change, words in (
        ({"body_crossings": 3}, "3 pairs of triangles pass through the body"),
        ({"self_crossings": 2}, "2 pairs of its own triangles"),
        ({"strain_p99": 0.31}, "stretched by 31%"),
        ({"strain_p99": float("nan")}, "stretched by nan%"),
        ({"empty_openings": 1}, "1 of 4 openings hold no part"),
        ({"sunk": 0.4}, "its top has sunk by 40 cm"),
        ({"speed": 0.01}, "still moves by 10.0 mm a second"),
        ({"sunk": -0.3}, "its top has risen by 30 cm"),
        ({"loose": 0.06}, "its waist stands off the body by 6 cm"),
        ({"under": 0.05}, "reaches 5 cm below the floor"),
        ({"swapped": ("the left leg, not the trunk",)}, "an opening holds the left leg, not the trunk"),
        ({"places": {"self_crossings": ", in panel 'cuff'"}, "self_crossings": 2}, "each other, in panel 'cuff'"),
        # What has slid down is told by its cause alone.
        (
            slid | {"girths": (0.99, 0.81)},
            "slid down by 90 cm: its upper edge is 99 cm around at rest, the body there 81 cm; it is",
        ),
        (slid | {"girths": (0.75, 0.97)}, "it does not hold up, waist=held holds it"),
    ):
        (text,) = replace(good, **change).faults
        assert words in text


@pytest.mark.usefixtures("compiled_layers")
def test_a_skirt_too_narrow_for_the_body_is_not_passed(tmp_path: Path, body: Body) -> None:
    path = write(tmp_path / "narrow.json", skirt(waist=50, hem=56))
    sheet = sheet_of(read_pattern(path), 0.05, str(path))
    assert sew_around(sheet, posed_body(body, arms_down(0.0), 0, np.zeros(10)), Material()).figures.faults


@pytest.mark.usefixtures("compiled_layers")
def test_a_fine_mesh_begins_where_a_coarse_one_rests(tmp_path: Path, body: Body) -> None:
    path = write(tmp_path / "skirt.json", PATTERNS["skirt"]())
    pattern = read_pattern(path)
    sheet = sheet_of(pattern, 0.016, str(path))
    posed, sewn = sew_pattern(pattern, sheet, body, np.zeros(10), Material())
    assert len(sewn.pos) == len(sheet.pos) > 2 * 700
    assert sewn.figures.faults == []
    assert np.ptp(posed.surface[:, 0]) > 1.4  # the arms are not in the way of a skirt


@pytest.mark.usefixtures("compiled_layers")
def test_a_long_hem_lies_on_the_floor(tmp_path: Path, body: Body) -> None:
    path = write(tmp_path / "train.json", skirt(hem=150, length=115))
    sheet = sheet_of(read_pattern(path), 0.06, str(path))
    assert sheet.pos[:, 1].min() < -0.05
    posed = posed_body(body, arms_down(0.0), 0, np.zeros(10))
    sewn = sew_around(sheet, posed, Material())
    floor = posed.surface[:, 1].min()
    assert floor - 5e-3 < sewn.pos[:, 1].min() < floor + 0.02
    assert sewn.figures.self_crossings == 0
    assert sewn.figures.in_place


def test_a_pattern_moves_with_the_height_of_the_body(tmp_path: Path, body: Body) -> None:
    path = write(tmp_path / "tshirt.json", PATTERNS["tshirt"]())
    sheet = sheet_of(read_pattern(path), 0.05, str(path))
    lifts = {}
    for beta in (-2.0, 0.0, 2.0):
        posed = posed_body(body, arms_down(45.0), 0, np.array([beta] + 9 * [0.0]))
        lifts[float(np.ptp(posed.surface[:, 1]))] = sewing_starts(sheet, posed)[0].lift
    assert [lift for _, lift in sorted(lifts.items())] == sorted(lifts.values())
    assert len(set(lifts.values())) == 3


def _ring(middle: np.ndarray, axis: np.ndarray, radius: float) -> np.ndarray:
    axis = axis / np.linalg.norm(axis)
    first = np.cross(axis, [0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.cross(axis, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)[:, None]
    return np.asarray(middle + radius * (np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)))


def test_an_opening_is_told_by_the_limbs_in_it(body: Body) -> None:
    posed = posed_body(body, arms_down(0.0), 0, np.zeros(10))
    joint = dict(zip(JOINTS, joints_of(posed), strict=False))
    up = np.array([0.0, 1.0, 0.0])

    def within(a: str, b: str, axis: np.ndarray | None = None, radius: float = 0.1) -> set[str]:
        middle = 0.55 * joint[a] + 0.45 * joint[b] + [0.007, 0.003, 0.011]
        return set(limbs_in(_ring(middle, joint[b] - joint[a] if axis is None else axis, radius), posed))

    assert within("neck", "head") == within("spine1", "spine2") == {"trunk"}
    assert within("left_shoulder", "left_elbow") == {"left arm"}
    assert within("right_knee", "right_ankle") == {"right leg"}
    assert within("left_knee", "right_knee", up, 0.3) == {"trunk"}
    assert within("left_shoulder", "head", up) == set()


def _tube(middle: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and flat faces of a tube that stands around a point, 20 cm high."""
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    quads = [[k, (k + 1) % 16, 16 + k] for k in range(16)] + [[(k + 1) % 16, 16 + (k + 1) % 16, 16 + k] for k in range(16)]
    ring = middle + np.stack([radius * np.cos(angle), 0.0 * angle, radius * np.sin(angle)], axis=1)
    pos, faces = np.concatenate([ring + [0.0, 0.1, 0.0], ring - [0.0, 0.1, 0.0]]), np.array(quads)
    return pos, faces, np.pad(laid_out(torch.as_tensor(pos), torch.as_tensor(faces)).numpy(), ((0, 0), (1, 0), (0, 0)))


def _cut(faces: np.ndarray, cut: np.ndarray) -> PatternSheet:
    """A sheet of one panel, for what judges it."""
    uv, all_of = cut.reshape(-1, 2), {"tube": np.ones(len(faces), dtype=bool)}
    pos, none = np.zeros((int(faces.max()) + 1, 3)), np.zeros(0)
    return PatternSheet(pos, faces, uv, np.arange(len(uv)).reshape(-1, 3), all_of, none, none.astype(bool), {})


def test_cloth_between_two_lengths_is_not_stretched(body: Body) -> None:
    posed = posed_body(body, arms_down(0.0), 0, np.zeros(10))
    pos, faces, cut = _tube(np.array([0.0, 0.0, 3.0]), 0.12)
    made, none = Construction(elastic=np.full(faces.shape, 0.7)), np.zeros(len(pos), dtype=bool)
    cloth = build_cloth(pos, faces, Material(), dtype=torch.float64, flat=cut, made=made)
    for share, expected in ((1.0, 0.0), (0.8, 0.0), (1.2, 0.2), (0.63, 0.1)):  # of the lengths that are cut
        assert judged(cloth, _cut(faces, cut), posed, share * pos, pos, none, 0.0).strain_p99 == pytest.approx(
            expected, abs=1e-9
        )


def test_panel_seam_limb_and_girths_of_a_fault(body: Body) -> None:
    posed = posed_body(body, arms_down(0.0), 0, np.zeros(10))
    joint = dict(zip(JOINTS, joints_of(posed), strict=False))
    pos, faces, cut = _tube(joint["left_knee"], 0.05)
    cloth = build_cloth(pos, faces, Material(), dtype=torch.float64, flat=cut)
    sheet, none = replace(_cut(faces, cut), seams={"stitch 3": np.array([0, 1])}), np.zeros(len(pos), dtype=bool)
    (text, *_) = judged(cloth, sheet, posed, pos, pos, none, 0.0).faults
    assert text.endswith("pairs of triangles pass through the body near the left knee, in panel 'tube' near stitch 3")
    waist = np.array([0.0, 1.0, 0.0]) + posed.surface[:, 1].min() * np.array([0.0, 1.0, 0.0])
    wide = _tube(waist, 0.2)[0]
    rim, girth = judged(cloth, sheet, posed, wide - [0.0, 0.5, 0.0], wide, none, 0.0).girths or (0.0, 0.0)
    assert rim == pytest.approx(32 * 0.05 * np.sin(np.pi / 16))  # at rest
    assert 0.7 < girth < 0.9


def test_a_hem_may_be_above_or_below_the_arms_that_it_was_made_around(body: Body) -> None:
    posed = posed_body(body, arms_down(45.0), 0, np.zeros(10))
    chest = dict(zip(JOINTS, joints_of(posed), strict=False))["spine2"] + [0.0, 0.0, 0.02]
    (wide, faces, cut), (close, _, _) = _tube(chest, 0.7), _tube(chest, 0.25)
    cloth, none = build_cloth(wide, faces, Material(), dtype=torch.float64, flat=cut), np.zeros(len(wide), dtype=bool)
    assert limbs_in(wide[:16], posed) == {"trunk", "left arm", "right arm"}
    assert judged(cloth, _cut(faces, cut), posed, close, wide, none, 0.0).swapped == ()
    assert judged(cloth, _cut(faces, cut), posed, wide, close, none, 0.0).swapped != ()


def test_a_wide_shirt_begins_around_the_arms(tmp_path: Path, body: Body) -> None:
    path = write(tmp_path / "wide.json", tshirt(half=36, sleeve=30, hem=75))
    sheet = sheet_of(read_pattern(path), 0.05, str(path))
    posed = posed_body(body, arms_down(45.0), 0, np.zeros(10))
    start = sewing_starts(sheet, posed)[0]
    assert start.narrow < 1.0  # else its sides pass through the arms
    pos = start.placed(sheet)
    assert {frozenset({"left arm"}), frozenset({"right arm"})} <= {
        limbs_in(pos[loop], posed) for loop in boundary_loops(sheet.faces)
    }
    moved = replace(sheet, pos=sheet.pos * [1.0, 1.0, 4.0] + [0.0, 0.25, 0.0])  # far from the body
    assert np.abs(sewing_starts(moved, posed)[0].placed(moved) - pos).max() < 0.2


def test_openings_around_other_limbs_are_told(tmp_path: Path, body: Body) -> None:
    posed = posed_body(body, arms_down(0.0), 0, np.zeros(10))
    joint = dict(zip(JOINTS, joints_of(posed), strict=False))
    left, faces, cut = _tube(joint["left_knee"], 0.12)
    right = _tube(joint["left_knee"] * [-1.0, 1.0, 1.0], 0.12)[0]
    cloth = build_cloth(left, faces, Material(), dtype=torch.float64, flat=cut)
    none = np.zeros(len(left), dtype=bool)
    assert judged(cloth, _cut(faces, cut), posed, left, left, none, 0.0).swapped == ()
    told = judged(cloth, _cut(faces, cut), posed, left, right, none, 0.0)
    assert told.swapped == ("the left leg, not the right leg",) * 2
    assert told.faults == ["an opening holds the left leg, not the right leg; another the left leg, not the right leg"]

"""Loose garments that lie around the body where their file has them stay there; those that do not are still brought there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.fitting.fit_search import AskedFit, Wearer, find_placement
from hood.assets.fitting.suspicions import lies_in_place, way_there
from hood.assets.garment.binding import posed_body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence_edit import arms_down
from hood.testing import grid

Mesh = tuple[np.ndarray, np.ndarray]


def sheet(rows: int, columns: int, at: Callable[[np.ndarray, np.ndarray], list[np.ndarray]]) -> Mesh:
    """``at`` of rows and columns from 0 to 1: a rectangle of cloth, bent."""
    down, along = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    number = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = number[:-1, :-1].ravel(), number[:-1, 1:].ravel(), number[1:, 1:].ravel(), number[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack(at(down.ravel(), along.ravel()), axis=1), faces


def cape() -> Mesh:
    """A half ring of cloth behind the back, from the shoulders to the knees, wider below."""

    def at(down: np.ndarray, along: np.ndarray) -> list[np.ndarray]:
        angle = np.pi * (1 + along)
        return [(0.2 + 0.15 * down) * np.cos(angle), 0.6 - 0.95 * down, (0.13 + 0.18 * down) * np.sin(angle) - 0.03]

    return sheet(24, 24, at)


def coat() -> Mesh:
    """A sleeveless coat around the trunk, open in front."""

    def at(down: np.ndarray, along: np.ndarray) -> list[np.ndarray]:
        angle = np.pi / 2 + 0.06 + along * (2 * np.pi - 0.12)
        return [(0.185 + 0.1 * down) * np.cos(angle), 0.4 - 0.75 * down, (0.15 + 0.1 * down) * np.sin(angle) + 0.01]

    return sheet(20, 40, at)


def warmers() -> Mesh:
    """Two tubes around the arms, each the mirror image of the other; 3% of their vertices are in the skin."""
    rows, around = 16, 24
    angle = 2 * np.pi * np.arange(around) / around
    parts, faces = [], []
    for side in (-1, 1):
        for row in range(rows + 1):
            x = np.full(around, side * (0.3 + 0.35 * row / rows))
            parts.append(np.stack([x, 0.545 + 0.075 * np.cos(angle) - 0.02 * row / rows, 0.075 * np.sin(angle) - 0.03], axis=1))
        first = (len(parts) - rows - 1) * around
        for row, column in np.ndindex(rows, around):
            a, b = first + row * around + column, first + row * around + (column + 1) % around
            faces += [(a, b, b + around), (a, b + around, a + around)]
    return np.concatenate(parts), np.array(faces)


LOOSE = {"cape": cape, "coat": coat, "warmers": warmers}


@pytest.fixture(scope="module")
def wearer(body: Body) -> Wearer:
    return Wearer(lambda angle: posed_body(body, arms_down(angle), 0, np.zeros(10)).surface, body.faces)


@pytest.mark.parametrize("unit", [None, 1.0, 0.01])
@pytest.mark.parametrize("name", LOOSE)
def test_loose_garments_around_the_body_stay(wearer: Wearer, name: str, unit: float | None) -> None:
    """As they are in metres, and with their unit alone given: neither turned, nor moved, nor the arms lowered."""
    pos, faces = LOOSE[name]()
    found = find_placement(pos / (unit or 1.0), faces, wearer, AskedFit(scale=unit))
    assert found.refusal is None
    assert found.worn
    assert found.placement.keys() == [f"scale={unit or 1.0:g}", "up=y", "turn=0", "offset=[0,0,0]"]
    assert found.placement.angle == 0.0


def test_with_its_unit_alone_a_close_garment_stays_too(wearer: Wearer, garments: dict[str, Garment]) -> None:
    """A T-shirt 5% wider fits 2 cm lower, too; who says the unit has it where the file has it, with the arms that it has."""
    pos = garments["tshirt"].tpose(np.zeros(10))
    wide = pos.mean(axis=0) + 1.05 * (pos - pos.mean(axis=0))
    assert find_placement(wide, garments["tshirt"].faces, wearer, AskedFit(scale=1.0)).placement.keys()[3] == "offset=[0,0,0]"


def poncho() -> Mesh:
    """A flat cone around the neck, 1.8 m wide, which is larger than garments usually are."""

    def at(down: np.ndarray, along: np.ndarray) -> list[np.ndarray]:
        radius, angle = 0.1 + 0.75 * down, 2 * np.pi * along
        return [1.05 * radius * np.cos(angle), 0.66 - 0.1 * down, radius * np.sin(angle) - 0.02]

    pos, faces = sheet(20, 40, at)
    last = np.arange(len(pos)) % 41 == 40  # the seam: its last column is its first
    return pos, np.where(last[faces], faces - 40, faces)


def test_what_is_wider_than_usual_is_in_metres_where_it_lies_around_the_body(wearer: Wearer) -> None:
    pos, faces = poncho()
    found = find_placement(pos, faces, wearer)
    assert found.refusal is None
    assert found.placement.keys() == ["scale=1", "up=y", "turn=0", "offset=[0,0,0]"]
    assert find_placement(pos + [3.0, 0, 0], faces, wearer).refusal is not None


@pytest.mark.parametrize("shift", [(0.2, 0.2, 0.0), (0.0, 0.9, 0.0), (0.0, 0.05, -0.05)])
def test_a_loose_skirt_beside_its_place_is_brought_back(
    wearer: Wearer, garments: dict[str, Garment], shift: tuple[float, float, float]
) -> None:
    """Where the body passes through its cloth, or one of its openings is empty, it is not worn."""
    skirt = garments["skirt"]
    pos = skirt.tpose(np.zeros(10))
    found = find_placement(pos + shift, skirt.faces, wearer)
    assert found.refusal is None
    assert not found.worn
    np.testing.assert_allclose(found.placement.offset, np.negative(shift), atol=0.015)


def test_what_lies_in_place(body: Body, garments: dict[str, Garment]) -> None:
    surface = posed_body(body, arms_down(0.0), 0, np.zeros(10)).surface
    for make in LOOSE.values():
        pos, faces = make()
        assert lies_in_place(pos, faces, surface, body.faces)
        for shift in ([0, 0, 0.15], [1.0, 0, 0], [0, 1.5, 0]):
            assert not lies_in_place(pos + shift, faces, surface, body.faces)
    for garment in garments.values():
        if garment.bound:
            assert lies_in_place(garment.tpose(np.zeros(10)), garment.faces, surface, body.faces), garment.name


def test_the_way_to_the_body(body: Body) -> None:
    """A cape comes back from the side as it hung; a flat sheet lies down on the head."""
    surface = posed_body(body, arms_down(0.0), 0, np.zeros(10)).surface
    pos, faces = cape()
    np.testing.assert_allclose(way_there(pos + [3.0, 0, 0], faces, surface, body.faces), [-3.0, 0, 0], atol=0.01)
    mesh = grid(32, 32)
    flat = mesh[0] - mesh[0].mean(axis=0)
    flat = flat[:, np.argsort(-np.ptp(flat, axis=0))][:, [0, 2, 1]]
    there = flat + [2.0, 0.8, 0] + way_there(flat + [2.0, 0.8, 0], mesh[1], surface, body.faces)
    assert 0.01 < there[:, 1].min() - surface[:, 1].max() < 0.03
    assert np.abs(there.mean(axis=0)[[0, 2]]).max() < 0.1

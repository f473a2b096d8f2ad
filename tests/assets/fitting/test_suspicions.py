"""Suspicions about garments: what is meant to be caught is, and what is worn is not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.assets.body.body import Body
from hood.assets.fitting.suspicions import (
    find_openings,
    suspect_kind,
    suspect_limbs,
    suspect_place,
    suspect_seams,
    suspect_sides,
)
from hood.assets.garment.binding import posed_body
from hood.assets.garment.garment import Garment
from hood.assets.motion.load import load_sequence
from hood.scene.scene import build_scene
from hood.scene.worn import doubts, misplacement
from hood.testing import grid

#: Openings of the default garments.
OPENINGS = {"tshirt": 4, "tank": 4, "longsleeve": 4, "shorts": 3, "trousers": 3, "dress": 4, "skirt": 2}


@pytest.mark.parametrize("name", OPENINGS)
def test_nothing_is_said_of_the_default_garments(garments: dict[str, Garment], body: Body, name: str) -> None:
    garment = garments[name]
    assert find_openings(garment.tpose(np.zeros(10)), garment.faces, body.v_template, body.faces)[:2] == (OPENINGS[name], 0)
    assert suspect_seams(garment.rest_pos, garment.faces) == []
    assert suspect_kind(garment.tpose(np.zeros(10)), garment.faces, body.v_template) == []
    for motion in ("walk_proud", "stand_sway"):
        scene = build_scene(garment, body, load_sequence(motion).window(0, 2))
        assert misplacement(scene) is None
        assert doubts(scene) == []


@pytest.mark.parametrize("name", OPENINGS)
def test_default_garments_turned_over_are_inside_out(garments: dict[str, Garment], body: Body, name: str) -> None:
    garment = garments[name]
    (found,) = suspect_sides(garment.rest_pos, garment.faces[:, ::-1], body.v_template, body.faces)
    assert "is inside out" in found.what
    assert not found.grave


def test_a_sheet_and_a_garment_with_two_sides_have_no_inside(garments: dict[str, Garment], body: Body) -> None:
    pos, faces = grid(9, 9, 0.5)
    assert suspect_sides(pos + [-0.25, 1.0, -0.25], faces[:, ::-1], body.v_template, body.faces) == []
    shirt = garments["tshirt"]
    both = np.concatenate([shirt.faces, shirt.faces[:, ::-1] + len(shirt.rest_pos)])
    assert suspect_sides(np.tile(shirt.rest_pos, (2, 1)), both, body.v_template, body.faces) == []


def test_the_unit_and_the_place_of_a_body_do_not_hide_it(body: Body) -> None:
    turn = Rotation.from_euler("xy", [90, 180], degrees=True)
    for factor in (1.0, 100.0, 1000.0):
        (found,) = suspect_kind(factor * turn.apply(body.v_template) + 5.0, body.faces, body.v_template)
        assert found.grave
        assert "closed solid" in found.what


def test_a_body_with_a_hole_is_one_where_it_lies_on_the_skin(body: Body) -> None:
    open_faces = body.faces[50:]
    (found,) = suspect_kind(body.v_template, open_faces, body.v_template)
    assert "lies on the skin of the whole body" in found.what
    assert suspect_kind(body.v_template + [2.0, 0, 0], open_faces, body.v_template) == []


def test_a_garment_with_two_sides_is_no_body(garments: dict[str, Garment], body: Body) -> None:
    """A dress as modelling programs thicken it: closed, as large as half a body, and 1 cm thick."""
    from hood.mesh import topology

    dress = garments["dress"]
    scale = 1.4  # as tall as a body
    pos, faces, count = scale * dress.rest_pos, dress.faces, len(dress.rest_pos)
    corners = pos[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.zeros_like(pos)
    for corner in range(3):
        np.add.at(normal, faces[:, corner], area)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    walls = []
    for loop in topology.boundary_loops(faces):
        for a, b in zip(loop, np.roll(loop, -1), strict=True):
            walls += [[a, b, b + count], [a, b + count, a + count]]
    solid = np.concatenate([faces, faces[:, ::-1] + count, np.array(walls)])
    assert 2 * len(topology.unique_edges(solid)) == 3 * len(solid)
    assert suspect_kind(np.concatenate([pos, pos - 0.01 * normal]), solid, body.v_template) == []


def test_sheets_may_lie_anywhere_and_are_told_when_far(body: Body) -> None:
    pos, faces = grid(8, 8, 0.5)
    assert suspect_place(pos + [0.0, 0.95, 0.0], faces, body.v_template, body.faces) == []
    (found,) = suspect_place(pos + [3.0, 0.0, 0.0], faces, body.v_template, body.faces)
    assert not found.grave


def test_seams_of_some_vertices_are_no_soup(garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    torn = tank.faces.copy()
    torn[0] = np.arange(3) + len(tank.rest_pos)
    (found,) = suspect_seams(np.concatenate([tank.rest_pos, tank.rest_pos[tank.faces[0]]]), torn)
    assert not found.grave
    soup = tank.rest_pos[tank.faces].reshape(-1, 3)
    (found,) = suspect_seams(soup, np.arange(len(soup)).reshape(-1, 3))
    assert found.grave
    assert f"({len(tank.faces)} parts)" in found.what


def test_a_part_beside_the_body_is_told_by_its_number(body: Body, garments: dict[str, Garment]) -> None:
    """The garment is worn all the same: a rollout goes on."""
    tank, skirt = (garments[name].tpose(np.zeros(10)) for name in ("tank", "skirt"))
    pos = np.concatenate([tank, skirt + [2.0, 0.0, 0.0]])
    faces = np.concatenate([garments["tank"].faces, garments["skirt"].faces + len(tank)])
    (found,) = suspect_place(pos, faces, body.v_template, body.faces)
    assert f"part 2 of 2, {len(skirt)} vertices from {len(tank)} on, does not surround the body" in found.what
    assert not found.grave
    assert suspect_place(np.concatenate([tank, skirt]), faces, body.v_template, body.faces) == []


def beside(garment: Garment, way: float) -> Garment:
    """The garment as a file would have it, moved ``way`` [m] along x."""
    pos = garment.tpose(np.zeros(10)) + [way, 0.0, 0.0]
    return Garment(garment.name, pos, garment.faces, np.zeros(len(pos), dtype=bool))


@pytest.mark.parametrize("way", [-0.13, 0.1])
@pytest.mark.parametrize("name", ["tank", "tshirt", "longsleeve", "dress"])
def test_a_garment_with_the_head_in_an_armhole_is_beside_the_body(
    garments: dict[str, Garment], body: Body, name: str, way: float
) -> None:
    moved = beside(garments[name], way)
    (found,) = suspect_place(moved.rest_pos, moved.faces, body.v_template, body.faces)
    assert found.grave
    assert f"is {100 * abs(way):.0f} cm beside the body" in found.what
    for motion in ("walk_proud", "stand_sway"):  # a pose to walk in is no mirror image of itself
        worn = misplacement(build_scene(moved, body, load_sequence(motion).window(30, 32)))
        assert worn is not None
        assert worn.grave


def test_a_part_beside_the_body_is_told_by_its_vertices(garments: dict[str, Garment], body: Body) -> None:
    tank, skirt = beside(garments["tank"], 0.1), garments["skirt"].tpose(np.zeros(10))
    faces = np.concatenate([garments["skirt"].faces, tank.faces + len(skirt)])
    (found,) = suspect_limbs(np.concatenate([skirt, tank.rest_pos]), faces, body.v_template, body.faces)
    assert f"has a part, of {len(tank.rest_pos)} vertices from {len(skirt)} on, that is 10 cm beside" in found.what


def without(garment: Garment, way: float, gone: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The moved garment without the faces ``gone`` (F,)."""
    used, corners = np.unique(garment.faces[~gone], return_inverse=True)
    return beside(garment, way).rest_pos[used], corners.reshape(-1, 3)


def test_other_garments_are_not_beside_the_body(garments: dict[str, Garment], body: Body) -> None:
    """Those that lie near their place; those without a plane of symmetry, or with few openings, or on a body that walks."""
    middles = {name: garment.tpose(np.zeros(10))[garment.faces].mean(axis=1) for name, garment in garments.items()}
    one_shoulder = (middles["tank"][:, 0] < 0.02) & (middles["tank"][:, 1] > 0.47 + 0.3 * middles["tank"][:, 0])
    tube = np.abs(middles["longsleeve"][:, 0] - 0.35) > 0.1
    cases = {
        "near": without(garments["tank"], 0.05, np.zeros(len(garments["tank"].faces), dtype=bool)),
        "one sleeve": without(garments["longsleeve"], 0.0, middles["longsleeve"][:, 0] > 0.22),
        "one sleeve, moved": without(garments["longsleeve"], 0.1, middles["longsleeve"][:, 0] > 0.22),
        "one shoulder": without(garments["tank"], 0.0, one_shoulder),
        "around an arm": without(garments["longsleeve"], 0.0, tube),
        "two openings": without(garments["skirt"], 0.1, np.zeros(len(garments["skirt"].faces), dtype=bool)),
        "a cape": (grid(9, 9, 0.5)[0] + [0.3, 0.2, -0.2], grid(9, 9, 0.5)[1]),
    }
    for name, (pos, faces) in cases.items():
        assert suspect_limbs(pos, faces, body.v_template, body.faces) == [], name
    walking = posed_body(body, load_sequence("walk_proud"), 30, np.zeros(10))
    tank = beside(garments["tank"], 0.13)
    assert suspect_limbs(tank.rest_pos, tank.faces, walking.surface, walking.faces) == []

"""The search for a garment's placement, and the misfit that it lowers."""

from __future__ import annotations

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.fitting.fit_search import AskedFit, Wearer, find_placement
from hood.assets.fitting.placement import possible
from hood.assets.fitting.skin_field import WIDTH, SkinField, misfit, settle_field
from hood.assets.garment.binding import posed_body, signed_distances
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence_edit import arms_down
from hood.testing import cylinder


@pytest.fixture(scope="module")
def wearer(body: Body) -> Wearer:
    return Wearer(lambda angle: posed_body(body, arms_down(angle), 0, np.zeros(10)).surface, body.faces)


def worn(garment: Garment, body: Body, angle: float, betas: np.ndarray = np.zeros(10)) -> np.ndarray:  # noqa: B008
    assert garment.lbs_weights is not None
    points = np.concatenate([garment.tpose(betas), np.ones((len(garment.rest_pos), 1))], axis=1)
    transforms = posed_body(body, arms_down(angle), 0, betas).transforms
    return np.asarray(np.einsum("vj,jab,vb->va", garment.lbs_weights, transforms, points))


def test_sampled_distances_are_those_to_the_surface(wearer: Wearer, garments: dict[str, Garment]) -> None:
    skin, points = wearer.skin(0.0), garments["dress"].tpose(np.zeros(10))
    measured = skin.measure(points)
    exact = signed_distances(points, skin.surface, skin.faces)
    assert np.abs(measured.dist - exact).max() < 5e-3
    assert np.median(np.abs(measured.dist - exact)) < 5e-4
    step = 1e-4 * measured.normal
    near = exact < 0.03
    slope = (signed_distances(points + step, skin.surface, skin.faces) - exact) / 1e-4
    assert (slope[near] > 0.8).mean() > 0.95


@pytest.mark.parametrize("name", ["tank", "tshirt", "longsleeve", "dress", "trousers", "shorts", "skirt"])
def test_the_misfit_is_least_where_a_garment_belongs(wearer: Wearer, garments: dict[str, Garment], name: str) -> None:
    skin, points = wearer.skin(0.0), garments[name].tpose(np.zeros(10))
    here = misfit(skin.measure(points))
    for shift in np.concatenate([np.eye(3), -np.eye(3)]):
        assert misfit(skin.measure(points + 0.04 * shift)) > here + 0.01
    start = np.array([0.02, -0.015, 0.01])
    assert np.abs(start + settle_field(points + start, skin, WIDTH, 15)).max() < 0.01


@pytest.mark.parametrize("name", ["tank", "dress", "trousers", "skirt"])
@pytest.mark.parametrize("shape", [(0, 2.0), (1, 2.0), (4, -2.0)])
def test_the_place_is_right_on_bodies_of_other_shapes(
    body: Body, garments: dict[str, Garment], name: str, shape: tuple[int, float]
) -> None:
    """Whatever the cut, and however low the arms hang that no sleeve tells of."""
    betas = np.eye(10)[shape[0]] * shape[1]
    other = Wearer(lambda angle: posed_body(body, arms_down(angle), 0, betas).surface, body.faces)
    for angle in (0.0, 70.0):
        pos = worn(garments[name], body, angle, betas)
        found = find_placement(pos, garments[name].faces, other, AskedFit(1.0, "y", 0.0))
        moved = find_placement(pos - [3.0, 2.0, 0.0], garments[name].faces, other, AskedFit(1.0, "y", 0.0))
        assert not found.placement.offset.any()
        assert np.linalg.norm(moved.placement.offset - [3.0, 2.0, 0.0]) < 0.01


def test_correlation_finds_the_place_from_anywhere(wearer: Wearer, garments: dict[str, Garment]) -> None:
    points = garments["tank"].tpose(np.zeros(10)) + [7.0, -2.0, 40.0]
    value, offset = SkinField(wearer.skin(0.0)).peaks(points, 1)[0]
    assert np.abs(offset + [7.0, -2.0, 40.0]).max() < 0.05
    assert 0.5 < value <= 1.0


@pytest.mark.parametrize("angle", [0.0, 30.0, 45.0, 65.0])
def test_the_angle_of_the_arms_is_found(wearer: Wearer, garments: dict[str, Garment], body: Body, angle: float) -> None:
    for name in ("longsleeve", "tshirt"):
        found = find_placement(worn(garments[name], body, angle), garments[name].faces, wearer, AskedFit(1.0, "y", 0.0))
        assert abs(found.placement.angle - angle) <= 3.0
        assert found.refusal is None


def test_what_lies_where_it_belongs_stays(wearer: Wearer, garments: dict[str, Garment]) -> None:
    """Not by a millimetre, sleeveless garments around the T-pose."""
    for name in ("skirt", "dress"):
        found = find_placement(garments[name].tpose(np.zeros(10)), garments[name].faces, wearer)
        assert found.placement.keys() == ["scale=1", "up=y", "turn=0", "offset=[0,0,0]"]
        assert found.placement.angle == 0.0
        assert found.refusal is None


def test_a_loose_tube_stays_where_its_file_has_it_and_nowhere_else(wearer: Wearer) -> None:
    pos, faces = cylinder(24, 10, radius=0.25, height=0.3)
    around = find_placement(pos + [0, 0.05, 0], faces, wearer)
    assert around.refusal is None
    assert not around.placement.offset.any()
    assert find_placement(pos + [5.0, 0, 0], faces, wearer).refusal is not None


def test_strays_change_nothing(wearer: Wearer, garments: dict[str, Garment]) -> None:
    tank, asked = garments["tank"], AskedFit(up="y", turn=0.0)
    pos = tank.rest_pos + [0.0, 0.8, 0.0]
    found = find_placement(pos, tank.faces, wearer, asked)
    stray = find_placement(np.concatenate([pos, [[1e3, 0, 0]]]), tank.faces, wearer, asked)
    np.testing.assert_array_equal(found.placement.offset, stray.placement.offset)
    assert found.misfit == stray.misfit


def test_what_no_unit_makes_wearable_is_refused(wearer: Wearer, garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    assert "fits no unit" in str(find_placement(1e6 * tank.rest_pos, tank.faces, wearer).refusal)
    assert "no face has an area" in str(find_placement(0 * tank.rest_pos, tank.faces, wearer).refusal)


@pytest.mark.parametrize("unit", [1.0, 0.1, 0.0254, 0.01, 0.001])
def test_the_unit_is_among_the_possible_ones(garments: dict[str, Garment], body: Body, unit: float) -> None:
    for garment in garments.values():
        assert unit in possible(garment.tpose(np.zeros(10)) / unit, body.v_template)

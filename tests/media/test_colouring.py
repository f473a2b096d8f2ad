"""Values on the garment: what they are, which colour they get, what the bar says."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.media.colouring import colouring_of, skin_distance, vertex_strain
from hood.media.film import Film
from hood.mesh.flat import Construction
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.file.recorder import still_of
from hood.testing import cylinder, sphere

needs_pillow = pytest.mark.skipif(importlib.util.find_spec("PIL") is None, reason="needs Pillow")
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@pytest.fixture(scope="module")
def data() -> RolloutData:
    """A tube about a ball, three frames, wider from frame to frame; rg rises by a factor of ten."""
    pos, faces = cylinder(24, 6, 0.3, 0.5)
    ball, ball_faces = sphere(2, 0.25)
    wider = np.array([[1.0, 1.0, 1.0], [1.1, 1.0, 1.1], [1.2, 1.0, 1.2]])
    rg = np.repeat([[np.nan], [0.1], [1.0]], len(pos), axis=1).astype(np.float32)
    body = np.repeat((ball + [0.0, 0.25, 0.0])[None], 3, axis=0)
    return RolloutData(pos * wider[:, None], faces, pos, body, ball_faces, np.arange(3) / 30, {}, {}, {"rg": rg})


def test_strain_of_vertices_is_the_largest_around_them(data: RolloutData) -> None:
    strain = vertex_strain(data)
    assert strain.shape == data.cloth_pos.shape[:2]
    np.testing.assert_allclose(strain[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(strain[1:], [[0.1], [0.2]] * np.ones(strain.shape[1]), rtol=1e-6)
    one = data.cloth_pos.copy()
    one[0, 70] *= 1.001
    assert set(np.flatnonzero(vertex_strain(replace(data, cloth_pos=one))[0] > 1e-9)) >= {70, 69, 71}
    one[0, 70] = np.nan
    assert np.isnan(vertex_strain(replace(data, cloth_pos=one))[0, [69, 70]]).all()


def test_strain_of_elastic_is_against_its_rest_not_its_cut() -> None:
    """What a rollout's file keeps of elastic is the lengths of its edges."""
    pos, faces = cylinder(12, 4, 0.1, 0.2)
    made = Construction(elastic=np.full(faces.shape, 0.8))
    garment = Garment("tube", pos, faces, np.zeros(len(pos), dtype=bool), elastic=made.elastic)
    still = still_of(garment, cloth=build_cloth(pos, faces, Material(), made=made))
    none = np.zeros((2, 0, 3)), np.empty((0, 3), dtype=np.int64)
    data = RolloutData(np.stack([0.8 * pos, pos]), faces, pos, *none, np.arange(2) / 30, {}, {}, still=still)
    np.testing.assert_allclose(vertex_strain(data)[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(vertex_strain(data)[1], 0.25, atol=1e-6)


def test_a_range_for_all_frames(data: RolloutData) -> None:
    strain = colouring_of(data, "strain")
    assert strain is not None
    assert (strain.low, strain.high) == (0.0, 0.2)
    assert [label for _, label in strain.ticks] == ["0%", "10%", "20%"]
    rg = colouring_of(data, "rg")
    assert rg is not None
    assert (rg.low, rg.high) == (1e-4, 1.0)
    assert [label for _, label in rg.ticks] == ["0.0001", "0.001", "0.01", "0.1", "1"]
    assert colouring_of(data, "none") is None


def test_contact_is_the_distance_from_the_body(data: RolloutData) -> None:
    """The tube stands 5 cm off the ball's equator and farther elsewhere; cloth on the ball itself touches it."""
    far, near = skin_distance(data), skin_distance(replace(data, cloth_pos=data.body_pos))
    reference = np.linalg.norm(data.cloth_pos - [0.0, 0.25, 0.0], axis=2) - 0.25
    assert np.abs(far - reference).max() < 0.01  # the ball is a polyhedron
    assert np.abs(near).max() < 1e-9
    blown = data.cloth_pos.copy()
    blown[1, 3] = np.inf
    assert np.isnan(skin_distance(replace(data, cloth_pos=blown))).all(axis=1).tolist() == [False, True, False]
    colouring = colouring_of(replace(data, cloth_pos=data.body_pos), "contact")
    assert colouring is not None
    touching = replace(colouring, values=np.linspace(0.03, -0.01, 50)[None]).colours(0) @ LUMINANCE
    assert (np.diff(touching) <= 1e-12).all()
    assert touching[0] - touching[-1] > 0.8
    assert [label for _, label in colouring.ticks] == ["20 mm", "10 mm", "0 mm"]
    with pytest.raises(ValueError, match="the rollout has no body"):
        colouring_of(replace(data, body_faces=np.empty((0, 3), dtype=np.int64)), "contact")


def test_rollouts_side_by_side_share_their_range(data: RolloutData) -> None:
    calm = replace(data, cloth_pos=data.cloth_pos[:1].repeat(3, 0), fields={"rg": 1e-2 * data.fields["rg"]})
    for colour in ("strain", "rg"):
        first, second = colouring_of(data, colour, [calm]), colouring_of(calm, colour, [data])
        assert first is not None
        assert second is not None
        assert (first.low, first.high, first.ticks) == (second.low, second.high, second.ticks)
        assert (first.colours(2) @ LUMINANCE).mean() < (second.colours(2) @ LUMINANCE).mean()


def test_colours_get_darker_and_the_unknown_is_grey(data: RolloutData) -> None:
    colouring = colouring_of(data, "rg")
    assert colouring is not None
    before, low, high = (colouring.colours(frame)[0] for frame in range(3))
    assert before.max() - before.min() < 0.06
    assert low @ LUMINANCE > high @ LUMINANCE
    ramp = replace(colouring, values=np.geomspace(1e-5, 10.0, 200)[None])
    brightness = ramp.colours(0) @ LUMINANCE
    assert (np.diff(brightness) <= 1e-12).all()
    assert ramp.colours(0).min() >= 0
    assert ramp.colours(0).max() <= 1
    zero = replace(colouring, values=np.zeros((1, 3))).colours(0)
    np.testing.assert_array_equal(zero, ramp.colours(0)[:1].repeat(3, 0))


def test_what_cannot_be_shown_is_refused(data: RolloutData) -> None:
    with pytest.raises(ValueError, match=r"no cloth/rg; simulate it with metrics={fields:\[rg\]}"):
        colouring_of(replace(data, fields={}), "rg")
    with pytest.raises(ValueError, match="colour is 'heat'; choose none, strain, rg or contact"):
        colouring_of(data, "heat")


@needs_pillow
def test_pictures_show_the_colours_and_the_bar(data: RolloutData) -> None:
    plain = Film(data, 120, 160).frame(2)
    for colour in ("strain", "rg"):
        film = Film(data, 120, 160, colour=colour)
        early, late = film.frame(0).astype(int), film.frame(2).astype(int)
        assert early.shape == plain.shape
        # The middle of the picture is cloth: dark and red at the end of the scale.
        assert late[60:100, 50:70].mean() < early[60:100, 50:70].mean() - 30
        assert np.abs(late - plain.astype(int))[60:100, 50:70].mean() > 20
        # The bar runs from light to dark along the lower edge, the same in all frames.
        rows = late[140:150, 14:106].sum(axis=2)
        bar = rows[np.argmax(rows[:, 0] - rows[:, -1])]
        assert bar[0] > bar[-1] + 300
        assert np.mean(np.diff(bar) <= 0) > 0.9

"""Sizes of garments: factors of the rest shape and how they change."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import build_cloth
from hood.scene.scene import build_scene
from hood.scene.sizing import Sizes, resized, sizes_of
from hood.testing import cylinder

F64 = torch.float64


@pytest.mark.parametrize("factors", [(1.2, 1.2, 1.2), (1.0, 1.1, 0.9)])
def test_a_cloth_that_has_grown_is_one_that_was_made_so(factors):
    pos, faces = cylinder(9, 5)
    before, now = (0.9, 0.9, 0.9), factors
    start = build_cloth(pos * before, faces, Material(), dtype=F64)
    grown, made = resized(start, before, now), build_cloth(pos * now, faces, Material(), dtype=F64)
    for spec in fields(made):
        a, b = getattr(grown, spec.name), getattr(made, spec.name)
        if isinstance(b, torch.Tensor) and b.is_floating_point():
            torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-12, msg=spec.name)
    assert grown.faces is start.faces  # what is known of a topology is found by it
    assert grown.hinges is start.hinges


def test_sizes_change_without_a_jerk():
    sizes = sizes_of(0.9, [1.1, 1.2, 1.3], 2.0)
    assert sizes.at(-1.0) == sizes.at(0.0) == (0.9, 0.9, 0.9)
    assert sizes.at(2.0) == sizes.at(9.0) == (1.1, 1.2, 1.3)
    np.testing.assert_allclose(sizes.at(1.0), [1.0, 1.05, 1.1])
    time = np.linspace(-0.5, 2.5, 3001)
    curve = np.array([sizes.at(float(t))[0] for t in time])
    speed = np.gradient(curve, time)
    acceleration = np.gradient(speed, time)
    assert (speed >= -1e-12).all()
    assert np.abs(np.diff(acceleration)).max() < 0.01 * np.abs(acceleration).max()


def test_the_cloth_of_a_scene_follows(garments: dict[str, Garment], body: Body, walk: PoseSequence):
    scene = build_scene(garments["tank"], body, walk, size=sizes_of(0.9, 1.1, 4 / 30))
    whole = build_scene(garments["tank"], body, walk, size=1.1)
    assert scene.cloth_at(7, start=7) is scene.cloth
    torch.testing.assert_close(scene.cloth_at(11, start=7).rest_area, whole.cloth.rest_area, rtol=1e-5, atol=0)
    halfway = scene.cloth_at(2).rest_area.sum() / whole.cloth.rest_area.sum()
    assert float(halfway) == pytest.approx((1.0 / 1.1) ** 2, rel=1e-5)
    assert whole.cloth_at(50) is whole.cloth


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((0.0,), "size is 0; give a factor of the garment, 0.2 to 5"),
        (([1.0, 2.0],), r"size is \[1.0, 2.0\]; give one factor, such as 1.1, or three"),
        ((1.0, float("nan")), "size is nan; give a factor"),
        ((1.0, 1.1, 0.0), "changes within 0.0 s; give seconds > 0"),
    ],
)
def test_what_is_no_size_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        sizes_of(*given)


def test_the_default_is_the_size_that_there_is():
    assert sizes_of(1.0) == Sizes()
    assert not Sizes().changing

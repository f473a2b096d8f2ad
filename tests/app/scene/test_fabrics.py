"""Fabrics of a rollout, part by part."""

from __future__ import annotations

import numpy as np
import pytest

from hood.app.scene.fabrics import checked_fabrics, fabric_named
from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import make_scene
from hood.assets.material import FaceField


def test_parts_of_a_dress_have_their_fabrics_in_the_scene() -> None:
    words = ["garment=dress", "fabrics={below_waistband:silk,above_waistband:denim}", "num_frames=3"]
    cloth = make_scene(RolloutSettings.from_words(words)).cloth
    silk, denim = fabric_named("silk"), fabric_named("denim")
    below = np.isclose(cloth.density.numpy(), silk.density)
    np.testing.assert_allclose(cloth.density.numpy()[~below], denim.density, rtol=1e-6)
    np.testing.assert_allclose(cloth.lame_mu.numpy()[below], silk.lame_mu, rtol=1e-6)
    assert 0.3 < below.mean() < 0.9
    # One of the two in a hinge inside a part, between them on the seam.
    stiffness = cloth.bending_stiffness.numpy()
    inside = np.isclose(stiffness, silk.bending_stiffness) | np.isclose(stiffness, denim.bending_stiffness)
    assert 0.9 < inside.mean() < 1.0
    np.testing.assert_allclose(stiffness[~inside], 0.5 * (silk.bending_stiffness + denim.bending_stiffness), rtol=1e-5)


def test_without_parts_the_fabric_is_that_of_the_option() -> None:
    cloth = make_scene(RolloutSettings.from_words(["garment=tank", "material=jersey", "num_frames=3"])).cloth
    assert not isinstance(fabric_named("jersey").density, FaceField)
    np.testing.assert_allclose(cloth.density.numpy(), 0.16, rtol=1e-6)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("fabrics=silk", "fabrics=silk: give fabrics by part"),
        ("fabrics={dress:slik}", "fabrics: dress: unknown material 'slik': did you mean 'silk'"),
        ("fabrics={dress:0.3}", "give fabrics by part"),
        ("fabrics={dress:{material:slik}}", "fabrics: dress: unknown material 'slik'"),
        ("fabrics={dress:{frictoin:2}}", "fabrics: dress: unknown property 'frictoin': did you mean 'friction'"),
        ("fabrics={dress:{woven:true}}", "fabrics: dress: woven is for measured cloth by its name"),
        ("fabrics={dress:{material:denim,woven:true}}", "woven is for measured cloth by its name"),
        ("fabrics={dress:{wrap:2}}", "fabrics: dress: unknown property 'wrap': did you mean 'warp'"),
        ("fabrics={dress:{friction:high}}", "fabrics: dress: friction is 'high'; give a number"),
    ],
)
def test_what_is_no_table_of_fabrics_is_refused(word: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        checked_fabrics(RolloutSettings.from_words([word]))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["fabrics={dress:silk}", "fabrics_seam=-0.1"], "fabrics_seam=-0.1: give metres"),
        (["fabrics={dress:silk}", "fabrics_seam=wide"], "fabrics_seam=wide: give a number"),
        (["fabrics_seam=0.03"], "fabrics_seam=0.03: is between fabrics; give fabrics="),
    ],
)
def test_what_is_no_width_of_a_seam_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_scene(RolloutSettings.from_words(["num_frames=3", *words]))


def test_a_seam_may_be_wide() -> None:
    words = ["garment=dress", "fabrics={below_waistband:{density:0.6}}", "num_frames=3"]
    sharp, wide = (make_scene(RolloutSettings.from_words([*words, *more])).cloth for more in ([], ["fabrics_seam=0.2"]))
    between = (wide.density > wide.density.min() + 1e-3) & (wide.density < wide.density.max() - 1e-3)
    assert not ((sharp.density > sharp.density.min() + 1e-3) & (sharp.density < sharp.density.max() - 1e-3)).any()
    assert 0.05 < float(between.float().mean()) < 0.6
    assert float(wide.mass.sum()) == pytest.approx(float(sharp.mass.sum()), rel=0.02)


def test_a_part_may_have_properties_of_its_own() -> None:
    words = ["garment=dress", "fabrics={below_waistband:{friction:3},above_waistband:{material:denim,density:0.3}}"]
    cloth = make_scene(RolloutSettings.from_words([*words, "num_frames=3"])).cloth
    above = np.isclose(cloth.density.numpy(), 0.3)
    default, denim = fabric_named("default"), fabric_named("denim")
    stiffened = make_scene(RolloutSettings.from_words(["garment=dress", "num_frames=3"])).cloth.lame_mu.numpy()
    expected = stiffened * np.where(above, denim.lame_mu, default.lame_mu) / default.lame_mu
    np.testing.assert_allclose(cloth.lame_mu.numpy(), expected, rtol=1e-5)
    friction = cloth.friction.numpy()
    assert ((friction >= 1) & (friction <= 3 + 1e-6)).all()
    inside = np.isclose(friction, 1) | np.isclose(friction, 3)
    assert 0.9 < inside.mean() < 1.0


def test_a_property_of_a_part_is_checked() -> None:
    with pytest.raises(ValueError, match="material 'friction' is -1.0; it must be finite and >= 0"):
        checked_fabrics(RolloutSettings.from_words(["fabrics={dress:{friction:-1}}"]))


def test_a_part_may_be_woven_and_the_rest_is_isotropic() -> None:
    words = ["garment=dress", "fabrics={below_waistband:{material:linen,woven:true},above_waistband:silk}", "num_frames=3"]
    cloth = make_scene(RolloutSettings.from_words(words)).cloth
    linen = fabric_named("linen", True)
    below = np.isclose(cloth.density.numpy(), linen.density)
    assert 0.3 < below.mean() < 0.9
    assert cloth.weave is not None
    np.testing.assert_allclose(cloth.weave.numpy()[below], [[linen.warp, linen.weft, 1.0]] * int(below.sum()), rtol=1e-6)
    assert (cloth.weave.numpy()[~below] == 1.0).all()


def test_keys_of_the_material_make_it_woven() -> None:
    cloth = make_scene(
        RolloutSettings.from_words(["garment=tank", "material.warp=3", "material.shear=0.5", "num_frames=3"])
    ).cloth
    assert cloth.weave is not None
    assert cloth.weave.unique(dim=0).tolist() == [[3.0, 1.0, 0.5]]
    linen = make_scene(
        RolloutSettings.from_words(["garment=tank", "material=linen", "material.woven=true", "num_frames=3"])
    ).cloth
    assert linen.weave is not None
    assert make_scene(RolloutSettings.from_words(["garment=tank", "material=linen", "num_frames=3"])).cloth.weave is None
    with pytest.raises(ValueError, match="material 'warp' is 0.0; it must be finite and > 0"):
        make_scene(RolloutSettings.from_words(["garment=tank", "material.warp=0", "num_frames=3"]))

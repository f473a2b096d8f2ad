"""Fabrics: what is refused, and what training draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hood.assets.material import RANGES, EdgeField, FaceField, Material, sample_material


def test_default_is_inside_the_training_ranges() -> None:
    for name, (low, high) in RANGES.items():
        assert low <= getattr(Material(), name) <= high


@pytest.mark.parametrize(
    "name, value, rule",
    [
        ("density", 0.0, "> 0"),
        ("density", float("nan"), "finite"),
        ("lame_mu", -1.0, "> 0"),
        ("lame_lambda", float("inf"), "finite"),
        ("bending_stiffness", -1e-9, ">= 0"),
        ("thickness", 0.0, "> 0"),
        ("friction", -0.1, ">= 0"),
        ("warp", 0.0, "> 0"),
        ("weft", -2.0, "> 0"),
        ("shear", float("nan"), "finite"),
    ],
)
def test_unphysical_values_are_refused(name: str, value: float, rule: str) -> None:
    with pytest.raises(ValueError, match=f"material '{name}'.*{rule}"):
        replace(Material(), **{name: value})


def test_a_bad_entry_of_a_field_is_named() -> None:
    field = np.full(9, 0.2)
    field[6] = -1.0
    with pytest.raises(ValueError, match="material 'density' is -1.0 at vertex 6"):
        Material(density=field)
    with pytest.raises(ValueError, match="material 'thickness' is -1.0 at face 6; it must be finite and > 0"):
        Material(thickness=FaceField(field))
    with pytest.raises(ValueError, match="material 'bending_stiffness' is -1.0 at edge 6; it must be finite and >= 0 J"):
        Material(bending_stiffness=EdgeField(field))
    with pytest.raises(ValueError, match="material 'density' is -1.0; it must be finite and > 0"):
        Material(density=-1.0)


def test_negative_lambda_is_legal_while_the_sum_is_positive() -> None:
    Material(lame_mu=100.0, lame_lambda=-50.0)
    with pytest.raises(ValueError, match="lame_mu \\+ lame_lambda is 0.0; .*raise 'lame_lambda'"):
        Material(lame_mu=100.0, lame_lambda=-100.0)
    both = np.array([100.0, 100.0, 100.0]), np.array([0.0, -50.0, -150.0])
    with pytest.raises(ValueError, match="lame_mu \\+ lame_lambda is -50.0 at face 2"):
        Material(lame_mu=FaceField(both[0]), lame_lambda=FaceField(both[1]))
    with pytest.raises(ValueError, match="lame_mu \\+ lame_lambda is -50.0 at edge 2"):
        Material(lame_mu=100.0, lame_lambda=EdgeField(both[1]))
    Material(lame_mu=FaceField(both[0]), lame_lambda=both[1])  # where they meet is the cloth's business


def test_zero_bending_is_legal() -> None:
    assert Material(bending_stiffness=0.0).bending_stiffness == 0.0


def test_samples_are_log_uniform_in_the_ranges() -> None:
    rng = np.random.default_rng(0)
    samples = [sample_material(rng) for _ in range(2000)]
    for name, (low, high) in RANGES.items():
        values = np.log([getattr(sample, name) for sample in samples])
        assert np.log(low) <= values.min()
        assert values.max() <= np.log(high)
        middle, spread = (np.log(low) + np.log(high)) / 2, np.log(high / low)
        assert values.mean() == pytest.approx(middle, abs=0.03 * spread)
        assert values.std() == pytest.approx(spread / np.sqrt(12), rel=0.05)


def test_same_seed_same_fabric() -> None:
    pos = np.random.default_rng(1).normal(size=(40, 3))
    first, second, other = (sample_material(np.random.default_rng(seed), pos, 1.0) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.density, second.density)
    assert not np.array_equal(first.density, other.density)


def test_piecewise_fabrics_are_regions_with_one_fabric_each() -> None:
    pos = np.stack([np.linspace(0, 1, 200), np.zeros(200), np.zeros(200)], axis=1)
    for seed in range(20):
        fabric = sample_material(np.random.default_rng(seed), pos, piecewise_fraction=1.0)
        assert fabric.density.shape == (200,)
        pieces = np.unique(fabric.density)
        assert 2 <= len(pieces) <= 3
        # Regions on a line are intervals, and all properties change together.
        borders = np.flatnonzero(np.diff(fabric.density))
        assert len(borders) == len(pieces) - 1
        np.testing.assert_array_equal(borders, np.flatnonzero(np.diff(fabric.lame_mu)))


def test_share_of_piecewise_fabrics() -> None:
    rng, pos = np.random.default_rng(0), np.random.default_rng(1).normal(size=(30, 3))
    share = np.mean([isinstance(sample_material(rng, pos, 0.3).density, np.ndarray) for _ in range(1000)])
    assert share == pytest.approx(0.3, abs=0.05)

"""The picture of the drape test."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hood.evaluation.drape import DISC, PIXEL, DrapedRest
from hood.media.bars import write_shadows

Image = pytest.importorskip("PIL.Image")
pytest.importorskip("matplotlib")


def test_every_fabric_has_a_panel_and_dark_is_what_the_shadow_covers(tmp_path: Path) -> None:
    half = 330
    centre = (np.arange(-half, half) + 0.5) * PIXEL
    radius = np.hypot(*np.meshgrid(centre, centre))
    small = DrapedRest(0.0, 0, 0.0, np.zeros((0, 3)), radius < DISC, True)
    large = replace(small, coefficient=0.6, folds=6, shadow=radius < 0.13)
    for name, states in {
        "one": {"a": small},
        "six": {str(k): small for k in range(6)},
        "two": {"a": small, "b": large},
    }.items():
        write_shadows(states, tmp_path / f"{name}.png")
    one, two, six = (Image.open(tmp_path / f"{name}.png").convert("RGB") for name in ("one", "two", "six"))
    assert two.width == 2 * one.width
    assert (six.width, six.height) == (5 * one.width, 2 * one.height)
    pixels = np.asarray(two).astype(int)
    dark = (np.abs(pixels - (0x34, 0x5C, 0x8E)).sum(axis=2) < 60).sum(axis=0)
    left, right = dark[: two.width // 2].sum(), dark[two.width // 2 :].sum()
    assert right / left == pytest.approx((0.13 / DISC) ** 2, rel=0.08)

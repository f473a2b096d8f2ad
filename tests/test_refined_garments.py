"""Garments of more vertices than are shipped, which benchmarks make: they can be worn."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from hood.assets.garment.garment import load_garment
from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.scene.scene import build_scene

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.parametrize("name", ["dress", "longsleeve"])
def test_a_refined_garment_is_worn_like_the_one_it_comes_from(name, body):
    refined = runpy.run_path(str(BENCHMARKS / "frame.py"))["refined"]
    whole = load_garment(name)
    finer = refined(whole, len(whole.rest_pos) + 200)
    assert len(finer.rest_pos) == len(whole.rest_pos) + 200
    starts = [
        build_scene(garment, body, load_sequence("walk_proud"), Material()).start(0, relaxed=False).pos.numpy()
        for garment in (whole, finer)
    ]
    assert np.abs(starts[1][: len(starts[0])] - starts[0]).max() < 0.02

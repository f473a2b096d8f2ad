"""Scenes to train on: one tank top on three seconds of a walk."""

from __future__ import annotations

import pytest

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.training.scenes import SceneSampler


@pytest.fixture(scope="session")
def sampler(body: Body, garments: dict[str, Garment], walk: PoseSequence) -> SceneSampler:
    return SceneSampler(body, [garments["tank"]], [walk.window(0, 90)])

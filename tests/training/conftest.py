"""Scenes to train on: one tank top on three seconds of a walk."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hood.assets.body.body import Body
from hood.assets.files.said import listening
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.cli.main import aloud
from hood.training.scenes import SceneSampler


@pytest.fixture(scope="session")
def sampler(body: Body, garments: dict[str, Garment], walk: PoseSequence) -> SceneSampler:
    return SceneSampler(body, [garments["tank"]], [walk.window(0, 90)])


@pytest.fixture(autouse=True)
def said_aloud() -> Iterator[None]:
    """What is said is printed, as the command line does."""
    with listening(aloud):
        yield

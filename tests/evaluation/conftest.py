"""A scene small enough for minimisations: a band of 80 vertices that hangs from the waist."""

from __future__ import annotations

import pytest

from hood.assets.body import Body
from hood.assets.garment import Garment
from hood.assets.sequence import PoseSequence
from hood.scene.scene import Scene, build_scene
from hood.testing import cylinder


@pytest.fixture(scope="session")
def band_scene(body: Body, walk: PoseSequence) -> Scene:
    """The upper rim is pinned; 12 frames in the middle of the walk."""
    pos, faces = cylinder(16, 5, 0.21, 0.12)
    pos = pos + [0.0, -0.05, 0.02]
    return build_scene(Garment("band", pos, faces, pos[:, 1] > 0.069), body, walk.window(60, 72))

"""Shared assets, loaded once: they are frozen, so tests may share them."""

from __future__ import annotations

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.assets.files.library import DATA_FOLDER
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import PoseSequence
from hood.mesh import cloth_proximity
from hood.native.build import LIBRARIES, BuildError, keep
from hood.scene.scene import Scene, build_scene
from hood.testing import cylinder

GARMENT_NAMES = ("tshirt", "tank", "longsleeve", "shorts", "trousers", "dress", "skirt")

torch.set_num_threads(1)
#: Where compiled libraries are kept while the tests run: nothing is left in the user's folder.
_KEPT = pytest.StashKey[tempfile.TemporaryDirectory[str]]()


def pytest_configure(config: pytest.Config) -> None:
    """Where several processes run the tests, the libraries are compiled before, on all cores; else each when it is needed."""
    if hasattr(config, "workerinput"):
        return
    config.stash[_KEPT] = folder = tempfile.TemporaryDirectory(prefix="hood_tests_")
    os.environ["HOOD_CACHE"] = folder.name
    if not getattr(config.option, "numprocesses", None):
        return
    with ThreadPoolExecutor() as pool:
        for made in [pool.submit(keep, *library) for library in LIBRARIES]:
            if not isinstance(made.exception(), (BuildError, OSError, type(None))):
                made.result()


def pytest_unconfigure(config: pytest.Config) -> None:
    if _KEPT in config.stash:
        config.stash[_KEPT].cleanup()


@pytest.fixture(autouse=True)
def own_random_numbers() -> None:
    """Weights and inputs drawn from torch's generator do not depend on the tests before."""
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def compiled_layers() -> None:
    """Skips where there is no compiler: layers of cloth have no other form than the compiled one, and commands say so."""
    try:
        cloth_proximity.library()
    except BuildError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def body_file() -> Path:
    return DATA_FOLDER / "body" / "default.npz"


@pytest.fixture(scope="session")
def body() -> Body:
    return load_body()


@pytest.fixture(scope="session")
def garments() -> dict[str, Garment]:
    """The seven default garments by name."""
    return {name: load_garment(name) for name in GARMENT_NAMES}


@pytest.fixture(scope="session")
def walk() -> PoseSequence:
    """A walk at 30 fps, y up."""
    return load_sequence("walk_proud")


@pytest.fixture(scope="session")
def tank_scene(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> Scene:
    """A tank top on the first 12 frames of the walk; no pinned vertices."""
    return build_scene(garments["tank"], body, walk.window(0, 12))


@pytest.fixture(scope="session")
def skirt_scene(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> Scene:
    """A skirt with a pinned waistband on 12 frames in the middle of the walk."""
    return build_scene(garments["skirt"], body, walk.window(60, 72))


@pytest.fixture(scope="session")
def band_scene(body: Body, walk: PoseSequence) -> Scene:
    """Small enough for minimisations: a band of 80 vertices that hangs from the waist by its rim, on 12 frames of the walk."""
    pos, faces = cylinder(16, 5, 0.21, 0.12)
    pos = pos + [0.0, -0.05, 0.02]
    return build_scene(Garment("band", pos, faces, pos[:, 1] > 0.069), body, walk.window(60, 72))

"""Fabrics by panels of an OBJ file, from the file through ``hood prepare`` into the scene, and by an image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hood.assets.garment.garment import Garment, load_garment
from hood.cli import main
from hood.commands.fabrics import fabric_named
from hood.commands.setup import make_scene
from hood.config import load_config


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def front(garments: dict[str, Garment]) -> np.ndarray:
    """(F,) bool: the faces before the middle of the tank, which ``top.obj`` holds as an object, with vertices of its own."""
    tank = garments["tank"]
    before = tank.rest_pos[tank.faces].mean(axis=1)[:, 2] > tank.rest_pos[:, 2].mean()
    lines, start = [], 1
    for name, chosen in (("front", before), ("back", ~before)):
        used, corners = np.unique(tank.faces[chosen], return_inverse=True)
        lines += [f"o {name}", *("v {:.9g} {:.9g} {:.9g}".format(*row) for row in tank.rest_pos[used].tolist())]
        lines += ["f {} {} {}".format(*row) for row in (corners.reshape(-1, 3) + start).tolist()]
        start += len(used)
    Path("top.obj").write_text("\n".join(lines) + "\n")
    return before


def test_panels_go_from_the_file_into_the_scene(front: np.ndarray, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prepare", "garment=top.obj", "output=top.npz"]) == 0
    counts = f"front ({front.sum()} faces), back ({(~front).sum()} faces)"
    told = capsys.readouterr().out
    assert f"panels: {counts}" in told
    assert "welded" in told
    for file in ("top.obj", "top.npz"):
        main(["inspect", file])
        assert counts in " ".join(capsys.readouterr().out.split())
    panels = load_garment("top.npz").panels
    assert panels is not None
    np.testing.assert_array_equal(panels["front"], np.arange(len(front)) < front.sum())
    words = ["garment=top.npz", "fabrics={front:silk,back:denim}", "num_frames=2"]
    density = make_scene(load_config("rollout", words)).cloth.density.numpy()
    np.testing.assert_allclose(density[panels["front"]], fabric_named("silk").density, rtol=1e-6)
    np.testing.assert_allclose(density[panels["back"]], fabric_named("denim").density, rtol=1e-6)


def test_a_misspelt_panel_is_named(front: np.ndarray, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prepare", "garment=top.obj", "output=top.npz"]) == 0
    capsys.readouterr()
    assert main(["rollout", "garment=top.npz", "stepper=newton", "fabrics={frnt:silk}", "num_frames=2", "output=run"]) == 2
    said = capsys.readouterr().err
    assert "unknown part 'frnt': did you mean 'front'?" in said
    assert said.count("\n") == 1


def test_an_image_gives_faces_their_fabric(garments: dict[str, Garment]) -> None:
    dress = garments["dress"]
    assert dress.uv is not None
    assert dress.uv_faces is not None
    middle = float(np.median(dress.uv[:, 0]))
    pixels = np.zeros((4, 1000, 3), np.uint8)
    pixels[:, : int(1000 * middle)] = [255, 0, 0]
    Image.fromarray(pixels).save("map.png")
    red = dress.uv[dress.uv_faces].mean(axis=1)[:, 0] < int(1000 * middle) / 1000
    density = make_scene(load_config("rollout", ["garment=dress", "fabrics={red@map.png:denim}", "num_frames=2"])).cloth.density
    plain = make_scene(load_config("rollout", ["garment=dress", "num_frames=2"])).cloth.density
    np.testing.assert_allclose(density.numpy()[red], fabric_named("denim").density, rtol=1e-6)
    np.testing.assert_array_equal(density.numpy()[~red], plain.numpy()[~red])
    assert 0.2 < red.mean() < 0.8

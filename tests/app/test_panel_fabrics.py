"""Fabrics by panels of an OBJ file, from the file through ``hood prepare`` into the scene, and by an image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hood import api
from hood.app.scene.fabrics import fabric_named
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import make_scene
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.garment.parts import part_faces
from hood.cli.main import main


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
    density = make_scene(RolloutSettings.from_words(words)).cloth.density.numpy()
    np.testing.assert_allclose(density[panels["front"]], fabric_named("silk").density, rtol=1e-6)
    np.testing.assert_allclose(density[panels["back"]], fabric_named("denim").density, rtol=1e-6)


def test_panels_are_known_by_the_name_in_the_file_and_by_the_listed_one(
    front: np.ndarray, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("Jäckchen.obj").write_text(Path("top.obj").read_text().replace("o front", "o Schößchen"), encoding="utf-8")
    assert main(["prepare", "garment=Jäckchen.obj", "output=Jäckchen.npz"]) == 0
    assert "panels: Schoesschen (" in capsys.readouterr().out
    main(["inspect", "Jäckchen.npz"])
    assert "panels: Schoesschen (" in capsys.readouterr().out
    silk, base = fabric_named("silk").density, fabric_named("default").density
    before = np.arange(len(front)) < front.sum()
    for words in (
        ["fabrics={Schößchen:silk}"],
        ["fabrics={Schoesschen:silk}"],
        api.overrides({"fabrics": {"Schößchen": "silk"}}),
    ):
        config = RolloutSettings.from_words(["garment=Jäckchen.npz", *words, "num_frames=2"])
        np.testing.assert_allclose(make_scene(config).cloth.density.numpy(), np.where(before, silk, base), rtol=1e-6)
    longer = RolloutSettings.from_words(["garment=Jäckchen.npz", "size={Schößchen:1.1}", "num_frames=2"])
    assert make_scene(longer).cloth.rest_area.sum() > make_scene(config).cloth.rest_area.sum()
    whole = RolloutSettings.from_words(["garment=[Jäckchen.npz,skirt]", "fabrics={Jäckchen:silk}", "num_frames=2"])
    density = make_scene(whole).cloth.density.numpy()
    np.testing.assert_allclose(density[: len(front)], silk, rtol=1e-6)
    np.testing.assert_allclose(density[len(front) :], base, rtol=1e-6)


def test_a_file_that_keeps_other_names_is_asked_by_both(garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    first = np.arange(len(tank.faces)) < 9
    garment = replace(tank, panels={"Schößchen": first, "front left": ~first})
    for name in ("Schößchen", "Schoesschen", "Scho\u0308ßchen"):
        np.testing.assert_array_equal(part_faces(name, garment, None), first)
    for name in ("front left", "front_left"):
        np.testing.assert_array_equal(part_faces(name, garment, None), ~first)


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
    density = make_scene(
        RolloutSettings.from_words(["garment=dress", "fabrics={red@map.png:denim}", "num_frames=2"])
    ).cloth.density
    plain = make_scene(RolloutSettings.from_words(["garment=dress", "num_frames=2"])).cloth.density
    np.testing.assert_allclose(density.numpy()[red], fabric_named("denim").density, rtol=1e-6)
    np.testing.assert_array_equal(density.numpy()[~red], plain.numpy()[~red])
    assert 0.2 < red.mean() < 0.8

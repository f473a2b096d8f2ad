"""Garments that are worn strangely: told in one sentence, and simulated as far as that makes sense."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from belt import write_walk
from workshop import write_obj

from hood.assets.body.load import load_body
from hood.assets.garment.garment import load_garment
from hood.cli.main import main
from hood.testing import cylinder

COMMAND = ["rollout", "stepper=newton", "sequence=walk.npz", "num_frames=2", "video=none", "sheet=false", "output=out"]
QUICK = [*COMMAND, "metrics=none", "settle=paper"]
#: The start is not what is asked: it need not be at rest.
FEW = "solver.max_iterations=30"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_walk(Path("walk.npz"), 4)


def _belt(name: str, radius: float = 0.14, pressed: int = 0, aside: float = 0.0) -> None:
    """A ring of cloth round the waist or ``aside`` [m] of it, the first vertices ``pressed`` into the body."""
    waist = load_body().shaped(np.zeros(10))[1][3]
    pos, faces = cylinder(around=20, rows=5, radius=radius, height=0.16)
    pos = pos - pos.mean(axis=0)
    pos[:pressed, [0, 2]] *= 0.4
    write_obj(Path(name), pos + waist + [aside, 0.0, 0.0], faces)


def _warnings() -> list[str]:
    return json.loads(Path("out/summary.json").read_text())["warnings"]


@pytest.mark.slow
def test_a_garment_inside_out_is_told_and_prepare_turns_it(capsys: pytest.CaptureFixture[str]) -> None:
    shirt = load_garment("tshirt")
    write_obj(Path("shirt.obj"), shirt.worn_pos, shirt.faces[:, ::-1])
    assert main([*QUICK, "garment=shirt.obj", "cloth_contact=off"]) == 0
    (sentence,) = _warnings()
    assert "garment 'shirt' is inside out: the normals of 100% of its area point to the body" in sentence
    assert main(["inspect", "shirt.obj"]) == 1
    said = capsys.readouterr().out
    assert "it is inside out" in said
    assert "prepare turns it" in said
    assert main(["prepare", "garment=shirt.obj", "output=turned.npz"]) == 0
    assert f"turned all {len(shirt.faces)} faces over: the garment was inside out" in capsys.readouterr().out
    np.testing.assert_array_equal(load_garment("turned.npz").faces, shirt.faces)
    assert main([*QUICK, "garment=turned.npz", "cloth_contact=off"]) == 0
    assert _warnings() == []


def test_held_vertices_inside_the_body_are_told() -> None:
    _belt("belt.obj", pressed=3)
    assert main([*QUICK, "garment=belt.obj", "pins=[0,1,2,40]", FEW]) in (0, 3)
    (sentence,) = _warnings()
    assert "garment 'belt' has 3 of its 4 held vertices inside the body in frame 0, to " in sentence
    assert "hold others (pins=…)" in sentence
    assert main([*QUICK, "garment=belt.obj", FEW]) == 0  # pushed out where nothing holds them
    assert _warnings() == []


@pytest.mark.usefixtures("compiled_layers")
def test_garments_in_another_order_than_they_lie_are_told() -> None:
    _belt("inner.obj", 0.19)
    _belt("outer.obj", 0.2)
    assert main([*QUICK, "garment=[inner.obj,outer.obj]", "layers=[outer,inner]", FEW]) == 0
    (sentence,) = _warnings()
    assert "'inner' lay under 'outer' and was taken over it, with edges stretched by up to" in sentence
    assert main([*QUICK, "garment=[inner.obj,outer.obj]", "layers=[inner,outer]", FEW]) == 0
    assert _warnings() == []


@pytest.mark.usefixtures("compiled_layers")
def test_garments_that_cannot_be_taken_apart_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    _belt("a.obj", 0.19)
    _belt("b.obj", 0.19, aside=0.08)
    assert main([*QUICK, "garment=[a.obj,b.obj]", f"pins={list(range(200))}".replace(" ", "")]) == 2
    said = capsys.readouterr().err
    assert "pairs of triangles of 'a' and 'b' pass through each other at the start and could not be taken apart" in said
    assert "layers=[inner,outer]" in said
    assert "free their pins (pins=none)" in said
    assert not Path("out/summary.json").exists()

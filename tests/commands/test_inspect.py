"""``hood inspect`` says what files are, what is wrong, and a command that repairs it."""

from __future__ import annotations

import json
import pickle
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from wild import write_wild_garment

from hood.assets.body import Body
from hood.assets.garment import Garment
from hood.assets.identify import identify
from hood.cli import main


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)


def inspect(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = main(["inspect", *words, "--json"])
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return code, report


def test_a_garment_from_the_wild_and_its_cure(
    capsys: pytest.CaptureFixture[str], garments: dict[str, Garment], body: Body
) -> None:
    wild = write_wild_garment(Path("wild.obj"), garments, body)
    code, report = inspect(capsys, "wild.obj", "walk_proud")
    assert code == 1
    garment, motion = report["files"]
    assert (garment["kind"], motion["kind"]) == ("garment mesh", "motion")
    problems = "\n".join(entry["problem"] for entry in garment["problems"])
    for words in (
        f"{wild.num_quads} faces have more than three",
        f"{wild.num_torn} vertices lie on another",
        "centimetres",
        "inside the body",
    ):
        assert words in problems
    assert garment["facts"]["up axis"] == "y"
    assert motion["facts"]["up axis by its poses"] == "z"
    assert motion["problems"] == []
    assert not report["fit"]["fits"]
    assert "0.01" in report["fit"]["reason"]
    command = shlex.split(garment["command"])
    assert command[:3] == ["hood", "prepare", "garment=wild.obj"]
    assert main([*command[1:], "output=cured.npz"]) == 0
    capsys.readouterr()
    _, cured = inspect(capsys, "cured.npz")
    assert cured["files"][0]["problems"] == []
    assert cured["files"][0]["facts"]["components"] == 3


def test_embedded_assets_fit(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "tank", "walk_proud", "default"]) == 0
    text = capsys.readouterr().out
    assert "they fit" in text
    assert "near hem" in text
    assert "near neckline" in text
    assert "body height 1.7" in text


def test_z_up_and_distance_are_noticed(capsys: pytest.CaptureFixture[str], garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    faces = [f"f {a} {b} {c}" for a, b, c in tank.faces + 1]
    for name, pos in {"lying.obj": tank.rest_pos[:, [0, 2, 1]] * [1, -1, 1], "away.obj": tank.rest_pos + [0, 1.5, 0]}.items():
        Path(name).write_text("\n".join([*(f"v {x} {y} {z}" for x, y, z in pos), *faces]))
    _, report = inspect(capsys, "lying.obj", "away.obj")
    lying, away = report["files"]
    assert "up=z" in lying["command"]
    assert "offset=" in away["command"]
    assert main([*shlex.split(away["command"])[1:], "output=back.npz"]) == 0


def test_kinds(tmp_path: Path) -> None:
    tables = {
        "garment": {"rest_pos": np.zeros((3, 3)), "faces": np.zeros((1, 3), int)},
        "body model": {"v_template": np.zeros((3, 3)), "weights": np.zeros((3, 2)), "f": np.zeros((1, 3))},
        "motion": {"poses": np.zeros((2, 156)), "trans": np.zeros((2, 3))},
        "moving mesh": {"verts": np.zeros((2, 3, 3)), "faces": np.zeros((1, 3), int)},
    }
    for kind, arrays in tables.items():
        np.savez(tmp_path / "file.npz", **arrays)
        assert identify(str(tmp_path / "file.npz")) == kind
        (tmp_path / "file.pkl").write_bytes(pickle.dumps(arrays))
        assert identify(str(tmp_path / "file.pkl")) == kind
    assert identify("quickstart") == "checkpoint"
    (tmp_path / "held.txt").write_text("1 2 3")
    assert identify(str(tmp_path / "held.txt")) == "vertex list"


def test_errors_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    np.savez("odd.npz", things=np.zeros(3))
    Path("note.docx").write_text("hello")
    for words, expected in (
        ([], "no file is given"),
        (["odd.npz"], "things"),
        (["note.docx"], ".docx"),
        (["gone.obj"], "no such file"),
    ):
        assert main(["inspect", *words]) == 2
        error = capsys.readouterr().err
        assert expected in error
        assert error.count("\n") == 1

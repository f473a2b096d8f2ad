"""``hood inspect`` says what files are, what is wrong, and a command that repairs it."""

from __future__ import annotations

import json
import pickle
import shlex
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imitations import write_seated
from wild import write_wild_garment
from workshop import write_obj

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.identify import identify
from hood.cli.main import main


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


def test_a_checkpoint_by_its_former_name_says_the_name_of_today(capsys: pytest.CaptureFixture[str]) -> None:
    main(["inspect", "ours"])
    text = capsys.readouterr().out
    assert "ours: checkpoint" in text
    assert text.count("checkpoint ours is called small-ours now") == 1


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
    for words, expected in (
        ([], "no file is given"),
        (["tank", "object=[a]"], "unknown key 'object': did you mean 'objects'"),
        (["tank", "scale=0.01"], "unknown key 'scale'"),
        (["tank", "--fast"], "unknown option '--fast'"),
    ):
        assert main(["inspect", *words]) == 2
        error = capsys.readouterr().err
        assert expected in error
        assert error.count("\n") == 1


def test_one_unreadable_file_does_not_end_the_report(capsys: pytest.CaptureFixture[str]) -> None:
    np.savez("odd.npz", things=np.zeros(3))
    np.savez("bent.npz", poses=np.zeros((2, 5)), trans=np.zeros((2, 3)))
    Path("note.docx").write_text("hello")
    code, report = inspect(capsys, "odd.npz", "note.docx", "gone.obj", "tshrt", "bent.npz", "tank")
    assert code == 1
    told = [(found["kind"], " ".join(entry["problem"] for entry in found["problems"])) for found in report["files"]]
    for (kind, problem), expected in zip(
        told,
        (
            ("unreadable", "has the keys things"),
            ("unreadable", "unknown file type '.docx'"),
            ("unreadable", "no such file"),
            ("unreadable", "no such file, and no embedded asset of that name; did you mean tshirt?"),
            ("motion", "poses has shape (2, 5)"),
            ("garment", ""),
        ),
        strict=True,
    ):
        assert kind == expected[0]
        assert expected[1] in problem
    assert main(["inspect", "gone.obj", "tank"]) == 1
    said = capsys.readouterr()
    assert "gone.obj: unreadable\n  ! no such file" in said.out
    assert "tank: garment\n  vertices: 1016" in said.out
    assert said.err == ""


@pytest.mark.parametrize("suffix", ["fbx", "bvh"])
def test_other_programs_formats_name_the_way_out(capsys: pytest.CaptureFixture[str], suffix: str) -> None:
    name = f"hero.{suffix}"
    Path(name).write_bytes(b"content")
    for words, way in (
        (["rollout", f"garment={name}"], "as OBJ or GLB"),
        (["rollout", f"body={name}"], "body=hero.glb"),
        (["rollout", f"sequence={name}"], "body=hero.glb"),
        (["prepare", f"garment={name}"], "as OBJ or GLB"),
        (["prepare", "garment=tank", f"body={name}"], "body=hero.glb"),
        (["prepare", "garment=tank", f"pose={name}"], "body=hero.glb"),
    ):
        assert main([*words, *(["checkpoint=untrained", "model=small"] if words[0] == "rollout" else [])]) == 2
        error = capsys.readouterr().err
        assert f"{name}: " in error
        assert "files are not read; " in error
        assert way in error
        assert error.count("\n") == 1
    assert main(["inspect", name]) == 1
    assert "files are not read; " in capsys.readouterr().out


def test_long_lists_are_cut(capsys: pytest.CaptureFixture[str], garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    loose = np.arange(tank.faces.size).reshape(-1, 3)[:33]
    write_obj(Path("loose.obj"), tank.rest_pos[tank.faces].reshape(-1, 3)[:99], loose)
    assert main(["inspect", "loose.obj"]) == 1
    assert "openings: 3, 3, 3, 3, 3, 3, 3, 3, 3, 3, … and 23 more\n" in capsys.readouterr().out
    _, report = inspect(capsys, "loose.obj")
    assert len(report["files"][0]["facts"]["openings"]) == 33


@pytest.mark.parametrize("factor", [1e200, 1e308, 1e-200, 0.0])
def test_no_warning_of_python_reaches_the_user(
    capsys: pytest.CaptureFixture[str], garments: dict[str, Garment], factor: float
) -> None:
    """Numbers that overflow are refused before anything is computed with them."""
    tank = garments["tank"]
    Path("odd.obj").write_text(
        "\n".join([*(f"v {x!r} {y!r} {z!r}" for x, y, z in (factor * tank.rest_pos).tolist())]
                  + [f"f {a} {b} {c}" for a, b, c in (tank.faces + 1).tolist()])
    )  # fmt: skip
    for words in (
        ["inspect", "odd.obj"],
        ["prepare", "garment=odd.obj"],
        ["rollout", "garment=odd.obj", "checkpoint=untrained"],
    ):
        with warnings.catch_warnings(record=True) as caught:
            code = main(words)
        said = capsys.readouterr()
        assert code == (1 if words[0] == "inspect" else 2), said
        assert "Warning" not in said.err
        assert "encountered" not in said.err + said.out
        assert said.err.count("\n") == (0 if words[0] == "inspect" else 1)
        assert caught == []


def test_inspect_knows_what_a_rollout_does_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("hood.scene.start._MOST_ITERATIONS", 60)
    seated = str(write_seated(tmp_path / "seated.npz"))
    monkeypatch.setattr("hood.scene.scene._TORN", 10.0)  # everything is taken for worn
    assert main(["inspect", "dress", seated]) == 1
    assert "they do not fit" in capsys.readouterr().out
    monkeypatch.setattr("hood.scene.scene._TORN", 0.1)  # in 60 iterations this dress is stretched by more
    assert main(["inspect", "dress", seated]) == 0
    assert "they fit: put on in the T-pose, from where a rollout moves the body into this pose" in capsys.readouterr().out


def test_bindings_of_a_garment_are_told(capsys: pytest.CaptureFixture[str], garments: dict[str, Garment]) -> None:
    code, report = inspect(capsys, "dress", "tank")
    assert code == 0
    dress, tank = (finding["facts"]["stiffer than the fabric"] for finding in report["files"])
    assert dress == f"{int((garments['dress'].stiffness > 1).sum())} vertices, 2 times"
    assert tank is None


def test_what_is_not_sure_is_said_to_be(capsys: pytest.CaptureFixture[str], garments: dict[str, Garment]) -> None:
    """The unit of a garment that fits nowhere for sure is a guess like the rest of its place."""
    tank = garments["tank"]
    write_obj(Path("flat.obj"), tank.rest_pos * [1.0, 1.0, 0.001], tank.faces)
    _, report = inspect(capsys, "flat.obj", "tank")
    facts = report["files"][0]["facts"]
    assert "no place on 'default' is sure" in " ".join(entry["problem"] for entry in report["files"][0]["problems"])
    assert not {"units", "size in body heights", "up axis"} & set(facts)
    assert {"closest place, not sure: units", "closest place, not sure: size in body heights"} <= set(facts)


def test_the_size_of_a_garment_is_told_in_the_unit_found(
    capsys: pytest.CaptureFixture[str], garments: dict[str, Garment]
) -> None:
    tank, sizes = garments["tank"], []
    for unit in (1.0, 0.01):
        write_obj(Path("tank.obj"), tank.tpose(np.zeros(10)) / unit, tank.faces)
        sizes.append(inspect(capsys, "tank.obj")[1]["files"][0]["facts"]["size in body heights"])
    assert sizes[0] == sizes[1] == pytest.approx(0.4, abs=0.15)


@pytest.mark.parametrize(("height", "told"), [(0.0, "not sure: y if it stands, z if it lies"), (0.9, "y")])
def test_the_axis_of_a_motion_does_not_contradict_its_notice(
    capsys: pytest.CaptureFixture[str], height: float, told: str
) -> None:
    """A motion in the layout of AMASS whose root stands along y, on the floor of its layout or at a standing height."""
    np.savez(
        "y_up.npz", poses=np.zeros((10, 156)), trans=np.tile([0.0, height, 0.0], (10, 1)), betas=np.zeros(16), gender="neutral",
        mocap_framerate=25,
    )  # fmt: skip
    code, report = inspect(capsys, "y_up.npz")
    facts, (problem,) = report["files"][0]["facts"], report["files"][0]["problems"]
    assert code == 1
    assert facts["up axis by its poses"] == told
    assert facts["up axis taken"] == ("y" if told == "y" else "z")
    assert "its body stands along y" in problem["problem"]

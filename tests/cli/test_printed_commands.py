"""Commands that ``hood inspect`` and ``hood prepare`` print run as they are, whatever a file is called."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest
from workshop import Workshop, write_obj

from hood.app.settings.compose import load_config
from hood.app.settings.rollout_settings import RolloutSettings
from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.cli.main import main

NAMES = ("cape (1).obj", "Röckchen.obj", "cape#2.obj", "my cape.obj", "cape,v2.obj", "cape's.obj", "[x], cape.obj", "cape.obj")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)


def printed(line: str, before: str) -> list[str]:
    """The words of the command behind ``before``, as a shell divides them."""
    command = shlex.split(line.partition(before)[2])
    assert command[0] == "hood"
    return command[1:]


@pytest.mark.parametrize("name", NAMES)
def test_the_repair_and_the_rollout_run(name: str, garments: dict[str, Garment], capsys: pytest.CaptureFixture[str]) -> None:
    shirt = garments["tshirt"]
    write_obj(Path(name), 100.0 * shirt.rest_pos, shirt.faces)
    assert main(["inspect", name]) == 1
    repair = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("  repair: "))
    assert main(printed(repair, "repair: ")) == 0
    command, *words = printed(capsys.readouterr().out.splitlines()[-1], "run it with: ")
    assert command == "rollout"
    assert RolloutSettings.from_words(words).garment == f"{Path(name).stem}_prepared.npz"
    assert main(
        [command, *words, "stepper=guess", "refine=0", "num_frames=1", "video=none", "sheet=false", "metrics=none"]
    ) in (0, 3)


@pytest.mark.parametrize("name", ["tänzer (1).obj", "body,v2.obj"])
def test_the_rollout_on_a_mesh_runs(
    name: str, garments: dict[str, Garment], body: Body, capsys: pytest.CaptureFixture[str]
) -> None:
    write_obj(Path(name), body.v_template, body.faces)
    write_obj(Path("Röckchen.obj"), garments["tank"].worn_pos, garments["tank"].faces)
    assert main(["prepare", "garment=Röckchen.obj", f"body={name}"]) == 0
    command, *words = printed(capsys.readouterr().out.splitlines()[-1], "run it with: ")
    config = load_config(command, words)
    assert (config.garment, config.body) == ("Röckchen_prepared.npz", name)


def test_the_rollout_is_on_the_body_that_the_garment_was_prepared_for(
    garments: dict[str, Garment], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_obj(Path("tank.obj"), garments["tank"].worn_pos, garments["tank"].faces)
    body = Workshop(tmp_path).body("smplx_npz")
    assert main(["prepare", "garment=tank.obj", f"body={body}"]) == 0
    command, *words = printed(capsys.readouterr().out.splitlines()[-1], "run it with: ")
    assert words == ["garment=tank_prepared.npz", f"body={body}"]


def test_the_rollout_on_a_mesh_has_its_unit_and_axis(
    garments: dict[str, Garment], body: Body, capsys: pytest.CaptureFixture[str]
) -> None:
    """The body is in centimetres, with z up."""
    write_obj(Path("body.obj"), 100.0 * body.v_template @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), body.faces)
    write_obj(Path("tank.obj"), garments["tank"].worn_pos, garments["tank"].faces)
    assert main(["prepare", "garment=tank.obj", "body=body.obj", "body_scale=0.01", "body_up=z"]) == 0
    command, *words = printed(capsys.readouterr().out.splitlines()[-1], "run it with: ")
    config = load_config(command, words)
    assert (config.unit, config.up) == (0.01, "z")
    quiet = ["stepper=guess", "refine=0", "num_frames=1", "video=none", "sheet=false", "metrics=none", "sequence=none"]
    assert main([command, *words, *quiet]) in (0, 3)


def test_a_folder_of_a_rollout_is_inspected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quiet = ["stepper=guess", "refine=0", "num_frames=2", "video=none", "sheet=false"]
    assert main(["rollout", "garment=tank", "sequence=plie", *quiet, "output=shot"]) in (0, 3)
    main(["inspect", "shot/rollout.h5"])
    of_file = capsys.readouterr().out.split("shot/rollout.h5", 1)[1]
    main(["inspect", "shot"])
    assert capsys.readouterr().out.split("shot/rollout.h5", 1)[1] == of_file
    assert "rollout" in of_file

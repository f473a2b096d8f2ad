"""``hood inspect`` on motions: the layout, people, frame rate, unit and up axis, and which of these are not sure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion_kinds.parameters import amass
from motion_kinds.published import gvhmr, wham
from motion_kinds.refused import REFUSALS
from motion_kinds.variants import GENERATORS
from motion_kinds.walks import world
from motion_kinds.writers import write

from hood.assets.identify import CHECKPOINT, MOTION, identify
from hood.cli.main import main


def told(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = main(["inspect", *words, "--json"])
    return code, json.loads(capsys.readouterr().out)["files"][0]


@pytest.mark.parametrize("name", GENERATORS)
def test_every_layout_is_told(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = GENERATORS[name]
    path = str(write(tmp_path / f"m{file.suffix}", file.make()))
    assert identify(path) == MOTION
    code, found = told(capsys, path, *(f"{key}={value}" for key, value in file.keys.items()))
    facts = found["facts"]
    assert (found["kind"], facts["layout"], facts["people"]) == ("motion", file.layout, file.people)
    assert facts["frames per second"] == (f"{file.fps:g}, assumed" if file.assumed else file.fps)
    assert (facts["up axis taken"], facts["up axis by its poses"]) == (file.up, file.up)
    assert facts["unit of the translation"] == "m"
    problems = " ".join(entry["problem"] + entry["fix"] for entry in found["problems"])
    assert ("file_fps=" in problems) == file.assumed
    assert code == (1 if file.assumed or file.doubts or found["problems"] else 0)


@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_refused_says_why(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refusal = REFUSALS[name]
    path = str(write(tmp_path / f"m{refusal.suffix}", refusal.make()))
    code, found = told(capsys, path, *(f"{key}={value}" for key, value in refusal.keys.items()))
    assert code == 1
    assert found["kind"] == (
        "checkpoint" if name == "a network" else "unreadable" if found["kind"] == "unreadable" else "motion"
    )
    assert found["problems"]
    assert all(entry["problem"] for entry in found["problems"])


def test_people_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = told(capsys, str(write(tmp_path / "m.pkl", wham(3))))
    assert code == 1
    assert found["facts"] == {"layout": "WHAM", "people": ["0", "2", "4"]}
    assert found["problems"] == [{"problem": "holds 3 people (0, 2, 4)", "fix": "choose one with person=0"}]


def test_a_motion_of_torch_is_no_checkpoint(tmp_path: Path) -> None:
    assert identify(str(write(tmp_path / "m.pt", gvhmr()))) == MOTION
    assert identify(str(write(tmp_path / "n.pt", REFUSALS["a network"].make()))) == CHECKPOINT
    (tmp_path / "torn.pt").write_bytes(b"PK\x03\x04")
    assert identify(str(tmp_path / "torn.pt")) == CHECKPOINT


def test_what_was_given_is_no_fact_of_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(write(tmp_path / "m.npz", amass(trans=world("z").transl * 100.0)))
    _, found = told(capsys, path)
    assert found["facts"]["unit of the translation"] == "cm"
    assert "is in centimetres" in found["problems"][0]["problem"]
    _, found = told(capsys, path, "unit=cm", "up=-z", "file_fps=60")
    facts = found["facts"]
    assert (facts["unit of the translation"], facts["up axis taken"]) == ("cm, as given", "-z, as given")
    assert (facts["frames per second"], found["problems"]) == (60.0, [])


def test_what_cannot_be_tested_is_assumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A body that stands still somewhere: its unit and its axis are those of the layout."""
    still = {"poses": np.tile(world("-y").flat()[:1], (60, 1)), "trans": np.tile([0.0, 7.0, 9.0], (60, 1))}
    _, found = told(capsys, str(write(tmp_path / "m.npz", amass(72, **still))))
    assert found["facts"]["unit of the translation"] == "m, assumed"
    assert found["facts"]["up axis by its poses"] == "not sure: -y if it stands, z if it lies"
    assert "up=-y" in found["problems"][0]["fix"]

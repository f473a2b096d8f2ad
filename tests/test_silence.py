"""Only the command line prints, and nothing of it is loaded by the Python interface."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import hood


def test_python_prints_nothing_and_loads_no_command_line(tmp_path: Path) -> None:
    code = """
import sys, warnings
warnings.simplefilter("error")
import hood
simulation = hood.simulate("tank", "plie", num_frames=2, metrics="none")
assert len(list(simulation)) == 2
assert any("stepper=newton" in note for note in simulation.notes), simulation.notes
summary = hood.rollout(garment="tank", sequence="plie", num_frames=2, video="none", sheet=False, output="out")
assert summary["num_frames"] == 2
assert any("stepper=newton" in note for note in summary.notes), summary.notes
hood.export("out", format="glb")
loaded = [name for name in sys.modules if name.startswith(("hood.cli", "hood.studies"))]
assert not loaded, loaded
"""
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_who_asks_is_told_what_the_command_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from hood.cli.main import main

    monkeypatch.chdir(tmp_path)
    words = {"garment": "tank", "sequence": "none", "body": "none", "num_frames": 2, "video": "none", "sheet": False}
    told: list[str] = []
    summary = hood.rollout(tell=told.append, output="out", **words)
    assert capsys.readouterr() == ("", "")
    assert told == summary.notes
    assert main(["rollout", *(f"{key}={value}" for key, value in words.items()), "output=out"]) in (0, 3)
    printed = capsys.readouterr()
    lines = [*printed.out.splitlines(), *(line.removeprefix("hood: ") for line in printed.err.splitlines())]
    timed = ("ms per frame", "ms a frame")
    differ = {line for line in lines if line not in told and not any(word in line for word in timed)}
    assert not {line for line in differ if "exit code" not in line}

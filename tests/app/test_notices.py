"""Warnings reach the user as sentences, once, and stand in lists."""

from __future__ import annotations

import subprocess
import sys
import warnings
from typing import Any

import pytest

from hood.app.notices import collected, heard, say
from hood.assets.files.said import Doubt, listening
from hood.cli import main


def test_one_line_each_and_nothing_twice(capsys: pytest.CaptureFixture[str]) -> None:
    with listening(main.aloud), heard() as all_said:
        for _ in range(2):
            with heard() as said:
                warnings.warn("the shirt is\n far away", stacklevel=1)
                warnings.warn("the shirt is far away", stacklevel=1)
            assert said == ["the shirt is far away"]
        warnings.warn("and flat", RuntimeWarning, stacklevel=1)
    assert all_said == ["the shirt is far away", "and flat"]
    assert capsys.readouterr().err == "hood: warning: the shirt is far away\nhood: warning: and flat\n"


def test_a_process_speaks_again_in_its_next_command(capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        with listening(main.aloud), heard():
            warnings.warn("inwards", stacklevel=1)
    assert capsys.readouterr().err.count("inwards") == 2


def test_every_command_is_heard(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def command(_: Any) -> int:
        warnings.warn("it fell", stacklevel=1)
        return 0

    monkeypatch.setattr(main, "_command", lambda *_: command)
    assert main.main(["inspect"]) == 0
    assert capsys.readouterr().err == "hood: warning: it fell\n"


def test_doubts_are_warnings_that_a_script_can_read(capsys: pytest.CaptureFixture[str]) -> None:
    with listening(main.aloud), heard() as all_said, heard() as said:
        doubt = Doubt("frame_rate", "walk.npz: no frame rate, 30 taken; file_fps=… gives it", value=30.0, unit="fps")
        warnings.warn(doubt, stacklevel=1)
        warnings.warn("plain", stacklevel=1)
    assert all_said == said == ["walk.npz: no frame rate, 30 taken; file_fps=… gives it", "plain"]
    for one in (all_said, said):
        assert [doubt.as_dict() for doubt in one.doubts] == [
            {"kind": "frame_rate", "sentence": said[0], "frames": [], "value": 30.0, "unit": "fps"}
        ]
    assert capsys.readouterr().err.count("no frame rate") == 1


def test_python_hears_and_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    told: list[str] = []
    with collected(told.append) as lines, heard():
        say("one\ntwo")
        warnings.warn("three", stacklevel=1)
        say("hood: half done", error=True, passing=True)
    assert lines == ["one", "two", "warning: three"]
    assert told == [*lines, "half done"]
    assert capsys.readouterr() == ("", "")


def test_a_simulation_from_python_needs_no_command_line() -> None:
    code = (
        "import sys, hood; made = hood.simulate('tank', 'plie', num_frames=1); list(made); assert made.notes; "
        "print([name for name in sys.modules if name.startswith('hood.cli') or name.startswith('hood.studies')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == "[]"
    assert done.stderr == ""

"""Warnings reach the user as sentences, once, and stand in lists."""

from __future__ import annotations

import warnings
from typing import Any

import pytest

from hood.app.notices import heard
from hood.assets.files.said import Doubt
from hood.cli import main


def test_one_line_each_and_nothing_twice(capsys: pytest.CaptureFixture[str]) -> None:
    with heard() as all_said:
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
        with heard():
            warnings.warn("inwards", stacklevel=1)
    assert capsys.readouterr().err.count("inwards") == 2


def test_every_command_is_heard(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def command(_: Any) -> int:
        warnings.warn("it fell", stacklevel=1)
        return 0

    monkeypatch.setattr(main, "_command", lambda name: command)
    assert main.main(["inspect"]) == 0
    assert capsys.readouterr().err == "hood: warning: it fell\n"


def test_doubts_are_warnings_that_a_script_can_read(capsys: pytest.CaptureFixture[str]) -> None:
    with heard() as all_said, heard() as said:
        doubt = Doubt("frame_rate", "walk.npz: no frame rate, 30 taken; file_fps=… gives it", value=30.0, unit="fps")
        warnings.warn(doubt, stacklevel=1)
        warnings.warn("plain", stacklevel=1)
    assert all_said == said == ["walk.npz: no frame rate, 30 taken; file_fps=… gives it", "plain"]
    for one in (all_said, said):
        assert [doubt.as_dict() for doubt in one.doubts] == [
            {"kind": "frame_rate", "sentence": said[0], "frames": [], "value": 30.0, "unit": "fps"}
        ]
    assert capsys.readouterr().err.count("no frame rate") == 1

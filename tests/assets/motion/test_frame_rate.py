"""Frame rates: read under every key and in every form, in every layout; assumed with a doubt where no file says one."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion_kinds.parameters import amass, split
from motion_kinds.published import aist, emdb, gvhmr, wham
from motion_kinds.writers import write

from hood.assets.files.said import Doubt
from hood.assets.files.text import parse_rate
from hood.assets.motion.load import load_sequence
from hood.assets.motion.recording import read_recording

KEYS = (
    "mocap_framerate", "mocap_frame_rate", "mocapFrameRate", "framerate", "frameRate", "frame_rate", "FrameRate", "fps", "FPS",
    "mocap_fps", "mocap_frame_rate_hz", "video_fps", "source_fps", "sampling_rate", "capture_frequency", "frames_per_second",
)  # fmt: skip


@pytest.mark.parametrize("key", KEYS)
def test_a_rate_is_read_under_every_key(key: str, tmp_path: Path) -> None:
    whole = {name: value for name, value in amass(72).items() if "rate" not in name}
    for content in (whole | {key: 50.0}, split() | {key: 50.0}, split() | {"meta": {key: 50.0}}, {key: 50.0, "data": split()}):
        found = read_recording(write(tmp_path / "m.pkl", content))
        assert (found.fps, found.fps_assumed) == (50.0, False)


@pytest.mark.parametrize(
    "value",
    [50, 50.0, np.array(50), np.array([50.0]), np.array([[50]]), "50", b"50", "50.0 fps", "50 Hz", np.array("50"),
     np.array(b"50"), [50]],
)  # fmt: skip
def test_a_rate_is_read_in_every_form(value: Any, tmp_path: Path) -> None:
    assert read_recording(write(tmp_path / "m.pkl", split(fps=value))).fps == 50.0


def test_a_ratio_a_time_and_no_number() -> None:
    assert parse_rate("30000/1001") == pytest.approx(29.97003)
    assert np.isnan([parse_rate(value) for value in ("fast", "", None, [30, 60], "1/0", "1.2.3")]).all()


def test_the_time_of_a_frame_says_the_rate(tmp_path: Path) -> None:
    assert read_recording(write(tmp_path / "m.pkl", split(frame_time=0.02))).fps == pytest.approx(50.0)


def test_assumed_rates_are_those_of_the_layout_and_doubts(tmp_path: Path) -> None:
    for content, rate in ((aist(), 60.0), (emdb(), 30.0), (wham(), 30.0), (split(), 30.0)):
        path = write(tmp_path / "m.pkl", content)
        found = read_recording(path)
        doubt = found.notes[0]
        assert isinstance(doubt, Doubt)
        assert (found.fps, found.fps_assumed, doubt.kind, doubt.value) == (rate, True, "frame_rate", rate)
        assert "file_fps=" in str(doubt)
        given = read_recording(path, 24.0)
        assert (given.fps, given.fps_assumed) == (24.0, False)
        assert not any(isinstance(note, Doubt) and note.kind == "frame_rate" for note in given.notes)


def test_two_rates_that_disagree_are_a_doubt(tmp_path: Path) -> None:
    found = read_recording(write(tmp_path / "assumed.pkl", split(fps=30, mocap_framerate=120.0)))
    assert (found.fps, found.fps_assumed) == (120.0, False)
    assert "mocap_framerate=120 and fps=30" in str(found.notes[0])


@pytest.mark.parametrize("content", [amass(72), split()])
def test_a_single_pose_needs_no_rate(content: dict[str, Any], tmp_path: Path) -> None:
    one = {key: value[:1] if np.ndim(value) == 2 else value for key, value in content.items() if "rate" not in key}
    path = write(tmp_path / "m.pkl", one)
    found = read_recording(path)
    assert (found.fps, found.fps_assumed, found.notes) == (30.0, True, ())
    assert load_sequence(path, 25.0, num_frames=10).fps == 25.0


def test_a_doubt_reaches_whoever_loads(tmp_path: Path) -> None:
    path = write(tmp_path / "m.pt", gvhmr())
    with pytest.warns(Doubt, match="30 fps are assumed"):
        load_sequence(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_sequence(path, file_fps=30.0)

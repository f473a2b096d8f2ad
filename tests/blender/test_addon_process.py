"""The process beside Blender and what it says: progress, errors, faults with the numbers to select."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import pytest

from blender.hood_blender import fault, process

NAMES = ["slip", "coat"]


def test_a_process_is_listened_to_and_asked_to_end(tmp_path: Path) -> None:
    code = "import os, sys, time; print(os.environ['OMP_NUM_THREADS'], os.getcwd()); time.sleep(60)"
    running = process.Process([sys.executable, "-c", code], tmp_path / "in", tmp_path / "log.txt", threads=3)
    try:
        until = time.monotonic() + 30
        while not running.said() and time.monotonic() < until:
            time.sleep(0.01)
        assert running.said().split() == ["3", str(tmp_path / "in")]
        assert running.code is None
        running.interrupt()
        while running.code is None and time.monotonic() < until:
            time.sleep(0.01)
        assert running.code not in (None, 0)
        assert "KeyboardInterrupt" in running.said()
    finally:
        running.kill()
    running.interrupt()
    running.kill()


def test_a_program_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError):
        process.Process([str(tmp_path / "none")], tmp_path, tmp_path / "log.txt")


def test_progress_and_time_left() -> None:
    said = "hood: settling the cloth: 3 of 40\nsomething\nhood: simulating: 12 of 150\n"
    assert process.how_far(said) == ("simulating", 12, 150)
    assert process.how_far("nothing") is None
    assert process.time_left(10, 40, 20.0) == "60 s"
    assert process.time_left(0, 40, 20.0) == ""
    assert [process.in_words(seconds) for seconds in (12.4, 200, 7500)] == ["12 s", "3 min", "2 h 5 min"]


def test_the_error_of_a_log_is_what_hood_said_last() -> None:
    assert fault.error_of("a\nhood: error: garment 'slip': face 3 has no area\nb\n") == "garment 'slip': face 3 has no area"
    assert fault.error_of("Traceback\nMemoryError\n") == "MemoryError"
    assert fault.error_of("") == ""


def test_numbers_in_a_sentence_can_be_selected() -> None:
    found = fault.fault_of("garment 'coat': face 812 has zero rest area (vertices 3, 7 and 9); repair it", NAMES)
    assert (found.garment, found.faces, found.vertices) == ("coat", [812], [3, 7, 9])
    assert fault.fault_of("garment 'coat': 2 rims are 3 mm apart; weld=0.003 sews them", NAMES).repair == "sew"
    assert fault.fault_of("nothing is known", ["slip"]).garment == "slip"
    assert fault.fault_of("nothing is known", NAMES).garment == ""


def test_faults_of_a_summary_are_rows_with_garment_frame_and_numbers(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    assert fault.faults_in(path, NAMES) == []
    placed = [
        {
            "kind": "cloth_through_cloth",
            "garment": "coat",
            "first_frame": 4,
            "frames": [[4, 6]],
            "triangles": [1, 5],
            "fix": None,
        },
        {"kind": "distance", "garment": "slip", "first_frame": 0, "vertices": [3], "fix": "solve further"},
    ]
    reasons = [{"kind": "cloth_through_cloth", "sentence": "pieces cross in 3 frames", "frames": [[4, 6]]}]
    doubts = [{"kind": "frame_rate", "sentence": "no rate"}, {"kind": "x", "sentence": "coat: edges", "edges": [[1, 2]]}]
    content = {"sound": False, "faults": placed, "reasons": reasons, "doubts": doubts}
    content["unsound_reasons"] = ["pieces cross in 3 frames", "slip: off"]
    path.write_text(json.dumps(content))
    first, second, third, fourth, last = fault.faults_in(path, NAMES)
    assert (first.text, first.garment, first.frame, first.faces) == ("pieces cross in 3 frames", "coat", 4, [1, 5])
    assert first.repair == "settle"
    assert (second.text, second.garment, second.vertices) == ("distance; solve further", "slip", [3])
    assert (third.text, third.garment) == ("no rate", "")
    assert (fourth.garment, fourth.vertices) == ("coat", [1, 2])
    assert (last.text, last.garment) == ("slip: off", "slip")
    path.write_text(json.dumps(content | {"sound": True, "faults": [], "unsound_reasons": []}))
    assert [found.text for found in fault.faults_in(path, NAMES)] == ["no rate", "coat: edges"]  # too rare to count
    path.write_text("{")
    assert fault.faults_in(path, NAMES) == []


def test_numbers_of_an_outfit_become_those_of_a_garment() -> None:
    assert fault.own_numbers([3, 10, 12, 30], 10, 15) == [0, 2]

"""What a rollout's settings say of its course, in words."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hood.media.viewer.page import TimelineMark, moments_of, shared_marks, timeline_marks, wind_of
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.file.step_table import OutputRate, Steps
from hood.rollouts.verdict.rule import Reason, Verdict


def rollout(frames: int = 10, **settings: Any) -> RolloutData:
    """At ten frames a second."""
    pos, none = np.zeros((frames, 3, 3)), np.zeros((frames, 0, 3))
    faces, attributes = np.array([[0, 1, 2]]), {"dt": 0.1, "config": json.dumps(settings)}
    return RolloutData(pos, faces, pos[0], none, faces[:0], 0.1 * np.arange(frames), {}, attributes)


def test_events_by_their_frames_in_words() -> None:
    events = [
        {"time": 0.25, "close": ["zip", "hood"]},
        {"frame": 1, "open": "zip"},
        {"frame": 4, "detach": [7, 8, "waistband"]},
        {"frame": 5, "attach": "lists/hem.txt"},
        {"frame": 6, "detach": 3},
        {"frame": 9, "open": "zip"},  # no step begins in the last frame
    ]
    assert moments_of(rollout(events=events)) == [
        (1, "open zip"),
        (3, "close zip, hood"),  # the first step that begins then or later
        (4, "detach waistband, 2 vertices"),
        (5, "attach hem.txt"),
        (6, "detach vertex 3"),
    ]


def test_events_count_simulated_frames_where_others_are_stored() -> None:
    """Stored ten times a second, simulated forty times."""
    early = [{"time": 0.25, "close": "zip"}, {"frame": 8, "open": "zip"}]
    events = [*early, {"frame": 17, "close": "hood"}, {"frame": 39, "open": "x"}]
    usual = rollout(events=events)
    none = np.zeros(0, dtype=np.int64)
    steps = Steps(OutputRate(10.0, 40.0), np.ones(37, dtype=bool), {}, none, np.zeros((37, 0, 3)))
    assert moments_of(replace(usual, steps=steps)) == [(2, "open zip"), (3, "close zip"), (5, "close hood")]


def test_timeline_marks_several_rollouts_name_those_that_have_them() -> None:
    opens, closes = {"frame": 2, "open": "zip"}, {"frame": 5, "close": "zip"}
    one, other = rollout(events=[opens, closes]), rollout(frames=4, events=[closes, opens])
    both = [(mark["frame"], mark["words"]) for mark in shared_marks([("a", one), ("b", other)])]
    assert both == [(2, "open zip"), (5, "close zip (a)")]
    assert [(mark["frame"], mark["words"]) for mark in shared_marks([("a", one)])] == [(2, "open zip"), (5, "close zip")]


def alarm(frame: int, cause: str, value: float) -> dict[str, Any]:
    return {"frame": frame, "cause": cause, "value": value, "limit": 0.25}


def test_alarms_of_one_cause_that_follow_each_other_are_one_mark() -> None:
    rows = [alarm(2, "strain", 0.3), alarm(3, "strain", 0.5), alarm(3, "cut", 0.1), alarm(7, "strain", 0.4)]
    assert timeline_marks(replace(rollout(), alarms=rows)) == [
        TimelineMark(2, 3, "alarm", "strain", "guard: strain, 0.5 in frame 3 (limit 0.25)"),
        TimelineMark(3, 3, "alarm", "cut", "guard: cut, 0.1 in frame 3 (limit 0.25)"),
        TimelineMark(7, 7, "alarm", "strain", "guard: strain, 0.4 in frame 7 (limit 0.25)"),
    ]


def test_alarms_count_simulated_frames_where_others_are_stored() -> None:
    none = np.zeros(0, dtype=np.int64)
    steps = Steps(OutputRate(10.0, 40.0), np.ones(37, dtype=bool), {}, none, np.zeros((37, 0, 3)))
    rows = [alarm(5, "strain", 0.3), alarm(6, "strain", 0.3), alarm(36, "cut", 0.1)]
    found = timeline_marks(replace(rollout(), alarms=rows, steps=steps))
    assert [(mark.frame, mark.last) for mark in found] == [(2, 2), (9, 9)]


def test_reasons_and_doubts_of_the_verdict_are_marked() -> None:
    """What is beyond the frames of the page is left out; what is said of no frame stands at the first."""
    reason = Reason("skin_depth", "skin stands out", ((3, 5), (8, 30), (40, 41)))
    doubts = [{"kind": "floor", "sentence": "it sinks", "frames": [4]}, {"kind": "density", "sentence": "heavy", "frames": []}]
    found = timeline_marks(rollout(), Verdict(False, (reason,), tuple(doubts)))
    assert [(mark.frame, mark.last, mark.kind, mark.words) for mark in found] == [
        (0, 0, "doubt", "density"),
        (3, 5, "unsound", "skin depth"),
        (4, 4, "doubt", "floor"),
        (8, 9, "unsound", "skin depth"),
    ]
    assert found[1].title == "unsound: skin stands out"
    off = Verdict(False, (Reason("not_worn", "it has come off"), Reason("strain", "torn", ((1, 2), (3, 6)))))
    marked = [(mark.frame, mark.last, mark.words) for mark in timeline_marks(rollout(), off)]
    assert marked == [(0, 0, "not worn"), (1, 6, "strain")]
    assert timeline_marks(rollout(), Verdict(None, (Reason("gradient", "was not measured"),))) == []


@pytest.mark.parametrize("attributes", [{}, {"config": "no table"}, {"config": "[]"}, {"dt": 0.1, "config": "{}"}])
def test_files_made_otherwise_say_nothing(attributes: dict[str, Any]) -> None:
    data = rollout()
    data.attributes.clear()
    data.attributes.update(attributes)
    assert moments_of(data) == []
    assert wind_of(data) == ""


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"wind": None}, ""),
        ({"wind": 3, "losses": {"terms": {"air": {"gusts": 0.0}}}}, "wind 3 m/s"),
        ({"wind": [1, 0, -2.5], "losses": {"terms": {"air": {"gusts": 0.2}}}}, "wind (1, 0, -2.5) m/s, gusts 20%"),
        ({"wind": 0}, "wind 0 m/s"),
    ],
)
def test_wind_in_words(settings: dict[str, Any], words: str) -> None:
    assert wind_of(rollout(**settings)) == words

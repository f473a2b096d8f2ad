"""Frames in words, and the worst of them."""

from __future__ import annotations

import numpy as np

from hood.rollouts.verdict.frames import name_frames, runs_of, worst_frame


def test_frames_in_words() -> None:
    chosen = np.zeros(40, bool)
    for numbers, words in (
        ([3], "frame 3"),
        ([3, 4], "frames 3–4"),
        ([3, 7, 8, 9, 12], "frames 3, 7–9 and 12"),
        ([1, 3, 5, 7, 9, 10], "frames 1, 3, 5 and 3 more"),
    ):
        chosen[:] = False
        chosen[numbers] = True
        assert name_frames(chosen) == words


def test_runs_are_those_of_the_frames() -> None:
    assert runs_of(np.array([True, True, False, True])) == [(0, 1), (3, 3)]
    assert runs_of(np.zeros(4, bool)) == []


def test_the_worst_frame() -> None:
    assert worst_frame(np.array([np.nan, 0.2, np.inf, 0.7, 0.1])) == (0.7, 3)
    assert worst_frame(np.array([np.nan])) is None

"""Work that takes long says how far it is, and short work says nothing."""

from __future__ import annotations

import time

import pytest

from hood.assets.files.said import ProgressLines, listening


def test_lines_come_after_a_while_and_not_too_often(monkeypatch: pytest.MonkeyPatch) -> None:
    now, heard = [0.0], []
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    progress = ProgressLines("settling")
    with listening(lambda *said: heard.append(said)):
        for second in range(30):
            now[0] = float(second)
            progress.tell(f"step {second}")
    assert heard == [(f"hood: settling: step {second}", True, True) for second in (5, 15, 25)]

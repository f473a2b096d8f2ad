"""Metrics on disk: one line per record, cut back on resume."""

from __future__ import annotations

import json
from pathlib import Path

from hood.training.metrics_log import MetricsLog


def read(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_records_are_on_disk_at_once(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, 0) as log:
        log.write(1, {"total": 0.5})
        assert read(tmp_path) == [{"iteration": 1, "total": 0.5}]
        log.write(2, {"total": 0.25, "horizon": 3.0})
    assert read(tmp_path)[1] == {"iteration": 2, "total": 0.25, "horizon": 3.0}


def test_resume_drops_what_lies_ahead(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, 0) as log:
        for iteration in range(1, 9):
            log.write(iteration, {"total": float(iteration)})
    with MetricsLog(tmp_path, 5) as log:
        log.write(6, {"total": 60.0})
    assert [(r["iteration"], r["total"]) for r in read(tmp_path)] == [(i, float(i)) for i in range(1, 6)] + [(6, 60.0)]


def test_a_fresh_run_starts_a_fresh_file(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 4, "total": 1.0}\n')
    with MetricsLog(tmp_path, 0):
        pass
    assert read(tmp_path) == []


def test_lines_cut_by_a_kill_are_dropped(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 1, "total": 1.0}\n7\n{"total": 2}\n{"iteration": 2, "tot')
    with MetricsLog(tmp_path, 3) as log:
        log.write(4, {"total": 4.0})
    assert [record["iteration"] for record in read(tmp_path)] == [1, 4]

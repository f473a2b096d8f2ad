"""Rollouts of an evaluation on disk: what is read back, by whom, and what a kill or a full disk leaves."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from hood.evaluation.files import EvaluationUnit, RolloutLog
from hood.evaluation.table import MeasuredRollout

FIRST, SECOND = EvaluationUnit(0, "tank", "walk"), EvaluationUnit(1, "dress", "a b/c.npz")
MEASURED = MeasuredRollout([{"ms_total": 1.5}, {"ms_total": 2.5}], [7], [{"gamma": 0.1, "converged": 1.0, "spread": 0.0}])


def test_every_process_reads_what_all_wrote(tmp_path: Path) -> None:
    RolloutLog(tmp_path, 0).write(FIRST, "x", MEASURED)
    RolloutLog(tmp_path, 1).write(SECOND, "y", MeasuredRollout())
    assert RolloutLog(tmp_path, 5).read(["x", "y"]) == {FIRST: MEASURED, SECOND: MeasuredRollout()}


def test_other_weights_are_not_taken_over(tmp_path: Path) -> None:
    log = RolloutLog(tmp_path)
    log.write(FIRST, "x", MEASURED)
    log.write(SECOND, "y", MEASURED)
    assert set(log.read(["x", "z"])) == {FIRST}
    assert set(log.read(["x"])) == {FIRST}


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_line_cut_by_a_kill_costs_that_rollout_alone(share: float, tmp_path: Path) -> None:
    log = RolloutLog(tmp_path)
    log.write(FIRST, "x", MEASURED)
    whole = len(log.path.read_bytes())
    log.write(SECOND, "y", MEASURED)
    content = log.path.read_bytes()
    log.path.write_bytes(content[: whole + int(share * (len(content) - whole - 1))])
    assert log.read(["x", "y"]) == {FIRST: MEASURED}
    log.write(SECOND, "y", MEASURED)
    assert log.read(["x", "y"]) == {FIRST: MEASURED, SECOND: MEASURED}


def test_nothing_there(tmp_path: Path) -> None:
    assert RolloutLog(tmp_path / "none").read(["x"]) == {}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_named(tmp_path: Path) -> None:
    log = RolloutLog(tmp_path)
    log.path.symlink_to("/dev/full")
    with pytest.raises(OSError) as error:
        log.write(FIRST, "x", MEASURED)
    assert (error.value.errno, error.value.filename) == (errno.ENOSPC, str(log.path))

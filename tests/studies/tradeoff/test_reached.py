"""What is read from a point's folder, what counts as too much strain, and the tables for refinement."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from measured_points import point, reached, rollout, solver, write_point

from hood.evaluation.files import EvaluationUnit, RolloutLog
from hood.evaluation.table import MeasuredRollout
from hood.steppers.stopping import floor_from_table
from hood.studies.tradeoff.comparison import Study
from hood.studies.tradeoff.results import overstretched, read_measured, read_reached, refinement_tables, summarise_points


def test_a_folder_is_read_as_it_was_written(tmp_path: Path) -> None:
    one = point("guess", 2)
    broken = rollout([40.0], [0.4], strain=0.3, converged=0.0)
    broken.failures.append(9)
    write_point(tmp_path, one, [rollout([10.0, 20.0], [-0.1, 0.2]), rollout([30.0], [0.3], spread=0.5), broken])
    found = read_reached(one, tmp_path, 1014, read_measured(tmp_path))
    assert found.ms.value == 25.0
    assert found.ms_p95.value == pytest.approx(np.quantile([10, 20, 30, 40], 0.95))
    assert found.gap.value == pytest.approx(0.25)
    assert found.gap.low == pytest.approx(-0.1)
    assert (found.rollouts, found.frames, found.states) == (3, 4, 4)
    assert (found.unconverged, found.disagreeing, found.doubtful, found.failures) == (1, 1, 1, 1)
    assert found.parts == pytest.approx({"search": 2.5, "features": 2.5, "network": 15.0, "refine": 2.5, "rest": 2.5})
    row = found.row()
    assert row["device"] == "CPU (made up)"
    assert row["command"] == one.command
    assert row["gap_low"] < 0


def test_minima_apart_by_a_hundredth_of_the_gap_leave_no_doubt(tmp_path: Path) -> None:
    one = point("guess", 2)
    write_point(tmp_path, one, [rollout([10.0, 20.0], [4.0, 5.0], spread=0.05)])
    found = read_reached(one, tmp_path, 1014)
    assert (found.disagreeing, found.doubtful) == (2, 0)


def test_negative_gaps_survive(tmp_path: Path) -> None:
    one = point("newton")
    write_point(tmp_path, one, [rollout([10.0], [-2e-7, -1e-7, -3e-7])])
    row = read_reached(one, tmp_path, 1000).row()
    assert (row["gap"], row["gap_low"], row["gap_high"]) == (-2e-7, -3e-7, -1e-7)


def test_what_was_not_measured_is_none_in_the_files(tmp_path: Path) -> None:
    one = point("guess", 2)
    write_point(tmp_path, one, [rollout([10.0], [])])
    found = read_reached(one, tmp_path, 1000)
    assert not found.charted
    assert found.row()["gap"] is None
    json.dumps(found.row(), allow_nan=False)


def test_rollouts_measured_again_replace_those_with_other_weights(tmp_path: Path) -> None:
    RolloutLog(tmp_path).write(EvaluationUnit(0, "tank", "walk"), "old", rollout([10.0], [9.0]))
    RolloutLog(tmp_path).write(EvaluationUnit(0, "tank", "walk"), "new", rollout([20.0], [1.0]))
    found = read_reached(point(), tmp_path, 1000)
    assert (found.rollouts, found.ms.value, found.gap.value) == (1, 20.0, 1.0)


@pytest.mark.parametrize(
    "rollouts, words", [([], "no rollout was written"), ([MeasuredRollout(failures=[1])], "non-finite before")]
)
def test_a_folder_that_says_nothing_is_refused(rollouts: list[MeasuredRollout], words: str, tmp_path: Path) -> None:
    write_point(tmp_path, point(), rollouts)
    with pytest.raises(ValueError, match=words):
        read_reached(point(), tmp_path, 1000)


def test_too_much_strain_is_twice_the_converged_solvers_at_that_size() -> None:
    sound, stretched = reached("net", 0, 1.0, 0.1, strain=0.19), reached("net", 1, 1.0, 0.1, strain=0.21)
    elsewhere = reached("net", 0, 1.0, 0.1, size="4k", strain=9.0)
    items = [sound, stretched, elsewhere, *solver({2: (1.0, 0.1)}, strain=0.1)]
    assert overstretched(items) == {stretched.point}


def test_points_of_different_machines_are_not_compared_silently() -> None:
    records = {"device": "CPU (a)", "jobs": 2}, {"device": "CPU (a)", "jobs": 1}, {"device": "CPU (b)", "jobs": 2}
    items = [summarise_points(point("net", k), [rollout([1.0], [0.1])], 1000, record) for k, record in enumerate(records)]
    assert "not all measured on one machine" in Study([items[0], items[1]], set()).warning
    assert "not all measured on one machine" in Study([items[0], items[2]], set()).warning
    assert Study([items[0]], set()).warning == ""


def test_steps_that_the_solver_left_unsolved_are_counted() -> None:
    measured = rollout([1.0, 1.0], [0.1])
    measured.frames[0]["solver_converged"] = 0.0
    measured.frames[1]["solver_converged"] = 1.0
    assert summarise_points(point("newton"), [measured], 1000, {}).unsolved == 0.5
    assert summarise_points(point(), [rollout([1.0], [0.1])], 1000, {}).unsolved == 0.0


def test_a_shared_processor_is_noticed_on_a_cpu() -> None:
    def measured(device: str, share: float | None) -> Study:
        item = summarise_points(point(), [rollout([1.0], [0.1])], 1000, {"device": device, "cpu_share": share})
        other = summarise_points(point("net", 5), [rollout([1.0], [0.1])], 1000, {"device": device, "cpu_share": 0.99})
        return Study([item, other], set())

    assert "1 of 2 settings had their processor for only a part of the time (down to 40%)" in measured("CPU (a)", 0.4).warning
    assert measured("CPU (a)", 0.97).warning == measured("CPU (a)", None).warning == measured("GPU (b)", 0.4).warning == ""


def test_the_dial_reads_the_tables(tmp_path: Path) -> None:
    items = [reached("net", k, 10.0 + k, 0.1 / (k + 1), strain=0.2 / (k + 1)) for k in (0, 2, 5)]
    items += [reached("net", 5, 50.0, 0.1, size="4k", vertices=4000, strain=0.15), *solver({2: (1.0, 0.1)})]
    tables = refinement_tables(items)
    assert set(tables) == {"net_fp32", "guess_fp32"}
    rows = tables["net_fp32"]["rows"]
    assert all(set(row) == {"method", "vertices", "refine", "ms", "gap", "gap_p95", "strain_p99"} for row in rows)
    assert [row["refine"] for row in rows] == [0, 2, 5, 5]
    path = tmp_path / "refine_table.json"
    path.write_text(json.dumps(tables["net_fp32"], allow_nan=False))
    assert floor_from_table(path, 0.1, 1100, "newton") == 2
    assert floor_from_table(path, 0.01, 3900, "newton") == 5

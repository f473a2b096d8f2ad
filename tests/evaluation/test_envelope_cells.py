"""The stability map: its cells, and the class that a run gets."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from hood.evaluation.envelope import DEGRADED, FAILED, REFUSED, SILENT, SOUND, Cell, Criteria, Run, cells, judge, shares, table

CELL, CRITERIA = Cell("spin", "2 rev/s"), Criteria()


def metrics(strain: float = 0.1, **more: float) -> dict[str, np.ndarray]:
    """Of ten frames; what is given is so in frame 6."""
    found = {"finite": np.ones(10, dtype=bool), "strain_p99": np.full(10, 0.1)}
    found |= {key: np.zeros(10) for key in ("cut_face_share", "penetration_depth", "self_crossings")}
    for key, value in {"strain_p99": strain, **more}.items():
        found[key][6] = value
    return found


def test_cells_are_many_and_have_names_of_their_own() -> None:
    names = [cell.name for cell in cells()]
    assert len(names) >= 75
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9.-]+", name) for name in names)
    assert {"dt", "stretching", "density", "gravity", "friction", "speed", "teleport", "spin", "size", "slivers", "rest"} <= {
        cell.factor for cell in cells()
    }


def test_a_run_within_all_limits_is_sound() -> None:
    assert judge(CELL, Run(0, "", (), metrics()), metrics(), False, CRITERIA).kind == SOUND


@pytest.mark.parametrize(
    ("found", "reason"),
    [
        (metrics(strain=0.3), "strain p99 30% in the worst frame, beyond 25%"),
        (metrics(cut_face_share=0.02), "2.0% of the cloth's triangles cut by the skin"),
        (metrics(penetration_depth=0.02), "0.02 m deep in the body"),
        (metrics(self_crossings=3.0), "3 pairs of triangles of the garment through each other"),
        (metrics() | {"solver_converged": np.array([np.nan] + [1.0] * 8 + [0.0])}, "met its target in 89% of the steps"),
    ],
)
def test_a_shortcoming_is_silent_until_something_is_said(found: dict[str, np.ndarray], reason: str) -> None:
    for said, exit_code, kind in (((), 0, SILENT), (("fast",), 0, DEGRADED), ((), 3, DEGRADED)):
        judged = judge(CELL, Run(exit_code, "", said, found), metrics(), False, CRITERIA)
        assert judged.kind == kind
        assert len(judged.reasons) == 1
        assert reason in judged.reasons[0]


def test_strain_that_the_solver_has_too_is_sound_and_networks_are_held_to_it() -> None:
    run = Run(0, "", (), metrics(strain=0.4))
    assert judge(CELL, run, metrics(strain=0.38), True, CRITERIA).kind == SOUND
    assert judge(CELL, run, metrics(strain=0.3), True, CRITERIA).reasons == ("strain p99 40%, the solver's is 30%",)
    assert judge(CELL, run, metrics(strain=0.3), False, CRITERIA).kind == SOUND
    assert judge(CELL, run, None, False, CRITERIA).kind == SILENT


def test_frames_that_are_not_finite_and_runs_without_a_file() -> None:
    broken = metrics()
    broken["finite"][4:] = False
    assert judge(CELL, Run(3, "", (), broken), None, False, CRITERIA) == judge(
        CELL, Run(0, "", ("broke",), broken), None, False, CRITERIA
    )
    assert judge(CELL, Run(3, "", (), broken), None, False, CRITERIA).kind == FAILED
    assert judge(CELL, Run(0, "", (), broken), None, False, CRITERIA).kind == SILENT
    assert judge(CELL, Run(2, "no such fabric"), None, False, CRITERIA).kind == FAILED
    assert judge(CELL, Run(2, ""), None, False, CRITERIA).kind == SILENT
    assert judge(CELL, Run(-11, ""), None, False, CRITERIA).reasons == ("ended with exit code -11 and no sentence",)


def test_bad_input_is_to_be_refused_for_what_it_is() -> None:
    cell = replace(CELL, bad_input="density")
    assert judge(cell, Run(2, "material 'density' is 0"), None, False, CRITERIA).kind == REFUSED
    assert judge(cell, Run(2, "output: no folder is named"), None, False, CRITERIA).kind == FAILED
    taken = judge(cell, Run(0, "", (), metrics()), metrics(), False, CRITERIA)
    assert taken.kind == SILENT
    assert taken.reasons == ("bad input was taken",)


def test_strain_that_climbs_at_rest() -> None:
    climbing = metrics() | {"strain_p99": np.linspace(0.05, 0.15, 300)}
    rest = replace(CELL, factor="rest")
    assert (
        "strain climbs by 3.3 points per 100 frames at rest"
        in judge(rest, Run(0, "", (), climbing), climbing, False, CRITERIA).reasons
    )
    assert judge(CELL, Run(0, "", (), climbing), climbing, False, CRITERIA).kind == SOUND


def test_shares_leave_refusals_out_and_the_table_counts() -> None:
    assert shares([SOUND, SOUND, SILENT, REFUSED]) == {SOUND: 2 / 3, DEGRADED: 0.0, FAILED: 0.0, SILENT: 1 / 3}
    rows = [{"factor": "dt", "model": "newton", "class": kind} for kind in (SOUND, DEGRADED, SOUND)]
    text = table(rows, ["newton", "ours"])
    assert text.splitlines()[1].split() == ["dt", "2/3,", "1", "degraded"]

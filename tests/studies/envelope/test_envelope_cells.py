"""The stability map: its cells, and the class that a run gets."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from hood.studies.envelope.cells import NOMINAL, ORDERED, Cell, cells
from hood.studies.envelope.extreme_files import MOTIONS
from hood.studies.envelope.extreme_garments import FAULTS
from hood.studies.envelope.judge import (
    DEGRADED,
    FAILED,
    REFUSED,
    SILENT,
    SOUND,
    Criteria,
    JudgedRun,
    form,
    judge,
    judged_table,
    shares,
    usual_of,
    what_was_said,
)

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
    assert sum(not (cell.bad_input or cell.long) for cell in cells()) >= 150
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9.-]+", name) for name in names)
    assert cells()[0].factor == NOMINAL
    factors = [cell.factor for cell in cells()]
    assert ORDERED <= set(factors)
    assert len(set(factors)) == len([name for name, before in zip(factors, ["", *factors], strict=False) if name != before])


def test_every_cell_is_made_from_what_there_is() -> None:
    for cell in cells():
        motion, fault = ((name or "rest").partition(":")[0] for name in (cell.motion, cell.fault))
        assert cell.bad_input or (motion in MOTIONS and (cell.fault is None or fault in FAULTS))
        assert 1 <= cell.num_frames <= 10_000
        assert cell.long == (cell.num_frames > 300)
        rates = [float(text.partition("=")[2]) for text in cell.settings if text.startswith("fps=")]
        assert cell.bad_input or rates == [rate for rate in [cell.fps] if rate != 30.0]


def test_a_run_within_all_limits_is_sound() -> None:
    assert judge(CELL, JudgedRun(0, "", (), (), metrics()), metrics(), False, CRITERIA).kind == SOUND


def test_a_shortcoming_is_silent_until_something_is_said() -> None:
    found = metrics(strain=0.3)
    for warnings, unsound, kind in (((), (), SILENT), (("fast",), (), DEGRADED), ((), ("strained",), DEGRADED)):
        judged = judge(CELL, JudgedRun(3 if unsound else 0, "", warnings, unsound, found), metrics(), False, CRITERIA)
        assert judged.kind == kind
        assert judged.said == warnings + unsound
        assert judged.reasons == (unsound or ("strain p99 30% in the worst frame, beyond 25%",))


def test_what_the_rule_calls_unsound_is_not_sound_here() -> None:
    """Within the limits of a reference, and the verdict says why it is not sound."""
    judged = judge(CELL, JudgedRun(3, "", (), ("'dress' has come off",), metrics()), metrics(), True, CRITERIA)
    assert (judged.kind, judged.reasons) == (DEGRADED, ("'dress' has come off",))


def test_what_is_always_said_says_nothing() -> None:
    usual = {
        form(text) for text in ("half of 'dress' is 2 m away", "warning: cut in frame 12", "strained in frames 3, 7–9 and 12")
    }
    found = metrics(strain=0.9)
    for text, kind in (
        ("half of 'sheet' is 7.5 m away", SILENT),
        ("strained in frame 7", SILENT),
        ("strained in frames 1–2 and 4 more", SILENT),
        ("the body jumps in frame 12", DEGRADED),
    ):
        assert judge(CELL, JudgedRun(0, "", (text,), (), found), None, False, CRITERIA, usual).kind == kind
    measured, text = "guard: 2 of 9 steps: strain p99 12% away", "'ours' is not trained for 7.5"
    assert usual_of((measured, text), wanting=False) == {form(measured), form(text)}
    assert usual_of((measured, text), wanting=True) == {form(text)}
    run = JudgedRun(3, "", ("warning: cut in frame 5",), ("strain is beyond 50% in frame 5",), found)
    assert what_was_said(run, usual) == ("strain is beyond 50% in frame 5",)
    assert what_was_said(JudgedRun(2, "no such file"), ()) == ("no such file",)


def test_strain_that_the_solver_has_too_is_sound_and_networks_are_held_to_it() -> None:
    run = JudgedRun(0, "", (), (), metrics(strain=0.4))
    assert judge(CELL, run, metrics(strain=0.38), True, CRITERIA).kind == SOUND
    assert judge(CELL, run, metrics(strain=0.3), True, CRITERIA).reasons == ("strain p99 40%, the solver's is 30%",)
    assert judge(CELL, run, metrics(strain=0.3), False, CRITERIA).kind == SOUND
    assert judge(CELL, run, None, False, CRITERIA).kind == SILENT


def test_frames_that_are_not_finite_and_runs_without_a_file() -> None:
    broken = metrics()
    broken["finite"][4:] = False
    told = judge(CELL, JudgedRun(3, "", (), ("1 of 10 frames is not finite",), broken), None, False, CRITERIA)
    assert (told.kind, told.reasons) == (FAILED, ("not finite from frame 4 on",))
    assert judge(CELL, JudgedRun(0, "", (), (), broken), None, False, CRITERIA).kind == SILENT
    assert judge(CELL, JudgedRun(2, "no such fabric"), None, False, CRITERIA).kind == FAILED
    assert judge(CELL, JudgedRun(2, ""), None, False, CRITERIA).kind == SILENT
    late = judge(CELL, JudgedRun(-9, "not done after 900 s", late=True), None, False, CRITERIA)
    assert (late.kind, late.reasons) == (FAILED, ("not done after 900 s",))
    assert judge(CELL, JudgedRun(-11, ""), None, False, CRITERIA).reasons == ("ended with exit code -11 and no sentence",)


def test_bad_input_is_to_be_refused_for_what_it_is() -> None:
    cell = replace(CELL, bad_input="density")
    assert judge(cell, JudgedRun(2, "material 'density' is 0"), None, False, CRITERIA).kind == REFUSED
    assert judge(cell, JudgedRun(2, "output: no folder is named"), None, False, CRITERIA).kind == FAILED
    taken = judge(cell, JudgedRun(0, "", (), (), metrics()), metrics(), False, CRITERIA)
    assert taken.kind == SILENT
    assert taken.reasons == ("bad input was taken",)


def test_strain_that_climbs_at_rest() -> None:
    climbing = metrics() | {"strain_p99": np.linspace(0.05, 0.15, 300)}
    rest = replace(CELL, motion="rest")
    assert (
        "strain climbs by 3.3 points per 100 frames at rest"
        in judge(rest, JudgedRun(0, "", (), (), climbing), climbing, False, CRITERIA).reasons
    )
    assert judge(CELL, JudgedRun(0, "", (), (), climbing), climbing, False, CRITERIA).kind == SOUND


def test_shares_leave_refusals_out_and_the_table_counts() -> None:
    assert shares([SOUND, SOUND, SILENT, REFUSED]) == {SOUND: 2 / 3, DEGRADED: 0.0, FAILED: 0.0, SILENT: 1 / 3}
    rows = [{"factor": "dt", "model": "newton", "class": kind} for kind in (SOUND, DEGRADED, SOUND)]
    text = judged_table(rows, ["newton", "ours"])
    assert text.splitlines()[1].split() == ["dt", "2/3,", "1", "degraded"]

"""The page beside the paper's Table 1: its figures, its checks, and what it says where there is nothing to compare."""

from __future__ import annotations

from typing import Any

import pytest

from hood.app.candidates import command_line, training_note
from hood.assets.files.library import locate
from hood.energies.potential import default_potential
from hood.evaluation.table import ALL, Candidate, MeasuredRollout, candidate_rows
from hood.evaluation.table_one import TableConditions, checks, page
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import NewtonStepper

ABOUT = TableConditions(
    "hood evaluate models=[fine15,ours]", "A Processor, 1 thread(s)", "default (embedded)", ["walk", "plie"], 1, 30, 30.0,
    {"dress": 1000, "tank": 500}, {"ours": "2,400 updates"},
)  # fmt: skip


def row(model: str, garment: str = ALL, **values: Any) -> dict[str, Any]:
    reach = {"fine15": (15, 15), "fine48": (48, 48), "ours": (15, 48)}.get(model, (None, None))
    base = {"model": model, "weights": "m.safetensors", "garment": garment, "steps": reach[0], "radius": reach[1], "ms": 100.0}
    return base | {"fps": 10.0, "L_total": 1.0, "gradient_norm": 0.02} | values


def rollout(value: float, end: int | None = None) -> MeasuredRollout:
    frame = {"ms_total": value, "energy_total": value, "strain_p99": 0.1, "relative_gradient": 1.0, "gradient_norm": value}
    return MeasuredRollout([frame] * 3, gaps=[{"gamma": value, "converged": 1.0, "spread": 0.0}], ends=[end])


def solver() -> Candidate:
    return Candidate("newton", "none", NewtonStepper(default_potential(), NewtonSettings()))


def found(rows: list[dict[str, Any]]) -> dict[str, tuple[str, bool | None]]:
    return {check.what: (check.here, check.holds) for check in checks(rows)}


def test_the_paper_itself_passes() -> None:
    rows = [
        row(
            "fine15", ms=76.3, ms_low=75.0, ms_high=78.0, L_total=1.68, L_total_low=1.6, L_total_high=1.7, gradient_norm=3.7e-2
        ),
        row("fine48", ms=1e3 / 4.99, L_total=1.04, L_total_low=1.0, L_total_high=1.05, gradient_norm=2.5e-2),
        row(
            "ours", ms=73.5, ms_low=72.0, ms_high=75.0, L_total=1.07, L_total_low=1.06, L_total_high=1.2, gradient_norm=2.72e-2
        ),
    ]
    here = found(rows)
    assert here["propagation radius [edges]"] == ("15 (Fine15) / 48 (Fine48) / 48 (Ours)", True)
    assert here["time of Ours / Fine15, all"] == ("0.96 (at most 1.3 counts as the same)", True)
    assert here["order by L_total, all"] == ("Fine48 < Ours < Fine15", True)
    assert here["order by gradient norm, all"] == ("Fine48 ≈ Ours ≈ Fine15", None)
    assert here["order by γ, all"] == ("fewer than two of these models", None)


def test_what_is_otherwise_is_said() -> None:
    sure = {"ms_low": 90.0, "ms_high": 100.0, "L_total_low": 0.9, "L_total_high": 1.1}
    slow = {"ms_low": 135.0, "ms_high": 145.0, "L_total_low": 1.9, "L_total_high": 2.1}
    rows = [row("fine15", L_total=1.0, gap=0.1, **sure), row("ours", ms=140.0, L_total=2.0, radius=47, gap=0.2, **slow)]
    here = found(rows)
    assert here["propagation radius [edges]"][1] is False
    assert here["time of Ours / Fine15, all"] == ("1.40 (at most 1.3 counts as the same)", False)
    assert here["order by L_total, all"] == ("Fine15 < Ours", False)
    assert here["order by γ, all"] == ("Fine15 ≈ Ours", None)


def test_intervals_that_overlap_leave_claims_open() -> None:
    rows = [
        row("fine15", ms=100.0, ms_low=80.0, ms_high=120.0, L_total=1.0),
        row("ours", ms=140.0, ms_low=120.0, ms_high=160.0),
    ]
    here = found(rows)
    assert here["time of Ours / Fine15, all"] == ("1.40 (at most 1.3 counts as the same)", None)
    assert here["order by L_total, all"] == ("Fine15 ≈ Ours", None)


def test_random_weights_and_other_models_prove_nothing() -> None:
    rows = [row("fine15", weights="untrained"), row("ours", weights="untrained", L_total=2.0), row("quickstart")]
    here = found(rows)
    assert here["order by L_total, all"] == ("random weights: their order means nothing", None)
    assert here["propagation radius [edges]"][1] is True
    assert here["time of Ours / Fine15, all"] == ("1.00 (at most 1.3 counts as the same)", None)
    assert all(check.holds is None for check in checks([row("quickstart")]))


def test_the_dress_has_the_papers_first_figures() -> None:
    rows = [row("fine15", "dress"), row("ours", "dress"), row("fine15"), row("ours")]
    papers = {check.what: check.paper for check in checks(rows)}
    assert papers["time of Ours / Fine15, dress"] == "0.91"
    assert papers["time of Ours / Fine15, all"] == "0.96"
    text = page(rows, ABOUT)
    assert "| Fine15, paper | dress of 12,000 vertices | 15 | 15 | 6.65 | 2.92 | 0.0237 |" in text
    assert "| Ours, paper | all | 15 | 48 | 13.6 | 1.07 | 0.0272 |" in text
    assert text.count("| **ours** | **dress** | **15** | **48** | **10** |") == 1


def test_only_the_papers_networks_stand_for_it() -> None:
    small = {"as_in_paper": False, "network": "latent 48, features local, output local_steps"}
    papers = {"as_in_paper": True, "network": "latent 128, features paper, output acceleration"}
    text = page([row("small-ours", **small), row("mine", **papers, steps=48, radius=48), row("newton")], ABOUT)
    assert "| **small-ours (other network)** | **all** |" in text
    assert "| **mine** | **all** | **48** | **48** |" in text
    assert "- Networks: the paper's have latent 128" in text
    assert "Here small-ours: latent 48, features local, output local_steps." in text
    assert "- Networks" not in page([row("ours", **papers)], ABOUT)
    text = page([row("small-ours", ms=7.0, **small), row("mine", ms=5.0, **papers, steps=15, radius=48)], ABOUT)
    assert "| **mine** | **all** |" in text
    assert "| **small-ours" not in text  # the one that is the paper's, whatever its place


def test_the_page_says_what_was_measured_and_how() -> None:
    rows = candidate_rows(solver(), {"dress": [rollout(1.0), rollout(3.0, 7)], "tank": [rollout(2.0)]})
    rows.append(row("ours", "dress"))
    text = page(rows, ABOUT)
    assert text == page(rows, ABOUT)
    assert "```\nhood evaluate models=[fine15,ours]\n```" in text
    assert "A Processor, 1 thread(s)" in text
    assert "2 motions (walk, plie) of at most 30 frames at 30 per second" in text
    assert "dress 1,000, tank 500" in text
    assert "ours: 2,400 updates." in text
    assert "| newton | dress | 2 | – | – | 2 (1 to 3) | 3 |" in text
    assert "| newton | tank | 1 | – | – | 2 | 2 |" in text
    for line in text.splitlines():
        if line.startswith("| newton"):
            assert line.count(" |") in (17, 22)


def test_failures_are_counted_by_rollout() -> None:
    rows = candidate_rows(solver(), {"a": [rollout(1.0), rollout(1.0, 9), rollout(1.0, 4)], "b": [rollout(1.0)], "c": []})
    a, b, c, whole = rows
    assert (a["rollouts"], a["failed"], a["frames_to_failure"]) == (3, pytest.approx(2 / 3), 9)
    assert (b["failed"], b["frames_to_failure"]) == (0.0, None)
    assert (c["rollouts"], c.get("failed")) == (0, None)
    assert (whole["rollouts"], whole["failed"], whole["frames_to_failure"]) == (4, 0.5, 9)


def test_how_far_minima_are_apart_is_told() -> None:
    """States with one converged minimisation know of no distance."""
    gaps = [{"gamma": 0.1, "converged": 1.0, "spread": value} for value in (0.0, 0.02, 0.04, float("nan"))]
    known, unknown = (candidate_rows(solver(), {"a": [MeasuredRollout(gaps=part)]})[0] for part in (gaps, gaps[3:]))
    assert (known["disagree"], known["gap_spread"]) == (0.5, pytest.approx(0.038))
    assert (unknown["disagree"], unknown["gap_spread"]) == (0.0, None)


def test_intervals_are_those_between_rollouts() -> None:
    one, two = (candidate_rows(solver(), {"a": part})[0] for part in ([rollout(1.0)], [rollout(1.0), rollout(3.0)]))
    assert "ms_low" not in one
    for column in ("ms", "L_total", "gap", "gradient_norm"):
        assert (two[f"{column}_low"], two[column], two[f"{column}_high"]) == (1.0, 2.0, 3.0)
    assert two["strain_p99_low"] == two["strain_p99_high"] == pytest.approx(0.1)


def test_the_command_is_one_line_that_can_be_typed() -> None:
    given = ["models=[ours]", "shapes=[[],[2]]", "output=/somewhere/else", "resume=true"]
    assert command_line("evaluate", given) == "hood evaluate 'models=[ours]' 'shapes=[[],[2]]'"


def test_the_shipped_model_names_its_budget() -> None:
    assert training_note(locate("weights", "quickstart")) == "16,372 updates"

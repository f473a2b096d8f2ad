"""The table of cost, reach and accuracy."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.app.settings.compose import build, load_config
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.evaluation import table
from hood.evaluation.files import columns, describe_rows, format_table, write_rows
from hood.evaluation.table import ALL, TERMS, Candidate, GapSettings, evaluate, other_terms
from hood.evaluation.table_one import TableConditions, page
from hood.evaluation.validation import Validation
from hood.rollouts.loop import simulate
from hood.rollouts.verdict.rule import Reason, Verdict
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings
from hood.steppers.network import build_simulator
from hood.steppers.newton import NewtonStepper

FRAMES = 6


@pytest.fixture(scope="module")
def candidates() -> list[Candidate]:
    torch.manual_seed(0)
    base = build_simulator("physical", "velocity_base", "1x(mesh)", latent_dim=4, output_init=0.1).eval()
    wild = build_simulator("paper", "acceleration", "2x(mesh)", latent_dim=4, output_init=1e30).eval()
    return [Candidate("base", "untrained", base), Candidate("wild", "untrained", wild)]


@pytest.fixture(scope="module")
def rows(candidates: list[Candidate], tank_scene: Scene, skirt_scene: Scene) -> list[dict]:
    scenes = {"tank": [tank_scene], "skirt": [skirt_scene, skirt_scene]}
    return evaluate(candidates, scenes, default_potential(), FRAMES, GapSettings(states=0))


@pytest.fixture(scope="module")
def solver_rows(band_scene: Scene) -> list[dict]:
    """The solver, and the guess it starts from taken for the answer."""
    potential = default_potential()
    solver = NewtonStepper(potential, NewtonSettings(target_rg=1e-3))
    guess = NewtonStepper(potential, NewtonSettings(max_iterations=0))
    pair = [Candidate("newton", "none", solver), Candidate("guess", "none", guess)]
    return evaluate(pair, {"band": [band_scene]}, potential, 7, GapSettings(states=2))


def test_the_verdict_is_that_of_the_rule_and_what_it_does_not_judge_is_not_sound(
    rows: list[dict], solver_rows: list[dict]
) -> None:
    assert [row["sound"] for row in solver_rows if row["model"] == "newton"] == [1.0, 1.0]
    assert {row["sound"] for row in rows if row["model"] == "wild"} == {0.0}
    whole = next(row for row in rows if row["model"] == "wild" and row["garment"] == ALL)
    assert "not_finite 3" in whole["unsound_for"]
    columns_of = table._verdict_columns
    assert columns_of([]) == columns_of([None]) == {}
    assert columns_of([[], None, ["strain", "strain", "distance"], ["strain"]]) == {
        "sound": pytest.approx(1 / 3), "unsound_for": "strain 2, distance 1",
    }  # fmt: skip


def test_what_gamma_is_in_joules_and_how_long_the_cloth_was_worn(rows: list[dict], solver_rows: list[dict]) -> None:
    newton, _, guess, _ = solver_rows
    assert 0 <= newton["L_above"] < 1e-3 * guess["L_above"]
    assert guess["L_states"] > newton["L_states"] + 0.9 * guess["L_above"]
    assert [row["worn"] for row in rows if row["model"] == "base"] == [1.0] * 3
    assert all(0 < row["worn"] < 1 for row in rows if row["model"] == "wild")
    off = Reason("not_worn", "", ((4, 9),)), Reason("strain", "", ((0, 1),))
    assert table._worn_share(Verdict(False, off), 10) == 0.4
    assert table._worn_share(Verdict(False, off[1:]), 10) == 1.0


def test_one_row_per_model_and_garment_and_one_over_all(rows: list[dict]) -> None:
    assert [(row["model"], row["garment"]) for row in rows] == [
        (model, garment) for model in ("base", "wild") for garment in ("tank", "skirt", ALL)
    ]
    assert {row["steps"] for row in rows if row["model"] == "base"} == {1}
    assert {row["radius"] for row in rows if row["model"] == "wild"} == {2}
    for row in rows:
        assert set(row) <= set(columns(rows))


def test_numbers_are_the_means_of_the_rollout(rows: list[dict], candidates: list[Candidate], tank_scene: Scene) -> None:
    """Frames after the warm-up count, frame 0 never."""
    frames = list(simulate(candidates[0].stepper, tank_scene, default_potential(), FRAMES))[3:]
    row = rows[0]
    assert row["frames"] == len(frames) == 3
    assert row["failed_at"] is None
    for column, key in (
        ("L_total", "energy_total"), ("L_stretching", "energy_stretching"), ("gradient_norm", "gradient_norm"),
        ("penetration", "penetration_share"),
    ):  # fmt: skip
        assert row[column] == pytest.approx(np.mean([frame.metrics[key] for frame in frames]), rel=1e-6)
    assert row["rg"] == pytest.approx(np.median([f.metrics["relative_gradient"] for f in frames]))
    assert row["strain_p99"] == pytest.approx(np.median([f.metrics["strain_p99"] for f in frames]))
    assert row["penetration_worst"] == max(f.metrics["penetration_share"] for f in frames)
    measured = [f.metrics["cut_face_share"] for f in frames if "cut_face_share" in f.metrics]
    assert len(measured) == 1  # of frames 3, 4 and 5: every fifth, and the last
    assert (row["cut_faces"], row["cut_faces_worst"]) == pytest.approx((np.mean(measured), max(measured)))
    assert row["crossings"] >= 0
    assert row.get("drift") is None
    assert row["ms"] > 0
    assert row["fps"] == pytest.approx(1e3 / row["ms"])
    assert row["ms_p99"] >= row["ms"]


def test_all_pools_the_frames(rows: list[dict]) -> None:
    tank, skirt, both = rows[:3]
    assert (tank["frames"], skirt["frames"], both["frames"]) == (3, 6, 9)
    assert both["L_total"] == pytest.approx((tank["L_total"] * 3 + skirt["L_total"] * 6) / 9)


def test_a_broken_model_is_reported_not_averaged(rows: list[dict]) -> None:
    for row in rows[3:]:
        assert row["failed_at"] is not None
        assert 1 <= row["failed_at"] < FRAMES
        assert all(value is None or not isinstance(value, float) or np.isfinite(value) for value in row.values())


def test_the_solver_has_no_gap_and_a_guess_has_one(solver_rows: list[dict]) -> None:
    newton, _, guess, _ = solver_rows
    assert (newton["steps"], newton["radius"], newton["weights"]) == (None, None, "none")
    assert (newton["frames"], newton["gap_states"]) == (4, 2)
    assert abs(newton["gap"]) <= newton["gap_p95"] + 1e-6 <= 1e-2
    assert newton["rg"] <= 2e-3  # the solver's 1e-3, after rounding to float32
    assert newton["unconverged"] == newton["disagree"] == 0.0
    assert guess["gap"] > 1.0
    assert guess["gap_p95"] >= guess["gap"]
    assert guess["rg"] > newton["rg"]


def test_references_that_stop_early_are_flagged(band_scene: Scene) -> None:
    potential = default_potential()
    guess = Candidate("guess", "none", NewtonStepper(potential, NewtonSettings(max_iterations=0)))
    settings = GapSettings(2, NewtonSettings(target_rg=1e-3, max_iterations=1))
    rows = evaluate([guess], {"band": [band_scene]}, potential, 7, settings)
    assert rows[0]["unconverged"] == 1.0
    assert "2 of 2 reference minima did not converge" in describe_rows(rows)


def test_no_states_no_minimisation(candidates: list[Candidate], band_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object) -> None:
        raise RuntimeError("minimised")

    monkeypatch.setattr("hood.evaluation.gap.minimize", refuse)
    scenes = {"band": [band_scene]}
    rows = evaluate(candidates[:1], scenes, default_potential(), 5, GapSettings(states=0))
    assert rows[0]["gap_states"] == 0
    assert rows[0].get("gap") is None
    assert rows[0]["rg"] > 0
    with pytest.raises(RuntimeError, match="minimised"):
        evaluate(candidates[:1], scenes, default_potential(), 5, GapSettings(states=1))


def test_progress_names_the_work_and_counts_rollouts(candidates: list[Candidate], band_scene: Scene) -> None:
    told: list[tuple[str, int]] = []
    settings = GapSettings(1, NewtonSettings(max_iterations=1))
    scenes = {"band": [band_scene] * 2}
    evaluate(candidates[:1], scenes, default_potential(), 4, settings, lambda text, done: told.append((text, done)))
    assert told[0] == ("base band walk_proud frame 1/4", 0)
    assert told.count(("base band walk_proud gap 1/1", 1)) == 1
    assert [done for _, done in told] == sorted(done for _, done in told)
    assert told[-1][1] == 2


def test_text_and_files(rows: list[dict], solver_rows: list[dict], tmp_path: Path) -> None:
    rows = rows + solver_rows
    for part in format_table(rows).split("\n\n"):
        lines = part.splitlines()
        assert len(lines) == 1 + len(rows)
        assert len({len(line) for line in lines}) == 1
        assert max(map(len, lines)) <= 160
    assert "untrained: random weights" in describe_rows(rows)
    assert "untrained" not in describe_rows(solver_rows)
    assert "did not converge" not in describe_rows(rows)
    csv_path, json_path = write_rows(rows, columns(rows), tmp_path, "table")
    with open(csv_path, newline="") as file:
        table = list(csv.DictReader(file))
    assert list(table[0]) == list(columns(rows))
    assert [line["model"] for line in table] == [row["model"] for row in rows]
    assert float(table[0]["L_total"]) == pytest.approx(rows[0]["L_total"])
    assert table[0]["failed_at"] == table[0]["gap"] == ""
    assert float(table[-1]["gap"]) == pytest.approx(solver_rows[-1]["gap"])
    assert json.loads(json_path.read_text()) == rows
    assert sorted(path.name for path in tmp_path.iterdir()) == ["table.csv", "table.json"]


def test_other_energies_have_columns_and_all_add_up(candidates: list[Candidate], tank_scene: Scene, rows: list[dict]) -> None:
    """Air and damping, and a term of another package; what does not act has none."""

    class Wind:
        def applies(self, problem: StepProblem) -> bool:
            return True

        def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
            return problem.sum_vertices(-2.0 * problem.cloth.mass * next_pos[:, 0])

    words = ["losses.terms.air.velocity=3", "losses.terms.stretch_damping.time=0.01"]
    potential = build(load_config("evaluate", words).losses).with_terms(a_long_wind=Wind())
    found = evaluate(candidates[:1], {"tank": [tank_scene]}, potential, FRAMES, GapSettings(states=0))
    assert other_terms(rows) == ()
    assert set(other_terms(found)) == {"air", "stretch_damping", "a_long_wind"}
    for row in found:
        assert row["L_air"] != 0.0
        parts = sum(row[f"L_{name}"] for name in (*TERMS, *other_terms(found)))
        assert parts == pytest.approx(row["L_total"], rel=1e-5)
        assert set(row) <= set(columns(found))
    text = format_table(found)
    assert max(map(len, text.splitlines())) <= 160
    assert [text.count(f"L_{name}") for name in other_terms(found)] == [1, 1, 1]
    page_of = page(found, TableConditions("hood evaluate", "A Processor", "default", ["walk"], 1, FRAMES, 30.0))
    assert "| friction | air | stretch damping | a long wind |" in page_of


def test_many_energies_are_a_table_of_their_own(rows: list[dict]) -> None:
    few, many = ([row | {f"L_energy_{i}": 0.25 for i in range(count)} for row in rows] for count in (1, 6))
    assert [len(format_table(some).split("\n\n")) for some in (rows, few, many)] == [3, 3, 4]
    assert max(map(len, format_table(many).splitlines())) <= 160


def test_validation_summarises_own_rollouts(candidates: list[Candidate], tank_scene: Scene, skirt_scene: Scene) -> None:
    validation = Validation(
        tank_scene.motion.body,
        [tank_scene.garment, skirt_scene.garment],
        [tank_scene.motion.sequence],
        default_potential(),
        num_frames=4,
        states=0,
    )
    good = validation(candidates[0].stepper)
    assert good["non_finite"] == 0
    assert all(np.isfinite(value) for value in good.values())
    assert good["strain_p99"] <= good["strain_p99_worst"]
    assert good["score"] == pytest.approx(good["relative_gradient"] ** 2 * good["strain_p99"])
    assert "gap" not in good
    wild = validation(candidates[1].stepper)
    assert wild["non_finite"] > 0
    assert wild["score"] == np.inf

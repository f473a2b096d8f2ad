"""The table of cost, reach and accuracy."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from hood.dynamics.rollout import simulate
from hood.dynamics.simulator import build_simulator
from hood.evaluation.table import ALL, COLUMNS, Candidate, evaluate, format_table, write_table
from hood.evaluation.validation import Validation
from hood.losses.potential import default_potential
from hood.scene.scene import Scene

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
    return evaluate(candidates, scenes, default_potential(), FRAMES)


def test_one_row_per_model_and_garment_and_one_over_all(rows: list[dict]) -> None:
    assert [(row["model"], row["garment"]) for row in rows] == [
        (model, garment) for model in ("base", "wild") for garment in ("tank", "skirt", ALL)
    ]
    assert {row["steps"] for row in rows if row["model"] == "base"} == {1}
    assert {row["radius"] for row in rows if row["model"] == "wild"} == {2}
    for row in rows:
        assert set(row) <= set(COLUMNS)


def test_numbers_are_the_means_of_the_rollout(rows: list[dict], candidates: list[Candidate], tank_scene: Scene) -> None:
    """Frames after the warm-up count, frame 0 never."""
    frames = list(simulate(candidates[0].simulator, tank_scene, default_potential(), FRAMES))[3:]
    row = rows[0]
    assert row["frames"] == len(frames) == 3
    assert row["failed_at"] is None
    for column, key in (
        ("L_total", "energy_total"), ("L_stretching", "energy_stretching"), ("gradient_norm", "gradient_norm"),
        ("strain_p99", "strain_p99"), ("penetration", "penetration_share"),
    ):  # fmt: skip
        assert row[column] == pytest.approx(np.mean([frame.metrics[key] for frame in frames]), rel=1e-6)
    assert row["relative_gradient"] == pytest.approx(np.median([f.metrics["relative_gradient"] for f in frames]))
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


def test_text_and_files(rows: list[dict], tmp_path: Path) -> None:
    text = format_table(rows).splitlines()
    assert len(text) == 1 + len(rows)
    assert len({len(line) for line in text}) == 1
    csv_path, json_path = write_table(rows, tmp_path)
    with open(csv_path, newline="") as file:
        table = list(csv.DictReader(file))
    assert list(table[0]) == list(COLUMNS)
    assert [line["model"] for line in table] == [row["model"] for row in rows]
    assert float(table[0]["L_total"]) == pytest.approx(rows[0]["L_total"])
    assert table[0]["failed_at"] == ""
    assert json.loads(json_path.read_text()) == rows
    assert sorted(path.name for path in tmp_path.iterdir()) == ["table.csv", "table.json"]


def test_validation_summarises_own_rollouts(candidates: list[Candidate], tank_scene: Scene, skirt_scene: Scene) -> None:
    validation = Validation(
        tank_scene.motion.body,
        [tank_scene.garment, skirt_scene.garment],
        [tank_scene.motion.sequence],
        default_potential(),
        num_frames=4,
    )
    good = validation(candidates[0].simulator)
    assert good["non_finite"] == 0
    assert all(np.isfinite(value) for value in good.values())
    assert good["strain_p99"] <= good["strain_p99_worst"]

"""Tables of measured refinements: where a goal begins, and what is said about a row that cannot be used."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hood.steppers.stopping import Costs, costs_from_table, floor_from_table

STRAINS = {(1000, 0): 0.2, (1000, 2): 0.08, (1000, 5): 0.04, (1000, 10): 0.03, (4000, 0): 0.5, (4000, 20): 0.09}
#: Milliseconds of a frame: 12 of set-up and 9 an iteration at 1,000 vertices.
TIMES = {(1000, 0): 100.0, (1000, 1): 121.0, (1000, 5): 157.0, (1000, 10): 202.0, (4000, 0): 400.0, (4000, 20): 1200.0}


def table(path: Path, field: str, values: dict[tuple[int, int], float], method: str = "newton") -> Path:
    rows = [{"method": method, "vertices": v, "refine": k, field: value, "gap": 0.1} for (v, k), value in values.items()]
    path.write_text(json.dumps({"rows": rows}))
    return path


def test_strain_begins_where_the_table_is_below_it(tmp_path: Path) -> None:
    path = table(tmp_path / "table.json", "strain_p99", STRAINS)
    assert floor_from_table(path, 0.1, 1200, "newton") == 2
    assert floor_from_table(path, 0.04, 1200, "newton") == 5
    assert floor_from_table(path, 0.3, 800, "newton") == 0
    assert floor_from_table(path, 0.05, 5000, "newton") == 20  # the lowest there is


def test_time_is_split_into_frame_setup_and_iteration(tmp_path: Path) -> None:
    path = table(tmp_path / "table.json", "ms", TIMES)
    assert costs_from_table(path, 1100, "newton") == Costs(9.0, 12.0, 100.0)
    assert costs_from_table(path, 9000, "newton") == Costs(40.0, 0.0, 400.0)
    alone = {key: ms for key, ms in TIMES.items() if key[1]}
    assert costs_from_table(table(tmp_path / "guess.json", "ms", alone), 1100, "newton") == Costs(9.0, 0.0, None)
    falling = {(1000, 0): 100.0, (1000, 2): 130.0, (1000, 5): 120.0}
    assert costs_from_table(table(tmp_path / "odd.json", "ms", falling), 1000, "newton").iteration == 0.0
    with pytest.raises(ValueError, match=r"few\.json: ms of 1 values of refine for method 'newton' do not say what"):
        costs_from_table(table(tmp_path / "few.json", "ms", {(1000, 0): 100.0}), 1000, "newton")


BROKEN: dict[str, tuple[Any, str]] = {
    "no time": ({"method": "newton", "vertices": 9, "refine": 1}, r"row 1: ms is missing; give a finite number, 0 or more"),
    "a word": ({"method": "newton", "vertices": 9, "refine": 1, "ms": "fast"}, r"row 1: ms is 'fast'; give a finite number"),
    "not finite": ({"method": "newton", "vertices": 9, "refine": 1, "ms": float("nan")}, r"row 1: ms is nan"),
    "negative": ({"method": "newton", "vertices": 9, "refine": 1, "ms": -2.0}, r"row 1: ms is -2\.0"),
    "half an iteration": (
        {"method": "newton", "vertices": 9, "refine": 0.5, "ms": 2.0},
        r"refine is 0\.5; give a whole number",
    ),
    "no vertices": ({"method": "newton", "vertices": 0, "refine": 1, "ms": 2.0}, r"vertices is 0; give a whole number, 1 or"),
    "no method": ({"vertices": 9, "refine": 1, "ms": 2.0}, r"row 1: method is missing; give newton or sweeps"),
    "no row": ([1, 2], r"row 1: method is missing"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_row_that_cannot_be_used_is_named(case: str, tmp_path: Path) -> None:
    row, words = BROKEN[case]
    path = tmp_path / "table.json"
    path.write_text(json.dumps({"rows": [{"method": "newton", "vertices": 9, "refine": 0, "ms": 1.0}, row]}))
    with pytest.raises(
        ValueError, match=rf"table\.json: {words}" if words.startswith("row") else rf"table\.json: row 1: {words}"
    ):
        costs_from_table(path, 9, "newton")


def test_files_that_are_no_table_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "table.json"
    for content, words in (("{", "no JSON"), ("[]", "no list named rows"), ('{"rows": 3}', "no list named rows")):
        path.write_text(content)
        with pytest.raises(ValueError, match=rf"table\.json: not a table of refinements, .*{words}"):
            floor_from_table(path, 0.1, 1000, "newton")
    with pytest.raises(ValueError, match="has no row of method 'sweeps'"):
        floor_from_table(table(path, "strain_p99", STRAINS), 0.1, 1000, "sweeps")
    with pytest.raises(FileNotFoundError):
        costs_from_table(tmp_path / "none.json", 1000, "newton")

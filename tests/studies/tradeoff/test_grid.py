"""Points of a chart and their commands."""

from __future__ import annotations

import shlex
from dataclasses import replace

import pytest

from hood.studies.tradeoff.grid import Grid, GridSize, quoted_word

SMALL = GridSize("1k", ("tshirt", "dress"), (0, 5), (2, 10), 40, 3)
LARGE = GridSize("12k", ("dress_12k",), (0,), (5,), 20, 4, models=("ours",))
GRID = Grid(("runs/ours/model.safetensors", "fine15"), ("fp32", "bf16"), ("newton",), (SMALL, LARGE), ("sequences=[plie]",))


def test_every_combination_is_one_point() -> None:
    points = GRID.points()
    small = [point for point in points if point.size == "1k"]
    assert len(small) == 2 * 2 * 2 + 2 + 1
    assert len(set(small)) == len(small)
    large = [point for point in points if point.size == "12k"]
    assert [(point.name, point.precision, point.refine) for point in large] == [
        ("ours", "fp32", 0), ("ours", "bf16", 0), ("guess", "fp32", 5), ("newton", "fp32", 0),
    ]  # fmt: skip
    assert len({point.folder for point in points}) == len(points)
    assert len({(point.size, point.label) for point in points}) == len(points)


def test_a_point_is_one_evaluation() -> None:
    point = next(p for p in GRID.points() if p.model == "fine15" and p.refine == 5 and p.precision == "bf16")
    assert shlex.split(point.command) == [
        "hood", "evaluate", "models=[fine15+5]", "garments=[tshirt,dress]", "num_frames=40", "gap_states=3", "precision=bf16",
        "refine_method=newton", "sequences=[plie]",
    ]  # fmt: skip
    assert point.label == "fine15 + 5, bf16"
    assert point.series == "fine15 bf16"


def test_the_solver_alone_has_no_precision_and_no_network() -> None:
    alone = [point for point in GRID.points() if point.alone]
    assert all("precision" not in point.command for point in alone)
    assert [point.label for point in alone[:3]] == [
        "solver alone, 2 iterations", "solver alone, 10 iterations", "solver alone, converged",
    ]  # fmt: skip


def test_without_iterations_methods_are_one() -> None:
    both = Grid(("net",), ("fp32",), ("newton", "sweeps"), (GridSize("1k", ("dress",), (0, 5), (2,), 40, 3),), newton=False)
    assert [(p.name, p.refine, p.method) for p in both.points()] == [
        ("net", 0, "newton"), ("net", 5, "newton"), ("net", 5, "sweeps"), ("guess", 2, "newton"), ("guess", 2, "sweeps"),
    ]  # fmt: skip
    assert len({point.label for point in both.points()}) == 5


def test_one_model_is_measured_with_every_number_of_iterations_and_a_size_with_some_precisions() -> None:
    size = GridSize("4k", ("dress_4k",), (0, 5), (2,), 24, 5, refined=("ours", (0, 1, 10)))
    grid = Grid(("runs/ours/model.safetensors", "fine15"), ("fp32", "bf16"), ("newton",), (size,), newton=False)
    found = [(p.name, p.precision, p.refine) for p in grid.points() if not p.alone]
    assert found == [
        ("ours", "fp32", 0), ("ours", "fp32", 1), ("ours", "fp32", 5), ("ours", "fp32", 10), ("ours", "bf16", 0),
        ("ours", "bf16", 5), ("fine15", "fp32", 0), ("fine15", "fp32", 5), ("fine15", "bf16", 0), ("fine15", "bf16", 5),
    ]  # fmt: skip
    half = Grid(("fine15",), ("fp32", "bf16"), ("newton",), (replace(size, precisions=("bf16",)),), newton=False)
    assert [(p.precision, p.refine) for p in half.points() if not p.alone] == [("bf16", 0), ("bf16", 5)]
    with pytest.raises(ValueError, match="precisions_4k: 'tf32' is none of the precisions \\(fp32, bf16\\)"):
        replace(half, sizes=(replace(size, precisions=("tf32",)),)).points()


def test_a_size_without_garments_is_left_out() -> None:
    empty = GridSize("4k", (), (0,), (2,), 40, 3)
    assert Grid(("net",), ("fp32",), ("newton",), (empty,)).points() == []


def test_models_that_cannot_be_told_apart_or_are_not_there_are_refused() -> None:
    with pytest.raises(ValueError, match=r"two of them are called 'a'"):
        Grid(("x/a.safetensors", "runs/a/model.safetensors"), ("fp32",), ("newton",), (SMALL,)).points()
    with pytest.raises(ValueError, match=r"models_12k: 'ours' is none of the models \(fine15\)"):
        Grid(("fine15",), ("fp32",), ("newton",), (LARGE,)).points()


def test_names_that_need_it_are_quoted() -> None:
    assert quoted_word("runs/a-1/m.safetensors+5") == "runs/a-1/m.safetensors+5"
    assert quoted_word("my runs/it's.safetensors") == "'my runs/it\\'s.safetensors'"

"""The compiled solver in parts: the same solver, and the same bits in every run, whoever computes a part."""

from __future__ import annotations

import os
import signal
import threading
import warnings

import numpy as np
import pytest
import torch
from test_engine import CLOSELY, COMPILED, after, dense, model_at
from test_newton import batch, falling, hanging, pieces
from test_plan import states, touching_sheet
from test_points import PLACES, pressed

from hood.energies.potential import default_potential
from hood.solver.compiled import system
from hood.solver.newton import minimize

pytestmark = pytest.mark.usefixtures("compiled_solver")
PARTS = [2, 3, 7]


@pytest.fixture
def share(monkeypatch):
    """Sets the parts that every following step is solved in."""

    def set_parts(parts: int) -> None:
        monkeypatch.setattr(system, "num_parts", lambda count, least: min(parts, count))

    return set_parts


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("parts", PARTS)
def test_the_model_has_the_same_bits_in_any_number_of_parts(share, parts, wide):
    problem = touching_sheet()
    pos = states(problem)["folded"]
    share(1)
    whole = model_at(problem, default_potential(), pos, wide)
    expected = {name: whole.array(name).copy() for name in ("gradient", "inverse", "own")} | {"matrix": dense(whole, "matrix")}
    phi = whole.values.phi
    share(parts)
    shared = model_at(problem, default_potential(), pos, wide)
    assert shared.values.parts == parts
    found = {name: shared.array(name) for name in ("gradient", "inverse", "own")} | {"matrix": dense(shared, "matrix")}
    for name, values in expected.items():
        assert np.array_equal(found[name], values), name
    assert shared.values.phi == pytest.approx(phi, rel=1e-14)


@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("make", [hanging, falling, touching_sheet, lambda: batch(pieces())])
def test_iterations_are_those_of_one_part_and_runs_are_bit_identical(share, parts, make):
    """With linear systems solved closely: what couples two parts, the preconditioner leaves out."""
    problem = make()
    for count in (1, 2, 4):
        share(1)
        there, expected = after(default_potential(), problem, COMPILED, count)
        share(parts)
        here, phi = after(default_potential(), problem, COMPILED, count)
        assert float((here - there).norm()) <= 1e-4 * float((there - problem.state.pos).norm())
        assert phi == pytest.approx(expected, rel=1e-5, abs=1e-9)
        again, repeated = after(default_potential(), problem, COMPILED, count)
        assert torch.equal(again, here)
        assert repeated == phi


@pytest.mark.parametrize("place", PLACES)
def test_contact_at_points_has_the_same_bits_in_any_number_of_parts(share, place):
    potential, problem, pos = pressed(place)
    found = []
    for parts in (1, *PARTS):
        share(parts)
        scene = model_at(problem, potential, pos, wide=False)
        found.append((scene.array("gradient").copy(), dense(scene, "matrix")))
    for gradient, matrix in found[1:]:
        assert np.array_equal(gradient, found[0][0])
        assert np.array_equal(matrix, found[0][1])


@pytest.mark.parametrize("place", PLACES)
def test_ways_along_contact_at_points_are_those_of_one_part(share, place):
    potential, problem, _ = pressed(place)
    share(1)
    expected, phi = after(potential, problem, COMPILED, 3)
    for parts in PARTS:
        share(parts)
        found, shared = after(potential, problem, COMPILED, 3)
        assert float((found - expected).norm()) <= 1e-4 * float((expected - problem.state.pos).norm())
        assert shared == pytest.approx(phi, rel=1e-5, abs=1e-9)


def test_blocks_between_parts_are_those_whose_ends_are_in_two(share):
    """Each twice: for the part of its row, and turned for that of its column."""
    problem = touching_sheet()
    for parts in PARTS:
        share(parts)
        scene = model_at(problem, default_potential(), states(problem)["near"], wide=False)
        pairs, (outer, starts) = scene.tables.pairs, (scene.array(name) for name in ("outer_blocks", "outer_starts"))
        count = len(pairs.starts) - 1
        part = np.searchsorted([count * i // parts for i in range(1, parts)], np.arange(2 * count) // 2, side="right")
        found = set()
        for group in range(2 * parts):
            for own, other, place in outer[starts[group] : starts[group + 1]].tolist():
                row, col = (other, own) if group % 2 == 0 else (own, other)
                block = place // 24
                assert pairs.starts[row // 2] < block < pairs.starts[row // 2 + 1]
                assert place % 24 == 4 * (row % 2)
                assert pairs.cols[block, row % 2] == col
                assert part[own] == group // 2 != part[other]
                found.add((group % 2, row, col))
        rows = np.repeat(np.arange(count), np.diff(pairs.starts))
        both = [(2 * row + half, col) for half in (0, 1) for row, col in zip(rows, pairs.cols[:, half], strict=True)]
        between = {(int(row), int(col)) for row, col in both if pairs.row[row] >= 0 and part[row] != part[col]}
        assert found == {(turned, row, col) for turned in (0, 1) for row, col in between}
        assert len(outer) == starts[-1] == len(found) > 0


def test_the_linear_solver_in_float64_does_not_depend_on_the_parts(share):
    """What columns behind a part are given arrives: a lost block would show in the first digit."""
    problem, found, moved = touching_sheet(), [], []
    for parts in (1, 2, 9):
        share(parts)
        scene = model_at(problem, default_potential(), states(problem)["near"], wide=True)
        assert scene.move(CLOSELY, 10_000)
        moved.append(scene.array("direction").copy())
        scene = model_at(problem, default_potential(), states(problem)["near"], wide=True)
        size = len(scene.tables.vertex)
        force, damping, step = np.ones((size, 3), np.float32), np.ones(size, np.float32), np.zeros((size, 3), np.float32)
        scene.together(force.ctypes.data, damping.ctypes.data, 300, step.ctypes.data)
        found.append(scene.array("direction").copy())
    for direction in found[1:]:
        assert np.abs(direction - found[0]).max() <= 1e-10 * np.abs(found[0]).max()
    for direction in moved[1:]:
        assert np.abs(direction - moved[0]).max() <= 1e-10 * np.abs(moved[0]).max()


def test_two_parts_take_hardly_more_linear_iterations_than_one(share):
    """Blocks where parts meet are larger in the preconditioner, and there alone; otherwise two take 1.4 times as many."""
    problem, count = hanging(40, 40, size=0.4), {}
    pos = problem.state.pos + 2e-3 * torch.as_tensor(np.random.default_rng(0).normal(size=problem.state.pos.shape))
    for name, parts in (("one", 1), ("two", 2), ("two of usual blocks", 2)):
        share(parts)
        scene = model_at(problem, default_potential(), pos, wide=False)
        if name == "two of usual blocks":
            scene.values.num_border = 0
        before = scene.array("inverse").copy(), scene.array("block").copy()
        assert scene.move(1e-3, 1000)
        assert np.array_equal(scene.array("inverse"), before[0])
        assert np.array_equal(scene.array("block"), before[1])
        count[name] = scene.values.cg_used
    assert count["two"] <= 1.2 * count["one"]
    assert count["two of usual blocks"] >= 1.3 * count["one"]


def test_calls_from_several_threads_of_python_do_not_disturb_each_other(share):
    share(3)
    problems = pieces()
    alone = [minimize(default_potential(), problem, settings=COMPILED)[0] for problem in problems]
    found: dict[int, list[torch.Tensor]] = {}

    def work(index: int) -> None:
        found[index] = [minimize(default_potential(), problems[index], settings=COMPILED)[0] for _ in range(5)]

    workers = [threading.Thread(target=work, args=(index,)) for index in range(len(problems))]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for index, expected in enumerate(alone):
        assert all(torch.equal(pos, expected) for pos in found[index])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a system without fork")
def test_a_forked_process_has_threads_of_its_own(share):
    share(3)
    problem = touching_sheet()
    scene = model_at(problem, default_potential(), states(problem)["near"], wide=False)
    expected = scene.model()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the child calls nothing but the library
        child = os.fork()
    if child == 0:
        signal.alarm(60)
        os._exit(0 if scene.model() == expected else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert scene.model() == expected

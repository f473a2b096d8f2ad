"""Iterations of conjugate gradients with different preconditioners, on systems of the solver's own steps.

    python benchmarks/preconditioners.py
    python benchmarks/preconditioners.py dress_4k dress_12k --frames 20

Every sixth step of a rollout (embedded body, default fabric) is solved to the default accuracy, and the matrix and gradient of
each of its Newton iterations are taken from the compiled solver, without the indefinite part. Block-Jacobi goes as far as the
solver's tolerance asks; the others until their error is as small in the norm of the matrix. A line says how many iterations a
method needs of all that block-Jacobi needs:

- ``Gauss-Seidel``: one sweep on and one back over the vertices, in their order in the solver: what the solver does;
- ``+ 30``, ``+ 100``: block-Jacobi and a coarse level added, the six rigid motions of aggregates of so many vertices;
- ``V 30``, ``V 100``: a V-cycle with these motions, smoothed once, and a Gauss-Seidel sweep before and after;
- ``G + 40``: Gauss-Seidel and a coarse level added, the shifts of aggregates of 40 vertices; ``kept``: its matrix is the
  one of the step's second iteration of Newton's method.

An iteration of the sweep takes the solver 1.4 to 1.6 times as long as one of block-Jacobi, whatever the size; with a coarse
level there would be the product with it, and to set it up once an iteration of Newton's method.

``--time`` prints instead what an iteration of the solver's own conjugate gradients takes, and what the matrix does: the least
of seven times.

    python benchmarks/preconditioners.py dress dress_4k dress_12k --time

``--parts`` prints instead how many iterations the solver takes where its rows are in so many parts, each swept by a thread of
its own, as a multiple of those in one part: with usual blocks where parts meet, and with the larger ones that it has.

    python benchmarks/preconditioners.py dress dress_4k dress_12k --parts 2 4
"""

from __future__ import annotations

import argparse
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from engine import make_scene
from scipy import sparse
from scipy.sparse import linalg

from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.rollouts.loop import simulate
from hood.solver.compiled.system import TOLERANCES, CompiledSystem
from hood.solver.newton import NewtonSettings
from hood.solver.system.iterate import in_double
from hood.solver.system.plan import plan_for
from hood.steppers.newton import NewtonStepper

#: Every so many-th step of a rollout is taken apart.
STRIDE = 6
SIZES, ROUNDS, SHIFTED = (30, 100), 6, 40
SETTINGS = NewtonSettings(target_rg=1e-2)

Vector = np.ndarray
Apply = Callable[[Vector], Vector]


@dataclass(frozen=True)
class System:
    """A Newton system: matrix (3N, 3N), right-hand side (3N,), positions (N, 3) [m], to which tolerance it is solved, and which
    of its step it is."""

    matrix: sparse.csr_matrix
    right: Vector
    pos: Vector
    tolerance: float
    number: int


def steps_of(garment: str, motion: str, frames: int) -> list[StepProblem]:
    """Some steps of a rollout, in float64."""
    potential, steps = default_potential(), list[StepProblem]()
    rollout = simulate(
        NewtonStepper(potential, SETTINGS),
        make_scene(garment, motion),
        potential,
        frames,
        metrics="none",
        settle="equilibrium",
        observe=lambda index, problem, prediction: steps.append(problem),
    )
    deque(rollout, maxlen=0)
    return [in_double(problem) for problem in steps[STRIDE - 1 :: STRIDE]]


def systems(garment: str, motion: str, frames: int) -> Iterator[System]:
    """Those of some steps of a rollout."""
    potential = default_potential()
    for work in steps_of(garment, motion, frames):
        system = CompiledSystem(potential, work, plan_for(work), SETTINGS.cg_iterations)
        system.begin(None)
        (scene,), number = system._engines, 0
        while (residual := system.model()[0]) > SETTINGS.target_rg:
            scene.matrix()
            starts, cols, size = scene.tables.row_starts, scene.tables.cols, scene.values.num_rows
            blocks = scene.tables.blocks(scene.array("matrix")).astype(np.float64)
            above = np.repeat(np.arange(size), np.diff(starts)) != cols
            shape = (3 * size, 3 * size)
            upper = sparse.bsr_matrix((blocks, cols.copy(), starts.copy()), shape=shape)
            below = sparse.bsr_matrix((blocks * above[:, None, None], cols.copy(), starts.copy()), shape=shape).T
            right = -scene.array("gradient")[:, :3].reshape(-1)
            pos, tolerance = scene.array("pos")[:size, :3].copy(), float(np.clip(residual**0.5, 1e-3, 0.1))
            yield System((upper + below).tocsr(), right, pos, tolerance, number)
            number += 1
            if not system.move([residual], [True])[0]:
                break


def aggregates(matrix: sparse.csr_matrix, pos: Vector, size: int) -> Vector:
    """(N,) number of the aggregate of every vertex: those nearest to a seed along the mesh, which moves to their middle."""
    graph = sparse.csr_matrix(matrix[::3, ::3])
    seeds = np.random.default_rng(0).choice(len(pos), max(len(pos) // size, 1), replace=False)
    number = np.zeros(len(pos), np.int64)
    for _ in range(ROUNDS):
        number[:] = -1
        number[seeds] = np.arange(len(seeds))
        queue = deque(seeds)
        while queue:
            vertex = queue.popleft()
            for near in graph.indices[graph.indptr[vertex] : graph.indptr[vertex + 1]]:
                if number[near] < 0:
                    number[near] = number[vertex]
                    queue.append(near)
        number[number < 0] = 0  # another piece of cloth, without a seed
        away = ((pos - _means(pos, number)[number]) ** 2).sum(axis=1)
        order = np.lexsort((away, number))
        seeds = order[np.flatnonzero(np.diff(number[order], prepend=-1))]
    return number


def _means(pos: Vector, number: Vector) -> Vector:
    count = np.maximum(np.bincount(number), 1)
    return np.stack([np.bincount(number, axis) / count for axis in pos.T], axis=1)


def rigid(pos: Vector, number: Vector) -> sparse.csr_matrix:
    """(3N, 6A): how vertices move with the three shifts and three turns of their aggregates."""
    away = pos - _means(pos, number)[number]
    x, y, z = away.T / max(float(np.abs(away).mean()), 1e-9)
    zero, one = np.zeros(len(pos)), np.ones(len(pos))
    rows = [[one, zero, zero, zero, z, -y], [zero, one, zero, -z, zero, x], [zero, zero, one, y, -x, zero]]
    blocks = np.stack([np.stack(row, axis=1) for row in rows], axis=1)
    shape = (3 * len(pos), 6 * (int(number.max()) + 1))
    return sparse.bsr_matrix((blocks, number, np.arange(len(pos) + 1)), shape=shape).tocsr()


def coarse(matrix: sparse.csr_matrix, motions: sparse.csr_matrix) -> Apply:
    """The correction by these motions."""
    small = (motions.T @ matrix @ motions).tocsc()
    solve = linalg.splu(small + 1e-12 * abs(small).max() * sparse.eye(small.shape[0], format="csc")).solve
    return lambda r: np.asarray(motions @ solve(motions.T @ r))


def iterations(system: System, apply: Apply, done: Callable[[Vector, float], bool]) -> int:
    """Of conjugate gradients with a preconditioner until ``done(x, r . z)``."""
    x, r, count = np.zeros_like(system.right), system.right.copy(), 0
    z = apply(r)
    p, rz = z.copy(), float(r @ z)
    while not done(x, rz) and count < SETTINGS.cg_iterations:
        q = system.matrix @ p
        length = rz / float(p @ q)
        x, r = x + length * p, r - length * q
        z = apply(r)
        rz, before = float(r @ z), rz
        p, count = z + rz / before * p, count + 1
    return count


def compare(system: System, kept: dict[int, Apply]) -> dict[str, int]:
    """Iterations by method; ``kept`` is the coarse level of the step so far."""
    matrix, size = system.matrix, len(system.pos)
    blocks = matrix.tobsr((3, 3))
    rows = np.repeat(np.arange(size), np.diff(blocks.indptr))

    def part(chosen: Vector) -> sparse.bsr_matrix:
        kept = blocks.data * chosen[:, None, None]
        return sparse.bsr_matrix((kept, blocks.indices, blocks.indptr), shape=matrix.shape)

    diagonal = blocks.data[rows == blocks.indices]
    inverse = sparse.bsr_matrix((np.linalg.inv(diagonal), np.arange(size), np.arange(size + 1)), shape=matrix.shape).tocsr()
    lower = part(rows >= blocks.indices).tocsc()
    on = linalg.splu(lower, permc_spec="NATURAL", diag_pivot_thresh=0, options={"SymmetricMode": True}).solve
    middle = part(rows == blocks.indices).tocsr()
    begun: list[float] = []

    def met(x: Vector, rz: float) -> bool:
        begun.append(rz)
        found[:] = x
        return rz <= system.tolerance**2 * begun[0]

    found, exact = np.empty_like(system.right), linalg.spsolve(matrix.tocsc(), system.right)
    counts = {"block-Jacobi": iterations(system, lambda r: np.asarray(inverse @ r), met)}
    error = float((found - exact) @ (matrix @ (found - exact)))

    def as_near(x: Vector, rz: float) -> bool:
        return float((x - exact) @ (matrix @ (x - exact))) <= error

    def sweeps(r: Vector) -> Vector:
        return np.asarray(on(middle @ on(r), trans="T"))

    counts["Gauss-Seidel"] = iterations(system, sweeps, as_near)
    for count in SIZES:
        motions = rigid(system.pos, aggregates(matrix, system.pos, count))
        add, cycle = coarse(matrix, motions), coarse(matrix, motions - (inverse @ matrix @ motions) / 3.0)
        counts[f"+ {count}"] = iterations(system, lambda r, add=add: inverse @ r + add(r), as_near)

        def v_cycle(r: Vector, cycle: Apply = cycle) -> Vector:
            x = on(r)
            x = x + cycle(r - matrix @ x)
            return np.asarray(x + on(r - matrix @ x, trans="T"))

        counts[f"V {count}"] = iterations(system, v_cycle, as_near)
    number = aggregates(matrix, system.pos, SHIFTED)
    shifts = coarse(matrix, rigid(system.pos, number)[:, np.arange(6 * (number.max() + 1)) % 6 < 3])
    kept[0] = shifts if system.number <= 1 else kept[0]
    counts[f"G + {SHIFTED}"] = iterations(system, lambda r: sweeps(r) + shifts(r), as_near)
    counts["kept"] = iterations(system, lambda r: sweeps(r) + kept[0](r), as_near)
    return counts


def times(garment: str, motion: str, rounds: int = 7, count: int = 100) -> tuple[int, float, float]:
    """Free vertices of a garment, and seconds of an iteration of the solver's conjugate gradients and of its matrix."""
    scene, potential = make_scene(garment, motion), default_potential()
    state = scene.start(0)
    problem = in_double(potential.prepare(StepProblem(scene.cloth, state, scene.step_input(0, state))))
    system = CompiledSystem(potential, problem, plan_for(problem), count)
    system.begin(None)
    engine, right = system.engines[0], np.random.default_rng(0).normal(size=tuple(state.pos.shape))
    found, solves, matrices = np.zeros_like(right), [], []
    for _ in range(rounds):
        engine.model()
        began = time.perf_counter()
        engine.matrix()
        matrices.append(time.perf_counter() - began)
        began, used = time.perf_counter(), engine.values.cg_used
        engine.solve(right, 1e-30, count, found)
        solves.append((time.perf_counter() - began) / (engine.values.cg_used - used))
    return engine.values.num_rows, min(solves), min(matrices)


def in_parts(garment: str, motion: str, frames: int, parts: list[int]) -> dict[str, int]:
    """Iterations in one part and in others, of all systems of some steps of a rollout."""
    potential, used = default_potential(), dict[str, int]()
    for work in steps_of(garment, motion, frames):
        system = CompiledSystem(potential, work, plan_for(work), SETTINGS.cg_iterations)
        system.begin(None)
        engine, right, found = system.engines[0], np.zeros(tuple(work.state.pos.shape)), np.zeros(tuple(work.state.pos.shape))
        while (residual := system.model()[0]) > SETTINGS.target_rg:
            right[engine.array("vertex")[: engine.values.num_rows]] = -engine.array("gradient")[:, :3]
            for count, usual in [(1, False), *((count, usual) for count in parts for usual in (True, False))]:
                engine.share(count)
                engine.model()
                engine.matrix()
                border, before = engine.values.num_border, engine.values.cg_used
                engine.values.num_border *= not usual
                engine.solve(right, float(np.clip(residual**0.5, *TOLERANCES)), SETTINGS.cg_iterations, found)
                engine.values.num_border = border
                name = f"{count}, usual" if usual else f"{count}"
                used[name] = used.get(name, 0) + engine.values.cg_used - before
            engine.share(1)
            if not (system.model() and system.move([residual], [True])[0]):
                break
    return used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garments", nargs="*", default=["dress", "dress_4k"])
    parser.add_argument("--motion", default="dance_mixed")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--time", action="store_true", help="what an iteration takes")
    parser.add_argument("--parts", type=int, nargs="+", help="iterations in so many parts")
    arguments = parser.parse_args()
    if arguments.parts:
        for garment in arguments.garments:
            used = in_parts(garment, arguments.motion, arguments.frames, arguments.parts)
            print(f"{garment:10}" + "".join(f"{name:>12} {count / used['1']:.2f}×" for name, count in used.items()), flush=True)
        return
    if arguments.time:
        print(f"{'garment':10}{'free vertices':>15}{'iteration [µs]':>16}{'matrix [ms]':>13}")
        for garment in arguments.garments:
            size, iteration, matrix = times(garment, arguments.motion)
            print(f"{garment:10}{size:15}{1e6 * iteration:16.1f}{1e3 * matrix:13.2f}", flush=True)
        return
    for index, garment in enumerate(arguments.garments):
        kept: dict[int, Apply] = {}
        found = [compare(system, kept) for system in systems(garment, arguments.motion, arguments.frames)]
        totals = {name: sum(counts[name] for counts in found) for name in found[0]}
        if index == 0:
            print(f"{'garment':10}{'systems':>8}" + "".join(f"{name:>14}" for name in totals))
        most = totals["block-Jacobi"]
        shown = [f"{most / len(found):.1f}", *(f"{total / most:.2f}×" for total in list(totals.values())[1:])]
        print(f"{garment:10}{len(found):8}" + "".join(f"{value:>14}" for value in shown), flush=True)


if __name__ == "__main__":
    main()

"""How far steps down the potential come without a network: single vertices, all of them together.

    python benchmarks/waves.py                                   # dress, T-shirt and skirt at 1k
    python benchmarks/waves.py --garments dress_4k skirt_4k

γ after some iterations from the base of ``output=local_steps``, on states of the solver, median and worst. Directions: every
vertex alone (local steps); all together, coupled by springs of one stiffness along the edges (a Sobolev gradient, as of
projective dynamics), with what contact adds to the diagonal or without; all together by the potential's positive matrix
(:mod:`hood.solver.vertex.block_jacobi`). Each is taken as far as the potential falls along it, or whole, and then out of the
body; the solver's own iterations beside them, with their line search around the body.
Before that the CPU time of every direction.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial

import torch
from heads import POTENTIAL, Case, cases, make_scene
from torch import Tensor

from hood.energies.problem import StepProblem
from hood.model.readout.edges import EdgeSystem, fit_edges
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.vertex.block_jacobi import LocalTerms
from hood.solver.vertex.compiled import local_terms
from hood.steppers.newton import NewtonStepper

ITERATIONS = (1, 2, 4, 8)
STIFFNESSES = (10.0, 40.0)  # N/m
Direction = Callable[[Tensor], Tensor]


class State:
    """A step in float64, and the directions in which it can go from positions."""

    def __init__(self, case: Case) -> None:
        self.case, self.terms = case, LocalTerms(POTENTIAL, case.problem)
        self.free, self.inertia = case.held.free, case.problem.cloth.mass / case.problem.vertex_dt.squeeze(1) ** 2

    def alone(self, pos: Tensor) -> Tensor:
        return self.terms(pos).step

    def springs(self, pos: Tensor, stiffness: float, contact: bool) -> Tensor:
        own = self.terms.terms.vertices.model(pos, self.case.problem.acceleration(pos)).matrix
        weight = own.diagonal(dim1=1, dim2=2).mean(dim=1) if contact else self.inertia
        return _springs(self.case, self.case.problem, self.terms(pos).force, weight, stiffness)

    def together(self, pos: Tensor) -> Tensor:
        return self.terms.solve(pos, self.terms(pos).force, torch.zeros_like(self.inertia))

    def searched(self, direction: Direction) -> Iterator[Tensor]:
        """Positions after every iteration that goes as far as the potential falls."""
        pos = self.case.base
        while True:
            step = direction(pos)
            pos = pos + self._length(pos, step) * step
            yield pos

    def whole(self, direction: Direction) -> Iterator[Tensor]:
        """The same with whole steps, then out of the body."""
        pos = self.case.base
        while True:
            there = self.case.head.outside(self.case.problem, pos + direction(pos))
            pos = torch.where(self.free.unsqueeze(1), there, self.case.held.fixed)
            yield pos

    def solver(self) -> Iterator[Tensor]:
        count = 0
        while True:
            count += 1
            yield minimize(POTENTIAL, self.case.problem, self.case.base, NewtonSettings(max_iterations=count))[0]

    def _length(self, pos: Tensor, step: Tensor) -> float:
        """Where the slope of the potential along the step vanishes, to a thousandth of it."""

        def falls(length: float) -> bool:
            return float((self.terms(pos + length * step).force * step).sum()) > 0

        low, high = 0.0, 1.0
        while falls(high) and high < 64.0:
            low, high = high, 2.0 * high
        while high - low > 1e-3 * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if falls(middle) else (low, middle)
        return low


def _springs(case: Case, problem: StepProblem, force: Tensor, weight: Tensor, stiffness: float) -> Tensor:
    """u with (diag(weight) + k L) u = force: the solve of ``output=edges`` from rest, whose anchors ask for the force."""
    cloth, rest = problem.cloth, torch.zeros_like(force)
    system = EdgeSystem(case.edges, cloth.free, cloth.vertex_scene, cloth.scene_sizes, stiffness)
    return fit_edges(system, rest, system.vectors(rest), force / weight.unsqueeze(1), weight)


def ways(state: State) -> dict[str, Iterator[Tensor]]:
    found = {"single vertices": state.searched(state.alone)}
    for stiffness in STIFFNESSES:
        step = partial(state.springs, stiffness=stiffness, contact=True)
        found[f"springs of {stiffness:g} N/m"] = state.searched(step)
    loose = partial(state.springs, stiffness=STIFFNESSES[0], contact=False)
    found[f"springs of {STIFFNESSES[0]:g} N/m, no contact"] = state.searched(loose)
    found["positive matrix"] = state.searched(state.together)
    found["positive matrix, whole steps"] = state.whole(state.together)
    found["the solver's iterations"] = state.solver()
    return found


def times(case: Case, problem: StepProblem) -> dict[str, float]:
    """CPU ms of a direction, compiled, in float32, with the forces that it needs."""
    pos, cloth = case.base.float(), problem.cloth
    terms = local_terms(POTENTIAL, problem)
    weight = cloth.mass / problem.vertex_dt.squeeze(1) ** 2
    none = torch.zeros_like(weight)
    calls: dict[str, Callable[[], object]] = {
        "single vertices": lambda: terms(pos),
        "springs": lambda: _springs(case, problem, terms(pos).force, weight, STIFFNESSES[0]),
        "positive matrix": lambda: terms.solve(pos, terms(pos).force, none),
    }
    least = dict.fromkeys(calls, float("inf"))
    for _ in range(10):  # in turns
        for name, call in calls.items():
            begin = time.process_time()
            call()
            least[name] = min(least[name], 1e3 * (time.process_time() - begin))
    return least


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garments", nargs="+", default=["dress", "tshirt", "skirt"])
    parser.add_argument("--states", type=int, default=2, help="of every rollout")
    parser.add_argument("--frames", type=int, default=24)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, list[list[float]]] = {}
    for garment in arguments.garments:
        found = cases(NewtonStepper(POTENTIAL), make_scene(garment), arguments.states, arguments.frames)
        for case, _, _ in found:
            rows.setdefault("base", []).append([case.gamma(case.base)] * len(ITERATIONS))
            for name, positions in ways(State(case)).items():
                reached = [pos for _, pos in zip(range(max(ITERATIONS)), positions, strict=False)]
                rows.setdefault(name, []).append([case.gamma(reached[count - 1]) for count in ITERATIONS])
        spent = times(*found[-1][:2])
        print(f"{garment}: CPU ms", ", ".join(f"{name} {value:.2f}" for name, value in spent.items()), flush=True)
    print(f"γ after {', '.join(map(str, ITERATIONS))} iterations, median (worst) over {len(rows['base'])} states")
    for name, values in rows.items():
        columns = zip(*values, strict=True)
        print(f"{name:36}", "  ".join(f"{statistics.median(c):7.4f} ({max(c):.2g})" for c in columns))


if __name__ == "__main__":
    main()

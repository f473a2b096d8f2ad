"""What becomes of the motion as time steps and meshes get finer, and of every method at other time steps and resolutions.

    python benchmarks/convergence.py strip           # a hanging strip, dt → 0: errors and order
    python benchmarks/convergence.py bending         # a cantilever of cloth, h → 0, on meshes of two kinds, beside the elastica
    python benchmarks/convergence.py garment         # a dress at 15 to 240 fps and 300 to 48k vertices, method by method
    python benchmarks/convergence.py garment --fps 30 60 --sizes 1k --methods newton quickstart
    python benchmarks/convergence.py garment --fps 15 30 60 --sizes 48k --methods newton edges

- ``strip``: 30 cm long, held at one end. It hangs at rest and is let go 0.4 rad from there, or it is let go level and
  unstretched, which sends waves of stretch through it. The error is the root mean square distance to the limit of the first
  order, twice the strip in steps of 1/15360 s less that in steps of 1/7680 s.
- ``bending``: 4 cm long, held level at one end, at rest under its weight: how far its tip hangs down. The elastica is a rod of
  a quarter of the bending stiffness, which is what the hinges of a regular mesh amount to.
- ``garment``: a dress in walk_proud for half a second. The distance is the root mean square over its vertices, at the last
  frame, to the solver's rollout of the same mesh at 960 fps (480 at 12k, 240 at 48k). γ is that of four steps (two at 48k),
  each against the minimum of its own potential. All begin at one rest.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from resolution import SIZES, garment_of
from scipy.integrate import solve_bvp
from torch import Tensor

import hood
from hood.assets.material import Material, values_of
from hood.cloth.cloth import build_cloth
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.evaluation.gap import gap
from hood.mesh.editing.remeshing import isotropic
from hood.rollouts.loop import simulate
from hood.solver.newton import NewtonSettings
from hood.steppers.network import Prediction
from hood.steppers.newton import implicit_euler
from hood.testing import Mesh, grid, make_problem

G = 9.81
TIGHT = NewtonSettings(target_rg=1e-7)
#: A step so long [s] that what is left of inertia is nothing: its end is the equilibrium.
STATIC = 100.0
#: Rates [1/s] of the rollouts that others are held against, where they are not 960.
FINEST = {"12k": 480, "48k": 240}
METHODS: dict[str, dict[str, Any]] = {
    "newton": {"stepper": "newton"},
    "quickstart": {"checkpoint": "quickstart", "refine": 0},
    "quickstart+5": {"checkpoint": "quickstart", "refine": 5},
    "edges": {"checkpoint": "edges", "refine": 0},
}


def problem_of(mesh: Mesh, held: float, dt: float) -> StepProblem:
    """A step of cloth of ``mesh`` that is held up to the length ``held`` [m]."""
    pos, faces = mesh
    cloth = build_cloth(pos, faces, Material(), pinned=pos[:, 0] < held + 1e-9, dtype=torch.float64)
    return replace(make_problem(cloth, dt=dt), gravity=torch.tensor([0.0, -G, 0.0], dtype=torch.float64))


def ribbon(rows: int, columns: int, length: float) -> Mesh:
    """``rows`` × ``columns`` vertices, square meshes, ``length`` [m] long along x."""
    pos, faces = grid(rows, columns, 1.0)
    return pos * np.array([length, 1.0, length * (columns - 1) / (rows - 1)]), faces


def inclined(angle: float) -> Tensor:
    """Gravity (3,) [m/s²] at ``angle`` [rad] to the strip."""
    return torch.tensor([G * math.cos(angle), -G * math.sin(angle), 0.0], dtype=torch.float64)


def swung(dt: float, seconds: float, angle: float, start: Tensor) -> Tensor:
    """Positions (V, 3) [m] of the strip from ``start`` after ``seconds`` in steps of ``dt`` [s]."""
    problem = problem_of(ribbon(13, 4, 0.3), 0.0, dt)
    problem = replace(problem, gravity=inclined(angle), state=replace(problem.state, pos=start))
    *_, last = implicit_euler(default_potential(), problem, round(seconds / dt), TIGHT)
    return last.state.pos


def errors_of(angle: float, start: Tensor) -> None:
    """Table of the errors of the strip from ``start`` (V, 3) [m], by rate and time, with the order between neighbours."""
    rates = (15, 30, 60, 120, 240, 480, 960, 1920, 3840)
    print(f"{'after':10}" + "".join(f"{f'{rate} fps':>16}" for rate in rates))
    for seconds in (0.1, 0.2, 0.4):
        exact = 2 * swung(1 / 15360, seconds, angle, start) - swung(1 / 7680, seconds, angle, start)
        used = [rate for rate in rates if math.isclose(seconds * rate, round(seconds * rate), abs_tol=1e-9)]
        apart = {rate: swung(1 / rate, seconds, angle, start) - exact for rate in used}
        errors = {rate: float(delta.square().sum(dim=1).mean().sqrt()) for rate, delta in apart.items()}
        cells = []
        for before, rate in zip((None, *rates), rates, strict=False):
            order = f" ({math.log2(errors[before] / errors[rate]):.2f})" if before in errors and rate in errors else ""
            cells.append(f"{1e3 * errors[rate]:.2f}{order}" if rate in errors else "–")
        print(f"{seconds:g} s".ljust(10) + "".join(cell.rjust(16) for cell in cells), flush=True)


def strip() -> None:
    problem = replace(problem_of(ribbon(13, 4, 0.3), 0.0, STATIC), gravity=inclined(0.0))
    *_, at_rest = implicit_euler(default_potential(), problem, 3, TIGHT)
    print("error [mm] of the strip that hangs at rest and is let go 0.4 rad from there, and order between neighbours")
    errors_of(0.4, at_rest.state.pos)
    print("error [mm] of the strip that is let go level and unstretched")
    errors_of(math.pi / 2, problem.state.pos)


def drop(mesh: Mesh, held: float) -> float:
    """How far [m] the free end of a cantilever hangs down at rest."""
    potential, problem = default_potential(), problem_of(mesh, held, 1 / 30)
    *_, settled = implicit_euler(potential, problem, 60, TIGHT)  # near the equilibrium, where one long step finds it
    step = replace(problem.step, dt=torch.full_like(problem.step.dt, STATIC))
    state = replace(settled.state, vel=torch.zeros_like(settled.state.vel))
    (last,) = implicit_euler(potential, replace(problem, state=state, step=step), 1, TIGHT)
    end = problem.cloth.rest_pos[:, 0] > problem.cloth.rest_pos[:, 0].max() - 1e-9
    return -float(last.state.pos[end, 1].mean())


def elastica(length: float) -> float:
    """The same of a rod without thickness: B θ'' = w (l − s) cos θ, θ(0) = 0, θ'(l) = 0."""
    material = Material()
    stiffness, density = (float(values_of(value)[0]) for value in (material.bending_stiffness, material.density))
    rigidity, weight = 0.25 * stiffness, density * G

    def slope(s: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([y[1], weight * (length - s) * np.cos(y[0]) / rigidity])

    s = np.linspace(0.0, length, 2001)
    start = np.stack([-1.2 * (1 - np.exp(-5 * s / length)), np.zeros_like(s)])
    found = solve_bvp(slope, lambda a, b: np.array([a[0], b[1]]), s, start, max_nodes=200_000, tol=1e-8)
    return -float(np.trapezoid(np.sin(found.sol(s)[0]), s))


def bending() -> None:
    length = 0.04
    print(f"drop of the tip [mm]; elastica {1e3 * elastica(length):.2f}")
    print(f"{'edge mm':>8}{'regular':>12}{'isotropic':>12}")
    for rows in (5, 9, 17, 33):
        edge = length / (rows - 1)
        pos, faces = ribbon(rows + 1, rows, length + edge)
        others = isotropic(pos, faces, round(1.15 * len(pos)))
        regular, irregular = (drop((mesh[0] - [edge, 0, 0], mesh[1]), 0.0) for mesh in ((pos, faces), others))
        print(f"{1e3 * edge:8.2f}{1e3 * regular:12.2f}{1e3 * irregular:12.2f}", flush=True)


@dataclass(frozen=True)
class Run:
    """What a rollout came to: last positions (V, 3) [m], medians of strain p99 and of a frame's ms, γ of some steps."""

    pos: Tensor
    strain: float
    ms: float
    gamma: list[float]


def run_garment(mesh: str, fps: int, seconds: float, judged: int, **keys: Any) -> Run:
    """A rollout, and γ of ``judged`` of its steps."""
    count = round(seconds * fps) + 1
    rollout = hood.simulate(
        mesh, "walk_proud", fps=fps, num_frames=count, metrics="strain", cloth_contact="off", guard="off", **keys
    )
    steps: dict[int, tuple[StepProblem, Tensor]] = {}
    kept = {round(frame) for frame in np.linspace(count / 4, count - 1, judged)} if judged else set()

    def observe(frame: int, problem: StepProblem, prediction: Prediction) -> None:
        if frame in kept:
            steps[frame] = problem, prediction.next_pos

    frames = list(
        simulate(
            rollout.stepper, rollout.scene, rollout.potential, count, observe=observe, metrics="strain", settle="equilibrium"
        )
    )
    strain = float(np.median([frame.metrics["strain_p99"] for frame in frames[1:]]))
    ms = float(np.median([frame.metrics["ms_total"] for frame in frames[1:]]))
    gamma = [float(gap(rollout.potential, problem, pos).gamma) for problem, pos in steps.values()]
    return Run(frames[-1].world_pos, strain, ms, gamma)


def garment(sizes: list[str], rates: list[int], methods: list[str], folder: Path) -> None:
    seconds, folder = 0.5, folder / "garments"
    folder.mkdir(parents=True, exist_ok=True)
    columns = f"{'distance mm':>13}{'strain p99':>12}{'γ median':>10}{'most':>9}{'ms':>8}{'ms per s':>10}"
    print(f"{'mesh':6}{'fps':>5}  {'method':14}{columns}")
    for size in sizes:
        mesh, finest, judged = garment_of(size, folder), FINEST.get(size, 960), 2 if size == "48k" else 4
        exact = run_garment(mesh, finest, seconds, 0, **METHODS["newton"]).pos
        for fps in rates:
            for method in methods:
                run = run_garment(mesh, fps, seconds, judged, **METHODS[method])
                apart = 1e3 * float((run.pos - exact).square().sum(dim=1).mean().sqrt())
                gammas = f"{np.median(run.gamma):10.2g}{max(run.gamma):9.2g}"
                row = f"{size:6}{fps:5d}  {method:14}{apart:13.1f}{100 * run.strain:11.1f}%{gammas}"
                print(f"{row}{run.ms:8.0f}{run.ms * fps:10.0f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("strip", "bending", "garment"))
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=["300", "1k", "4k", "12k"])
    parser.add_argument("--fps", nargs="+", type=int, default=[15, 30, 60, 120, 240])
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--output", type=Path, default=Path("outputs/convergence"), help="folder of the meshes that are made")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.part == "garment":
        garment(arguments.sizes, arguments.fps, arguments.methods, arguments.output)
    else:
        {"strip": strip, "bending": bending}[arguments.part]()


if __name__ == "__main__":
    main()

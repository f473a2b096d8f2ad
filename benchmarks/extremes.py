"""How far the solver gets away from ordinary fabrics and time steps: a sheet in contact with a sphere.

    python benchmarks/extremes.py --side 33 --frames 10

Prints, per membrane stiffness, density and time step: the share of converged steps, the largest edge strain and vertex
speed of all frames, the largest energy relative to the start (exact steps never raise it: the body is at rest), the
median of the iterations and of the time. The sheet starts 1 mm above the pole, inside the contact zone.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, State
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings
from hood.solver.step_figures import strain_metrics
from hood.steppers.newton import implicit_euler
from hood.testing import grid, make_problem, sphere

STIFFNESS, DENSITY, STEPS = (1.0, 10.0, 100.0), (1.0, 0.1), (1 / 240, 1 / 30, 1 / 5)


@dataclass(frozen=True)
class Line:
    """One setting."""

    converged: float  # share of the steps
    strain: float
    speed: float  # m/s
    energy: float  # J, largest rise over the start
    iterations: float
    milliseconds: float


def drop(side: int, material: Material, dt: float, size: float = 1.0, radius: float = 0.3) -> StepProblem:
    """A level sheet of ``side``² vertices over a sphere, at rest."""
    pos, faces = grid(side, side, size)
    cloth = build_cloth(pos + [-size / 2, radius + 1e-3, -size / 2], faces, material, dtype=torch.float64)
    problem = make_problem(cloth, dt=dt)
    body, body_faces = (torch.as_tensor(array) for array in sphere(3, radius))
    scene = torch.zeros(len(body), dtype=torch.int64), torch.zeros(len(body_faces), dtype=torch.int64)
    return replace(problem, step=replace(problem.step, obstacle=Obstacle(body, body, body, body_faces, *scene)))


def mechanical_energy(problem: StepProblem, state: State) -> float:
    """Kinetic, gravitational and elastic energy [J]."""
    terms = default_potential().terms
    stored = Potential({name: terms[name] for name in ("stretching", "bending", "gravity")})
    kinetic = 0.5 * (problem.cloth.mass * state.vel.square().sum(1)).sum()
    return float(kinetic + stored.total(problem, state.pos, torch.zeros_like(state.pos)).sum())


def measure(problem: StepProblem, frames: int, settings: NewtonSettings) -> Line:
    rows = []
    start = mechanical_energy(problem, problem.state)
    for step in implicit_euler(default_potential(), problem, frames, settings):
        rows.append(
            (
                float(step.report.converged.all()),
                strain_metrics(problem.cloth, step.state.pos)["strain_max"],
                float(step.state.vel.norm(dim=1).max()),
                mechanical_energy(problem, step.state) - start,
                step.report.iterations,
                1e3 * step.report.history[-1].seconds,
            )
        )
    table = np.array(rows)
    best = table.max(axis=0)
    return Line(table[:, 0].mean(), best[1], best[2], best[3], *np.median(table[:, 4:], axis=0))


def lines(side: int, frames: int, settings: NewtonSettings) -> Iterator[str]:
    base = Material()
    for stiffness, density, dt in product(STIFFNESS, DENSITY, STEPS):
        material = replace(
            base,
            lame_mu=stiffness * base.lame_mu,
            lame_lambda=stiffness * base.lame_lambda,
            density=density * base.density,
        )
        line = measure(drop(side, material, dt), frames, settings)
        yield (
            f"| × {stiffness:g} | × {density:g} | 1/{1 / dt:.0f} | {100 * line.converged:.0f}% | {line.strain:.4f} "
            f"| {line.speed:.2f} | {line.energy:+.1e} | {line.iterations:.0f} | {line.milliseconds:.0f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=33, help="vertices along a side of the sheet")
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--linear", default="cg", choices=["cg", "direct"])
    parser.add_argument("--max-iterations", type=int, default=100)
    parser.add_argument("--target-rg", type=float, default=1e-3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    settings = NewtonSettings(args.target_rg, args.max_iterations, linear=args.linear)
    print(f"{args.side**2:,} vertices, {args.frames} frames, {args.linear}, relative gradient {args.target_rg:g}, float64")
    print("| stiffness | density | dt [s] | converged | max strain | max speed [m/s] | energy [J] | iterations | ms |")
    print("|---" * 9 + "|")
    for line in lines(args.side, args.frames, settings):
        print(line, flush=True)


if __name__ == "__main__":
    main()

"""Time of one implicit step of the solver: a sheet falls onto a sphere and drapes over it.

    OMP_NUM_THREADS=1 python benchmarks/solver.py --sides 33 64 --frames 120 --linear cg
    OMP_NUM_THREADS=1 python benchmarks/solver.py --sides 33 --frames 40 --stiffness 100 --density 0.1

Every frame is solved from the solver's own start; the clock is read before each iteration. The gap γ = (Φ - Φ*) / e0 is
against the lowest of three minima: from that start, from free flight without contact, and from the previous positions, the
last two to a relative gradient of 1e-3. Prints, per size and linear solver, median and 95th percentile over the frames of
the time [ms] and the iterations to γ <= 0.1 and 1e-2 and to a relative gradient of 1e-2 and 1e-4. Frames that miss a target
are counted and left out of its figures: γ is missed where another start has found a lower minimum. A second line says how
the run went: frames not converged, frames whose starts disagree, steps of rising potential, largest speed and stretch.

OpenBLAS has threads of its own: without OMP_NUM_THREADS=1 the direct solver takes ten times as long on a busy machine.

Why no levels. Those of :mod:`hood.model.graph.hierarchy` were tried as a second preconditioner: interpolation from kept
vertices to their dropped neighbours, Galerkin matrices, the coarsest factorised, added to block-Jacobi or in a V-cycle with
one damped block-Jacobi step before and after. On Newton systems of this drape, mean over 4 to 14 systems, one thread of an
AMD server CPU, to a tenth of the residual, iterations and ms without the set-up (which took 16, 99 and 1,028 ms):

    vertices        1,089          4,096          16,384
    block-Jacobi    18, 1.7        60, 15.5       93, 97
    added           11, 4.8        27, 77         28, 425
    V-cycle         5.3, 3.1       13, 45         14, 256

Breadth-first parity keeps every second ring, so the coarse matrix is as large as a quarter of the fine one and denser;
that costs more than the iterations it saves, at every size and also to a thousandth of the residual. For aggregates with
rigid motions see ``benchmarks/preconditioners.py``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from hood.app.candidates import device_name
from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, State, StepInput
from hood.contact.contact import find_contact
from hood.energies.potential import default_potential, scale
from hood.energies.problem import StepProblem, inertial_guess
from hood.evaluation.gap import AGREEMENT
from hood.solver.newton import NewtonSettings, Report, minimize
from hood.solver.system.iterate import Progress
from hood.solver.system.plan import plan_for
from hood.solver.vertex.gauss_seidel import sweep
from hood.tensors.batch import to_device
from hood.testing import grid, sphere

TARGETS: dict[str, Callable[[float, float], bool]] = {
    "gap 1e-1": lambda gap, rg: gap <= 0.1,
    "gap 1e-2": lambda gap, rg: gap <= 1e-2,
    "rg 1e-2": lambda gap, rg: rg <= 1e-2,
    "rg 1e-4": lambda gap, rg: rg <= 1e-4,
}


@dataclass(frozen=True)
class Setting:
    """What the sheet is made of and how it is stepped, as factors of the defaults."""

    stiffness: float = 1.0  # of stretching and bending
    density: float = 1.0
    dt: float = 1.0 / 30.0  # s

    @property
    def material(self) -> Material:
        base, factor = Material(), self.stiffness
        return replace(
            base,
            lame_mu=factor * base.lame_mu,
            lame_lambda=factor * base.lame_lambda,
            bending_stiffness=factor * base.bending_stiffness,
            density=self.density * base.density,
        )


@dataclass
class Course:
    """How a run went."""

    rows: list[dict[str, tuple[float, int] | None]] = field(default_factory=list)  # time [ms] and iterations by target
    unconverged: int = 0
    disagree: int = 0
    rises: int = 0
    speed: float = 0.0  # m/s
    stretch: float = 0.0  # largest edge length over its rest length, minus 1


def drop(side: int, size: float, radius: float, device: str, setting: Setting) -> tuple[State, Obstacle, StepProblem]:
    """A level sheet of ``side``² vertices 1 cm above a sphere, at rest."""
    pos, faces = grid(side, side, size)
    cloth = build_cloth(pos + [-size / 2, radius + 0.01, -size / 2], faces, setting.material, dtype=torch.float64)
    body, body_faces = (torch.as_tensor(array) for array in sphere(3, radius))
    index = torch.zeros(len(body), dtype=torch.int64), torch.zeros(len(body_faces), dtype=torch.int64)
    obstacle = to_device(Obstacle(body, body, body, body_faces, *index), device)
    cloth = to_device(cloth, device)
    state = State(cloth.rest_pos, torch.zeros_like(cloth.rest_pos), torch.zeros(1, 3, dtype=torch.float64))
    step = StepInput(dt=torch.tensor([setting.dt], dtype=torch.float64, device=device), obstacle=obstacle)
    return state, obstacle, StepProblem(cloth, state, step)


def solve_frames(side: int, frames: int, settings: NewtonSettings, device: str, setting: Setting) -> Course:
    """Every frame solved to the end of ``settings``."""
    potential, course = default_potential(), Course()
    state, obstacle, template = drop(side, 1.0, 0.3, device, setting)
    minimize(potential, template, settings=replace(settings, max_iterations=1))  # plan and first-call costs
    for _ in tqdm(range(frames), f"{side * side:,} vertices, {settings.linear}", leave=False, disable=None):
        contact = find_contact(state.pos, template.cloth.vertex_scene, obstacle)
        problem = replace(template, state=state, contact=contact)
        pos, report = minimize(potential, problem, settings=settings)
        starts = (inertial_guess(state, problem.step), state.pos)
        others = [minimize(potential, problem, start, replace(settings, target_rg=1e-3))[1] for start in starts]
        minima = [float(found.phi) for found in (report, *others)]
        unit = float(scale(problem))
        course.rows.append({name: _reached(report, min(minima), unit, test) for name, test in TARGETS.items()})
        state = State(pos, state.vel + setting.dt * report.acc, state.origin)
        course.unconverged += not bool(report.converged)
        course.disagree += max(minima) - min(minima) > AGREEMENT * unit
        course.rises += _rises(report)
        course.speed = max(course.speed, float(state.vel.norm(dim=1).max()))
        course.stretch = max(course.stretch, _stretch(problem, pos))
    return course


def _rises(report: Report) -> int:
    phi = [float(progress.phi) for progress in report.history]
    return sum(after > before + 1e-12 * abs(before) for before, after in pairwise(phi))


def _stretch(problem: StepProblem, pos: Tensor) -> float:
    first, last = problem.cloth.edges.unbind(dim=1)
    rest = problem.cloth.rest_pos
    return float(((pos[first] - pos[last]).norm(dim=1) / (rest[first] - rest[last]).norm(dim=1)).max()) - 1.0


def _reached(report: Report, best: float, unit: float, test: Callable[[float, float], bool]) -> tuple[float, int] | None:
    def values(progress: Progress) -> tuple[float, float]:
        return (float(progress.phi) - best) / unit, float(progress.relative_gradient)

    for iteration, progress in enumerate(report.history):
        if test(*values(progress)):
            return 1e3 * progress.seconds, iteration
    return None


def describe(course: Course, label: str) -> str:
    """One line of the table, and how the run went."""
    rows, cells = course.rows, []
    for name in TARGETS:
        reached = np.array([row[name] for row in rows if row[name] is not None], dtype=np.float64).reshape(-1, 2)
        missed = f", {len(rows) - len(reached)} missed" if len(reached) < len(rows) else ""
        if not len(reached):
            cells.append("missed")
            continue
        (ms, its), (ms95, its95) = np.median(reached, axis=0), np.percentile(reached, 95, axis=0)
        cells.append(f"{ms:.0f} / {ms95:.0f} ms ({its:.0f} / {its95:.0f} its{missed})")
    return (
        f"| {label} | " + " | ".join(cells) + " |\n"
        f"  {len(rows)} frames: {course.unconverged} not converged, {course.disagree} whose starts disagree, "
        f"{course.rises} rises of the potential; at most {course.speed:.2f} m/s, {100 * course.stretch:.1f}% stretch"
    )


def time_sweep(side: int, device: str, setting: Setting) -> float:
    """Milliseconds of one local sweep of the sheet on the sphere."""
    state, obstacle, template = drop(side, 1.0, 0.3, device, setting)
    problem = replace(template, contact=find_contact(state.pos, template.cloth.vertex_scene, obstacle))
    start = state.pos + 1e-4 * torch.sin(50 * state.pos.flip(1))
    plan_for(problem)
    times = []
    for count in (1, 6):
        began = time.perf_counter()
        _, report = sweep(default_potential(), problem, start, count)
        times.append((time.perf_counter() - began) / max(int(report.kept), 1) * int(report.kept))
    return 1e3 * (times[1] - times[0]) / 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sides", type=int, nargs="+", default=[33, 64], help="vertices along a side of the sheet")
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--linear", nargs="+", default=["cg"], choices=["cg", "direct"])
    parser.add_argument("--cg-iterations", type=int, default=100)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--stiffness", type=float, default=1.0, help="factor of the stretching and bending stiffness")
    parser.add_argument("--density", type=float, default=1.0, help="factor of the density")
    parser.add_argument("--dt", type=float, default=1.0 / 30.0, help="time step [s]")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    setting = Setting(args.stiffness, args.density, args.dt)
    print(
        f"{device_name(args.device)}, {torch.get_num_threads()} thread(s); "
        f"sheet 1 m × 1 m on a sphere of radius 0.3 m, stiffness × {args.stiffness:g}, "
        f"density × {args.density:g}, dt = {1e3 * args.dt:.3g} ms, {args.frames} frames, float64"
    )
    print("| one implicit step, median / p95 | " + " | ".join(TARGETS) + " |\n" + "|---" * (len(TARGETS) + 1) + "|")
    for side in args.sides:
        for linear in args.linear:
            settings = NewtonSettings(1e-4, 200, linear=linear, cg_iterations=args.cg_iterations)
            course = solve_frames(side, args.frames, settings, args.device, setting)
            print(describe(course, f"Newton, {linear}, {side * side:,} vertices"), flush=True)
        print(f"one local sweep, {side * side:,} vertices: {time_sweep(side, args.device, setting):.1f} ms", flush=True)


if __name__ == "__main__":
    main()

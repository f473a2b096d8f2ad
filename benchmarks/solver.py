"""Time of one implicit step of the solver: a sheet falls onto a sphere and drapes over it.

    python benchmarks/solver.py --sides 33 64 --frames 20 --linear cg direct

Every frame is solved from the projected guess; the clock is read before each iteration. The gap γ = (Φ - Φ*) / e0 is
against the lowest of three minima: from that start, from free flight without contact, and from the previous positions.
Prints, per size and linear solver, median and 95th percentile over the frames of the time [ms] and the iterations to
γ <= 0.1 and 1e-2 and to a relative gradient of 1e-2 and 1e-4; frames that miss a target are counted.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from hood.assets.material import Material
from hood.losses.potential import default_potential, scale
from hood.losses.problem import StepProblem, inertial_guess
from hood.scene.batch import to_device
from hood.scene.cloth import build_cloth
from hood.scene.contact import find_contact
from hood.scene.state import Obstacle, State, StepInput
from hood.solver.newton import NewtonSettings, Progress, Report, minimize
from hood.solver.plan import plan_for
from hood.solver.sweeps import sweep
from hood.testing import grid, sphere

DT = 1.0 / 30.0
TARGETS: dict[str, Callable[[float, float], bool]] = {
    "gap 1e-1": lambda gap, rg: gap <= 0.1,
    "gap 1e-2": lambda gap, rg: gap <= 1e-2,
    "rg 1e-2": lambda gap, rg: rg <= 1e-2,
    "rg 1e-4": lambda gap, rg: rg <= 1e-4,
}


def drop(side: int, size: float, radius: float, device: str) -> tuple[State, Obstacle, StepProblem]:
    """A level sheet of ``side``² vertices 1 cm above a sphere, at rest."""
    pos, faces = grid(side, side, size)
    cloth = build_cloth(pos + [-size / 2, radius + 0.01, -size / 2], faces, Material(), dtype=torch.float64)
    body, body_faces = (torch.as_tensor(array) for array in sphere(3, radius))
    index = torch.zeros(len(body), dtype=torch.int64), torch.zeros(len(body_faces), dtype=torch.int64)
    obstacle = to_device(Obstacle(body, body, body, body_faces, *index), device)
    cloth = to_device(cloth, device)
    state = State(cloth.rest_pos, torch.zeros_like(cloth.rest_pos), torch.zeros(1, 3, dtype=torch.float64))
    step = StepInput(dt=torch.tensor([DT], dtype=torch.float64, device=device), obstacle=obstacle)
    return state, obstacle, StepProblem(cloth, state, step)


def solve_frames(side: int, frames: int, settings: NewtonSettings, device: str) -> list[dict[str, tuple[float, int] | None]]:
    """Time [ms] and iterations to every target, frame by frame."""
    potential = default_potential()
    state, obstacle, template = drop(side, 1.0, 0.3, device)
    minimize(potential, template, settings=replace(settings, max_iterations=1))  # plan and first-call costs
    rows = []
    for _ in range(frames):
        contact = find_contact(state.pos, template.cloth.vertex_scene, obstacle)
        problem = replace(template, state=state, contact=contact)
        pos, report = minimize(potential, problem, settings=settings)
        starts = (inertial_guess(state, problem.step), state.pos)
        others = [minimize(potential, problem, start, replace(settings, target_rg=1e-3))[1] for start in starts]
        best = min(float(found.phi) for found in (report, *others))
        rows.append({name: _reached(report, best, float(scale(problem)), test) for name, test in TARGETS.items()})
        state = State(pos, state.vel + DT * report.acc, state.origin)
    return rows


def _reached(report: Report, best: float, unit: float, test: Callable[[float, float], bool]) -> tuple[float, int] | None:
    def values(progress: Progress) -> tuple[float, float]:
        return (float(progress.phi) - best) / unit, float(progress.relative_gradient)

    for iteration, progress in enumerate(report.history):
        if test(*values(progress)):
            return 1e3 * progress.seconds, iteration
    return None


def describe(rows: list[dict[str, tuple[float, int] | None]], label: str) -> str:
    """One line of the table."""
    cells = []
    for name in TARGETS:
        reached = np.array([row[name] for row in rows if row[name] is not None], dtype=np.float64).reshape(-1, 2)
        missed = f", {len(rows) - len(reached)} missed" if len(reached) < len(rows) else ""
        if not len(reached):
            cells.append("missed")
            continue
        (ms, its), (ms95, its95) = np.median(reached, axis=0), np.percentile(reached, 95, axis=0)
        cells.append(f"{ms:.0f} / {ms95:.0f} ms ({its:.0f} / {its95:.0f} its{missed})")
    return f"| {label} | " + " | ".join(cells) + " |"


def time_sweep(side: int, device: str) -> float:
    """Milliseconds of one local sweep of the sheet on the sphere."""
    state, obstacle, template = drop(side, 1.0, 0.3, device)
    problem = replace(template, contact=find_contact(state.pos, template.cloth.vertex_scene, obstacle))
    start = state.pos + 1e-4 * torch.sin(50 * state.pos.flip(1))
    plan_for(problem)
    times = []
    for count in (1, 6):
        began = time.perf_counter()
        _, report = sweep(default_potential(), problem, start, count)
        times.append((time.perf_counter() - began) / max(int(report.kept), 1) * int(report.kept))
    return 1e3 * (times[1] - times[0]) / 5


def device_name(device: str) -> str:
    """The processor's or the accelerator's own name."""
    if device != "cpu":
        return torch.cuda.get_device_name(device)
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor() or platform.machine()}, {torch.get_num_threads()} thread(s)"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sides", type=int, nargs="+", default=[33, 64], help="vertices along a side of the sheet")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--linear", nargs="+", default=["cg", "direct"], choices=["cg", "direct"])
    parser.add_argument("--cg-iterations", type=int, default=50)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    print(
        f"{device_name(args.device)}; sheet 1 m × 1 m on a sphere of radius 0.3 m, dt = 1/30 s, {args.frames} frames, float64"
    )
    print("| one implicit step, median / p95 | " + " | ".join(TARGETS) + " |\n" + "|---" * (len(TARGETS) + 1) + "|")
    for side in args.sides:
        for linear in args.linear:
            settings = NewtonSettings(1e-4, 200, linear=linear, cg_iterations=args.cg_iterations)
            rows = solve_frames(side, args.frames, settings, args.device)
            print(describe(rows, f"Newton, {linear}, {side * side:,} vertices"), flush=True)
        print(f"one local sweep, {side * side:,} vertices: {time_sweep(side, args.device):.1f} ms", flush=True)


if __name__ == "__main__":
    main()

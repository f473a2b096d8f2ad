"""Cost of the energies: a sheet of 1,000 to 100,000 vertices wrapped around a body, and their share of a training step.

    python benchmarks/losses.py --sides 32 71 142 316 --share 71

Prints, per size, the median CPU time [ms] of value and gradient of every term alone, of all terms together, of one contact
search, and what 1,000 vertices cost; repetitions alternate over everything that is measured. ``--share`` then takes
training steps of the 15-step model of latent width 128 on a sheet of that side, with body edges, and prints the share of
the energies in them, search excluded.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping

import numpy as np
import torch
from solver import device_name
from torch import Tensor

from hood.assets.material import Material
from hood.cli.main import ENVIRONMENT
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, State, StepInput
from hood.contact.contact import find_contact
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.steppers.network import build_simulator
from hood.tensors.batch import to_device
from hood.testing import cylinder, grid

DT = 1.0 / 30.0
TERMS = ("stretching", "bending", "inertia", "gravity", "collision", "friction")
_RADIUS, _SIZE = 0.2, 0.7  # m, of the body and of the sheet
_GAP = (5e-4, 4e-2)  # m, between them at the sheet's two ends: some vertices touch, some have no body edge


def wrapped_sheet(side: int) -> tuple[StepProblem, np.ndarray]:
    """The step of a sheet of ``side``² vertices around a tube of 6,889 that moves away, and the sheet's rest positions."""
    flat, faces = grid(side, side, _SIZE)
    angle, height = flat[:, 0] / _RADIUS, flat[:, 2]
    radius = _RADIUS + _GAP[0] + (_GAP[1] - _GAP[0]) * height / _SIZE
    rest_pos = np.stack([radius * np.cos(angle), height + 0.15, -radius * np.sin(angle)], axis=1)
    cloth = build_cloth(rest_pos, faces, Material())
    body, body_faces = (torch.as_tensor(array) for array in cylinder(83, 83, _RADIUS, 1.0))
    motion = torch.tensor([0.01, 0.0, 0.0], dtype=body.dtype)
    index = torch.zeros(len(body), dtype=torch.int64), torch.zeros(len(body_faces), dtype=torch.int64)
    omitted = torch.zeros(len(body), dtype=torch.bool)
    obstacle = Obstacle(body, body + motion, body - motion, body_faces, *index, omitted)
    state = State(cloth.rest_pos, _noise(len(rest_pos), 0.1), torch.zeros(1, 3, dtype=torch.float64))
    step = StepInput(dt=torch.tensor([DT]), obstacle=to_device(obstacle, dtype=torch.float32))
    contact = find_contact(state.pos, cloth.vertex_scene, step.obstacle)
    return StepProblem(cloth, state, step, contact), rest_pos


def medians(work: Mapping[str, Callable[[], object]], repetitions: int) -> dict[str, float]:
    """Median CPU time [ms] of each piece of work, taken in turns after two rounds that do not count."""
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(repetitions + 2):
        for name, call in work.items():
            begin = time.process_time()
            call()
            times[name].append(1e3 * (time.process_time() - begin))
    return {name: float(np.median(values[2:])) for name, values in times.items()}


def time_terms(side: int, repetitions: int) -> dict[str, float]:
    """CPU times [ms] of value and gradient, term by term and together, and of the search."""
    potential = default_potential()
    problem = potential.prepare(wrapped_sheet(side)[0])
    acc = _noise(side * side, 1.0)
    next_pos = problem.state.pos + DT * problem.state.vel + DT**2 * acc

    def gradient(part: Potential) -> Callable[[], object]:
        return lambda: part.gradient(problem, next_pos, acc)

    work = {name: gradient(Potential({name: potential.terms[name]})) for name in TERMS}
    work["all six"] = gradient(potential)
    work["search"] = lambda: find_contact(problem.state.pos, problem.cloth.vertex_scene, problem.step.obstacle)
    return medians(work, repetitions)


def time_training(side: int, repetitions: int) -> tuple[dict[str, float], int]:
    """Median CPU time [ms] of the parts of a training step, and the number of body edges."""
    torch.manual_seed(0)
    problem, rest_pos = wrapped_sheet(side)
    simulator = build_simulator(schedule="ours", latent_dim=128).train()
    prepared, potential = simulator.prepare(problem.cloth, rest_pos), default_potential()
    problem = potential.prepare(problem)
    optimizer = torch.optim.Adam(simulator.parameters(), lr=5e-5)
    parts: dict[str, list[float]] = {"features and network": [], "energies": [], "backward and update": []}
    for _ in range(repetitions + 1):
        marks = [time.process_time()]
        prediction = simulator(problem, prepared)
        marks.append(time.process_time())
        slope, _ = potential.gradient(problem, prediction.next_pos.detach(), prediction.acc.detach())
        marks.append(time.process_time())
        optimizer.zero_grad(set_to_none=True)
        (prediction.next_pos * slope).sum().backward()
        torch.nn.utils.clip_grad_norm_(simulator.parameters(), 1.0)
        optimizer.step()
        marks.append(time.process_time())
        for name, length in zip(parts, np.diff(marks), strict=True):
            parts[name].append(1e3 * length)
    reach = problem.contact.vertex_dist <= simulator.body_radius
    return {name: float(np.median(values[1:])) for name, values in parts.items()}, int(reach.sum())


def _noise(count: int, size: float) -> Tensor:
    return size * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sides", type=int, nargs="*", default=[32, 71, 142, 316], help="vertices along a side of the sheet")
    parser.add_argument("--share", type=int, default=71, help="side of the sheet of the training steps; 0: none")
    parser.add_argument("--repetitions", type=int, default=20)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    if any(os.environ.get(key) is None for key in ENVIRONMENT):  # allocator settings are read at process start only
        os.execve(sys.executable, [sys.executable, *sys.argv], {**ENVIRONMENT, **os.environ})
    torch.set_num_threads(args.threads)
    print(f"{device_name('cpu')}, float32, CPU time of the process, medians of {args.repetitions}")
    print("| value and gradient [ms] | " + " | ".join(TERMS) + " | all six | per 1,000 vertices | one search |")
    print("|---" * (len(TERMS) + 4) + "|")
    for side in args.sides:
        found = time_terms(side, args.repetitions)
        cells = [f"{found[name]:.2f}" for name in (*TERMS, "all six")]
        cells += [f"{1e3 * found['all six'] / side**2:.2f}", f"{found['search']:.1f}"]
        print(f"| {side * side:,} vertices | " + " | ".join(cells) + " |", flush=True)
    print("Prototype of these energies on one core of an AMD server CPU: 9 ms all six at 5,041 vertices.")
    if args.share:
        parts, num_edges = time_training(args.share, max(args.repetitions // 4, 3))
        whole = sum(parts.values())
        listed = ", ".join(f"{name} {value:.1f} ms" for name, value in parts.items())
        print(f"Training step, 15 steps, latent 128, {args.share**2:,} vertices, {num_edges:,} with a body edge: {listed}.")
        print(f"Share of the energies: {100 * parts['energies'] / whole:.2f}%")


if __name__ == "__main__":
    main()

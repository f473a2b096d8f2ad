"""The compiled solver beside the one in torch: CPU time of a step, in turns in one process, and whether they agree.

    python benchmarks/engine.py                          # dress, dress_4k, dress_12k
    python benchmarks/engine.py tshirt --iterations 100

Steps of a rollout on ``walk_proud`` (embedded body, default fabric), each solved by both forms from the same state; the
compiled one goes on. A line per garment: median CPU milliseconds of the contact search and of the solver, and the greatest
difference of the potential that both reach, in units of e0.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median
from typing import Any, TypeVar

import torch

from hood.assets.body import load_body
from hood.assets.garment import load_garment
from hood.assets.sequence import load_sequence
from hood.commands.circumstances import machine_name
from hood.losses.potential import default_potential, scale
from hood.losses.problem import StepProblem
from hood.mesh import surface_tree
from hood.scene.contact import find_contact
from hood.scene.scene import build_scene
from hood.scene.state import State
from hood.solver.newton import NewtonSettings, minimize

Result = TypeVar("Result")


def timed(into: list[float], work: Callable[..., Result], *arguments: Any) -> Result:
    """``work(*arguments)``; its CPU milliseconds are appended to ``into``."""
    began = time.process_time()
    result = work(*arguments)
    into.append(1e3 * (time.process_time() - began))
    return result


def compare(garment: str, frames: int, iterations: int) -> str:
    """A line of the table."""
    scene = build_scene(load_garment(garment), load_body(), load_sequence("walk_proud"), dtype=torch.float64)
    potential, compiled = default_potential(), surface_tree.library
    times: dict[str, list[float]] = {name: [] for name in ("search torch", "search compiled", "torch", "compiled")}
    worst, state = 0.0, scene.start(0)
    for frame in range(frames):
        step = scene.step_input(frame, state)
        obstacle = step.obstacle
        assert obstacle is not None
        for name, library in (("search torch", lambda: None), ("search compiled", compiled)):
            surface_tree.library = library
            timed(times[name], find_contact, state.pos, scene.cloth.vertex_scene, obstacle)
        problem = potential.prepare(StepProblem(scene.cloth, state, step))
        found = {}
        for name in ("torch", "compiled"):
            settings = NewtonSettings(max_iterations=iterations, engine=name)
            found[name] = timed(times[name], minimize, potential, problem, None, settings)
        worst = max(worst, float(abs(found["torch"][1].phi - found["compiled"][1].phi) / scale(problem)))
        pos, report = found["compiled"]
        state = State(pos, state.vel + problem.vertex_dt * report.acc, state.origin)
    shown = {name: median(values[1:]) for name, values in times.items()}  # the first one makes tables
    columns = [f"{garment:12s} {len(scene.cloth.rest_pos):6d}"]
    for part in ("search ", ""):
        plain, fast = shown[f"{part}torch"], shown[f"{part}compiled"]
        columns.append(f"{plain:16.1f} {fast:9.1f} {plain / fast:6.1f}")
    return " ".join([*columns, f"{worst:12.1e}"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garments", nargs="*", default=["dress", "dress_4k", "dress_12k"])
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--iterations", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{machine_name('cpu')}; {arguments.iterations} iterations at most")
    print("garment    vertices  search ms: torch  compiled ratio  solver ms: torch compiled  ratio  max |ΔΦ|/e0")
    for garment in arguments.garments:
        print(compare(garment, arguments.frames, arguments.iterations), flush=True)


if __name__ == "__main__":
    main()

"""The compiled solver beside the one in torch: CPU time, whether they agree, and what a whole frame costs at which accuracy.

    python benchmarks/engine.py                                           # dress, dress_4k, dress_12k
    python benchmarks/engine.py tshirt trousers dress skirt --motions walk_proud dance_mixed plie
    python benchmarks/engine.py --frame tshirt dress_4k dress_12k --iterations 4
    python benchmarks/engine.py --frame --threads 1 2                     # in turns, on the clock too
    python benchmarks/engine.py --frame dress --refine-to 50000 --frames 4
    python benchmarks/engine.py --converged tshirt trousers dress skirt --motions walk_proud dance_mixed plie --frames 60

Steps of rollouts (embedded body, default fabric), each solved by both forms from the same state; the compiled one goes on. A
line per garment: median CPU milliseconds of the contact search and of the solver, the greatest difference of the potential that
both reach, in units of e0 (what their γ differ by), and the share of the steps in which it is 1e-3 at most. They solve linear
systems by different preconditioners: after few iterations they are apart, at the minimum only where there are several.

``--frame`` times whole frames of ``stepper=newton`` with the compiled solver: posing, search, solver, integration, no metrics
and no files: median CPU milliseconds, median and least milliseconds on the clock, CPU microseconds of a vertex, median and 95th
percentile of γ over every fourth state, and the most memory that the process has had so far. ``--refine-to`` halves the longest
edges of a garment until it has so many vertices.

``--converged`` lets both forms go on until they converge, by their default settings, each along its own rollout. A line per
garment, motion and form: the steps that missed their accuracy, the Newton iterations of a step and its relative gradient.
"""

from __future__ import annotations

import argparse
import gc
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from statistics import median
from typing import Any, TypeVar

import numpy as np
import torch
from frame import refined

from hood.app.candidates import machine_name
from hood.assets.body.load import load_body
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.cli.main import ENVIRONMENT
from hood.cloth.state import State
from hood.contact.contact import find_contact
from hood.energies.potential import default_potential, scale
from hood.energies.problem import StepProblem
from hood.evaluation.gap import gap
from hood.mesh.closest_point import tree
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings, Report, minimize
from hood.steppers.network import Prediction
from hood.steppers.newton import NewtonStepper
from hood.steppers.protocol import Stopwatch

#: Steps whose potentials differ by so much [e0] count as the same.
SAME = 1e-3
#: Every so many-th state of a rollout has its gap computed.
STRIDE = 4

Result = TypeVar("Result")
#: A step and where it leads.
Seen = tuple[StepProblem, torch.Tensor]


def timed(into: list[float], work: Callable[..., Result], *arguments: Any) -> Result:
    """``work(*arguments)``; its CPU milliseconds are appended to ``into``."""
    began = time.process_time()
    result = work(*arguments)
    into.append(1e3 * (time.process_time() - began))
    return result


def make_scene(garment: str, motion: str) -> Scene:
    """The scene of a garment; ``dress:50000`` is refined to so many vertices."""
    name, _, count = garment.partition(":")
    whole = load_garment(name)
    chosen = refined(whole, int(count)) if count else whole
    return build_scene(chosen, load_body(), load_sequence(motion, 30.0), dtype=torch.float64)


def _keep(steps: list[Seen], index: int, problem: StepProblem, prediction: Prediction) -> None:
    steps.append((problem, prediction.next_pos))


def solve_both(scene: Scene, frames: int, iterations: int, times: dict[str, list[float]]) -> list[float]:
    """Differences of the potential [e0] step by step; ``times`` of the parts are appended."""
    potential, compiled = default_potential(), tree.library
    differences, state = [], scene.start(0)
    for frame in range(frames):
        step = scene.step_input(frame, state)
        obstacle = step.obstacle
        assert obstacle is not None
        for name, library in (("search torch", lambda: None), ("search compiled", compiled)):
            tree.library = library
            timed(times[name], find_contact, state.pos, scene.cloth.vertex_scene, obstacle)
        problem = potential.prepare(StepProblem(scene.cloth, state, step))
        found = {}
        for name in ("torch", "compiled"):
            settings = NewtonSettings(max_iterations=iterations, engine=name)
            found[name] = timed(times[name], minimize, potential, problem, None, settings)
        differences.append(float(abs(found["torch"][1].phi - found["compiled"][1].phi) / scale(problem)))
        pos, report = found["compiled"]
        state = State(pos, state.vel + problem.vertex_dt * report.acc, state.origin)
    return differences


def compare(garment: str, motions: list[str], frames: int, iterations: int) -> Iterator[str]:
    """The line of the table of both forms."""
    times: dict[str, list[float]] = {name: [] for name in ("search torch", "search compiled", "torch", "compiled")}
    differences = []
    for motion in motions:
        scene = make_scene(garment, motion)
        differences += solve_both(scene, frames, iterations, times)
    shown = {name: median(values[1:]) for name, values in times.items()}  # the first one makes tables
    columns = [f"{garment:12s} {len(scene.cloth.rest_pos):6d}"]
    for part in ("search ", ""):
        plain, fast = shown[f"{part}torch"], shown[f"{part}compiled"]
        columns.append(f"{plain:16.1f} {fast:9.1f} {plain / fast:6.1f}")
    same = sum(difference <= SAME for difference in differences)
    yield " ".join([*columns, f"{max(differences):12.1e}   {same} of {len(differences)}"])


#: Milliseconds and γ of the frames of all garments, by threads.
Pool = dict[int, tuple[list[float], list[float]]]


def time_frames(
    garment: str, motions: list[str], frames: int, iterations: int, threads: list[int], pool: Pool
) -> Iterator[str]:
    """Lines of the table of whole frames, one for each number of threads; rollouts take turns frame by frame. What was found is
    added to ``pool``."""
    potential = default_potential()
    settings = NewtonSettings(max_iterations=iterations)
    spent: dict[int, list[float]] = {number: [] for number in threads}
    clock: dict[int, list[float]] = {number: [] for number in threads}
    seen: dict[int, list[Seen]] = {number: [] for number in threads}
    for motion in motions:
        scene = make_scene(garment, motion)
        rollouts = {}
        for number in threads:
            torch.set_num_threads(number)
            steps: list[Seen] = []
            keep = partial(_keep, steps)
            rollouts[number] = simulate(
                NewtonStepper(potential, settings), scene, potential, frames + 1, observe=keep, metrics="none"
            )
            next(rollouts[number])
            seen[number].append(steps)
        for _ in range(frames):
            for number, rollout in rollouts.items():
                torch.set_num_threads(number)
                began = time.perf_counter()
                timed(spent[number], next, rollout)
                clock[number].append(1e3 * (time.perf_counter() - began))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10)
    size = len(scene.cloth.rest_pos)
    for number in threads:
        gaps = [float(gap(potential, problem, pos).gamma) for steps in seen[number] for problem, pos in steps[::STRIDE]]
        pool.setdefault(number, ([], []))[0].extend(spent[number])
        pool[number][1].extend(gaps)
        cpu, (middle, high) = median(spent[number]), np.percentile(gaps, [50, 95])
        times = f"{cpu:10.1f} {median(clock[number]):9.1f} {min(clock[number]):7.1f} {1e3 * cpu / size:9.1f}"
        yield f"{garment:12s} {size:6d} {number:7d} {times} {middle:10.2g} {high:8.2g} {len(gaps):6d} {memory:8.0f}"


class Reporting(NewtonStepper):
    """Keeps what the solver reports of the last step."""

    def predict(self, problem: StepProblem, prepared: None, watch: Stopwatch | None = None) -> Prediction:
        pos, self.report = minimize(self.potential, problem, settings=self.settings)
        return Prediction(pos, self.report.acc, {})


def solved_rollout(garment: str, motion: str, frames: int, form: str) -> list[tuple[Report, float]]:
    """Reports and CPU milliseconds of the steps of a rollout that one form solves."""
    potential, reports, times = default_potential(), [], []
    stepper = Reporting(potential, NewtonSettings(engine=form))
    rollout = simulate(
        stepper,
        make_scene(garment, motion),
        potential,
        frames + 1,
        observe=lambda *_: reports.append(stepper.report),
        metrics="none",
    )
    next(rollout)
    for _ in range(frames):
        timed(times, next, rollout)
    return list(zip(reports, times, strict=True))


def converge(garment: str, motions: list[str], frames: int) -> Iterator[str]:
    """Lines of the table of both forms until they converge."""
    for motion in motions:
        for form in ("compiled", "torch"):
            steps = solved_rollout(garment, motion, frames, form)
            missed = sum(not bool(report.converged.all()) for report, _ in steps)
            middle, high, most = np.percentile([report.iterations for report, _ in steps], [50, 95, 100])
            worst = max(float(report.relative_gradient.max()) for report, _ in steps)
            counts = f"{len(steps):6d} {missed:7d} {middle:8.0f} {high:5.0f} {most:5.0f}"
            yield f"{garment:12s} {motion:15s} {form:9s} {counts} {worst:9.1e} {median(ms for _, ms in steps):9.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garments", nargs="*", default=["dress", "dress_4k", "dress_12k"])
    parser.add_argument("--motions", nargs="+", default=["walk_proud"])
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--iterations", type=int, default=5)
    parser.add_argument("--frame", action="store_true", help="time whole frames")
    parser.add_argument("--converged", action="store_true", help="count the steps that miss their accuracy")
    parser.add_argument("--threads", type=int, nargs="+", default=[1], help="of --frame")
    parser.add_argument("--refine-to", type=int, default=0, metavar="VERTICES", help="of every garment")
    arguments = parser.parse_args()
    if any(os.environ.get(key) is None for key in ENVIRONMENT):  # read at process start only
        os.execve(sys.executable, [sys.executable, *sys.argv], {**ENVIRONMENT, **os.environ})
    torch.set_num_threads(1)
    gc.freeze()  # as the commands do
    common = (arguments.motions, arguments.frames)
    limit = f"{arguments.iterations} iterations at most"
    work: Callable[[str], Iterator[str]]
    pool: Pool = {}
    if arguments.converged:
        limit, work = "iterations until the default accuracy", lambda garment: converge(garment, *common)
        head = "garment      motion          form       steps  missed its median   p95   max  worst rg  frame ms"
    elif arguments.frame:
        work = lambda garment: time_frames(garment, *common, arguments.iterations, arguments.threads, pool)  # noqa: E731
        head = "garment    vertices threads   frame ms  on clock   least us/vertex   γ median    γ p95 states       MB"
    else:
        work = lambda garment: compare(garment, *common, arguments.iterations)  # noqa: E731
        head = "garment    vertices  search ms: torch  compiled ratio  solver ms: torch compiled  ratio"
        head += f"  max |ΔΦ|/e0   within {SAME:g}"
    print(f"{machine_name('cpu')}; {limit}\n{head}", flush=True)
    for garment in arguments.garments:
        for line in work(f"{garment}:{arguments.refine_to}" if arguments.refine_to else garment):
            print(line, flush=True)
    for number, (times, gaps) in pool.items():
        middle, high = np.percentile(gaps, [50, 95])
        print(f"{'all':12s} {number:14d} {median(times):10.1f} {middle:37.2g} {high:8.2g} {len(gaps):6d}")


if __name__ == "__main__":
    main()

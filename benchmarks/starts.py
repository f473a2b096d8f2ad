"""Is a network's step a good place to begin Newton's method? Iterations and time to the same accuracy, on hard steps.

    python benchmarks/starts.py                                # shipped networks, all scenes but the largest
    python benchmarks/starts.py --scenes 12k 50k --states 4    # large garments
    python benchmarks/starts.py --models quickstart FILE.safetensors --csv starts.csv

States are those of the solver's own rollouts, so that every start has the same problem. Begun is from the previous positions,
from those that move on as they did (``stepper=newton``'s own: contact-projected inertial guess), from the base of the
networks, which moves with the body, from each network, and from the lower in Φ of the solver's own and the network's. All go
on to rg 0.01. Milliseconds are CPU time on one thread; a network's own time is added to what its start costs. The search for
contact is not counted, since nobody is spared it.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from frame import refined
from torch import Tensor

from hood.assets.body.load import load_body
from hood.assets.files.library import locate
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.evaluation.gap import StepSample
from hood.model.readout.output import VelocityBaseOutput
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings, Report, first_guess, minimize
from hood.solver.system.iterate import in_double, in_single
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import NetworkStepper
from hood.steppers.newton import NewtonStepper
from hood.studies.envelope.extreme_files import write_motion
from hood.tensors.batch import to_device

SETTINGS = NewtonSettings(target_rg=1e-2, max_iterations=100)
#: By name: garment, motion (of the project, or of hood.studies.envelope.extreme_files with an amount), frames per second,
#: speed, frames.
SCENES = {
    "walk": ("tshirt", "walk_proud", 30.0, 1.0, 40),
    "dance": ("dress", "dance_mixed", 30.0, 1.0, 40),
    "dance, dt 1/15": ("dress", "dance_mixed", 15.0, 1.0, 30),
    "dance, dt 1/5": ("dress", "dance_mixed", 5.0, 1.0, 15),
    "spin 2/s": ("dress", "spin:2", 30.0, 1.0, 40),
    "dance ×4": ("dress", "dance_mixed", 30.0, 4.0, 30),
    "stop 10 g": ("dress", "stop:10", 30.0, 1.0, 40),
    "4k": ("dress_4k", "dance_mixed", 30.0, 1.0, 30),
    "12k": ("dress_12k", "dance_mixed", 30.0, 1.0, 20),
    "50k": ("dress:50000", "dance_mixed", 30.0, 1.0, 10),
}
LARGE = ("12k", "50k")
OWN = "the solver's own"
#: Frames per second that embedded motions are sampled with.
FILE_FPS = 60.0


@dataclass
class Measured:
    """One start over the states of a scene."""

    iterations: list[int] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)
    missed: int = 0

    def add(self, iterations: int, ms: float, converged: bool) -> None:
        self.iterations.append(iterations)
        self.ms.append(ms)
        self.missed += not converged


Start = Callable[[StepProblem], Tensor | None]


class Network:
    """A network's step as a start."""

    def __init__(self, name: str, scene: Scene, kernels: str) -> None:
        self.simulator: NetworkStepper = load_simulator(Path(name) if Path(name).exists() else locate("weights", name)).eval()
        self.simulator.network.use_kernels(kernels)
        self.cloth = to_device(scene.cloth, dtype=torch.float32)
        self.prepared = self.simulator.prepare(self.cloth, scene.garment.rest_pos)

    def __call__(self, problem: StepProblem) -> Tensor:
        return self.simulator.predict(in_single(problem, self.cloth), self.prepared).next_pos.double()


def make_scene(name: str) -> Scene:
    """One of :data:`SCENES`, in float64."""
    garment, motion, fps, speed, frames = SCENES[name]
    base, _, count = garment.partition(":")
    chosen = refined(load_garment(base), int(count)) if count else load_garment(base)
    if ":" in motion:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "motion.npz"
            write_motion(path, motion, frames / fps + 1.0)
            sequence = load_sequence(path, fps)
    else:
        sequence = load_sequence(motion, fps, file_fps=FILE_FPS * speed)
    return build_scene(chosen, load_body(), sequence, dtype=torch.float64)


def steps_of(name: str, scene: Scene, potential: Potential, count: int) -> list[StepProblem]:
    """Steps of the solver's rollout, spread over it."""
    sample = StepSample(range(3, min(SCENES[name][-1], scene.num_frames)), count)
    stepper = NewtonStepper(potential, SETTINGS)
    for _ in simulate(stepper, scene, potential, min(SCENES[name][-1], scene.num_frames), observe=sample, metrics="none"):
        pass
    return [potential.prepare(problem) for problem, _ in sample.steps]


def spent(call: Callable[..., Tensor | None], *arguments: Any) -> tuple[Tensor | None, float]:
    """What comes out, and CPU milliseconds."""
    began = time.process_time()
    found = call(*arguments)
    return found, 1e3 * (time.process_time() - began)


def measure(name: str, models: list[str], states: int, kernels: str) -> dict[str, Measured]:
    """All starts of a scene."""
    potential, scene = default_potential(), make_scene(name)
    problems = steps_of(name, scene, potential, states)
    starts: dict[str, Start] = {"previous positions": lambda problem: problem.state.pos, OWN: lambda problem: None}
    starts["moving base"] = VelocityBaseOutput().base
    networks: dict[str, Start] = {model: Network(model, scene, kernels) for model in models}
    for start in [*starts.values(), *networks.values()]:
        _solve(potential, problems[0], start(problems[0]))  # tables, and kernels that are chosen at their first use
    measured: dict[str, Measured] = {}
    for problem in problems:
        for title, start in (starts | networks).items():
            begun, ms = spent(start, problem)
            _note(measured, title, potential, problem, begun, ms)
            if title in networks:
                assert begun is not None
                lowest, looked = spent(_lower, potential, problem, begun)
                _note(measured, f"lower of {title} and {OWN}", potential, problem, lowest, ms + looked)
    return measured


def _lower(potential: Potential, problem: StepProblem, pos: Tensor) -> Tensor:
    own, _ = first_guess(potential, problem)
    work = in_double(problem)
    return min((own, pos), key=lambda at: float(potential.total(work, at)))


def _solve(potential: Potential, problem: StepProblem, start: Tensor | None) -> tuple[Tensor, Report]:
    return minimize(potential, problem, start, SETTINGS)


def _note(
    measured: dict[str, Measured], title: str, potential: Potential, problem: StepProblem, start: Tensor | None, ms: float
) -> None:
    began = time.process_time()
    _, report = _solve(potential, problem, start)
    ms += 1e3 * (time.process_time() - began)
    measured.setdefault(title, Measured()).add(report.iterations, ms, bool(report.converged.all()))


def print_table(name: str, measured: dict[str, Measured]) -> None:
    """A line per start: iterations and milliseconds, median, 95th and 99th percentile."""
    count = len(next(iter(measured.values())).ms)
    print(f"\n{name}: {', '.join(map(str, SCENES[name][:2]))}, {count} states")
    print("| start | iterations | CPU ms | missed |\n|---|---|---|---|")
    for title, one in measured.items():
        iterations, ms = (np.percentile(values, [50, 95, 99], method="higher") for values in (one.iterations, one.ms))
        cells = [" / ".join(f"{value:.0f}" for value in values) for values in (iterations, ms)]
        print("| " + " | ".join([title, *cells, str(one.missed)]) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=tuple(SCENES), default=[name for name in SCENES if name not in LARGE])
    parser.add_argument("--models", nargs="+", default=["quickstart", "small-ours"], help="shipped names or model files")
    parser.add_argument("--states", type=int, default=16, help="of every scene")
    parser.add_argument("--kernels", default="fused")
    parser.add_argument("--csv", type=Path, help="every solve")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    with torch.no_grad():
        for name in arguments.scenes:
            measured = measure(name, arguments.models, arguments.states, arguments.kernels)
            print_table(name, measured)
            for title, one in measured.items():
                rows += [(name, title, *figures) for figures in zip(one.iterations, one.ms, strict=True)]
    if arguments.csv is not None:
        with arguments.csv.open("w", newline="") as file:
            csv.writer(file).writerows([("scene", "start", "iterations", "ms"), *rows])


if __name__ == "__main__":
    main()

"""Many garments at once: CPU time per garment and frame, of networks and of the solver.

    python benchmarks/batches.py                                # 1, 8 and 16 dresses and T-shirts of 1,000 vertices
    python benchmarks/batches.py --garments dress_4k --counts 1 8
    python benchmarks/batches.py --kernels torch --threads 2

Every garment of a batch is in another frame of the motion, skinned to its pose. A network takes the step of all of them in one
call, search for contact included; the solver does five iterations (or, ``until 0.01``, as many as rg 0.01 takes) on the same
batch. Medians of ``--repeats`` calls in turns, after a first one; time of the clock with more threads than one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median

import torch

from hood.assets.body.load import load_body
from hood.assets.files.library import locate
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.cloth.cloth import concatenate_cloths
from hood.cloth.state import concatenate_states, concatenate_step_inputs
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings, minimize
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import NetworkStepper

SOLVERS = {"solver, 5 iterations": NewtonSettings(max_iterations=5), "solver, until 0.01": NewtonSettings(target_rg=1e-2)}


def make_batch(scenes: list[Scene]) -> StepProblem:
    """Garments in frames that are ten apart."""
    frames = [10 * index % (scene.num_frames - 2) for index, scene in enumerate(scenes)]
    states = [scene.start(frame) for frame, scene in zip(frames, scenes, strict=True)]
    steps = [scene.step_input(frame, state) for frame, scene, state in zip(frames, scenes, states, strict=True)]
    counts = [scene.cloth.num_vertices for scene in scenes]
    cloth = concatenate_cloths([scene.cloth for scene in scenes])
    return StepProblem(cloth, concatenate_states(states), concatenate_step_inputs(steps, counts))


def network_call(simulator: NetworkStepper, scenes: list[Scene]) -> Callable[[], object]:
    """A step of the network, search included."""
    batch = make_batch(scenes)
    single = {id(scene): simulator.prepare(scene.cloth, scene.garment.rest_pos) for scene in scenes}
    prepared = [single[id(scene)] for scene in scenes]
    if len(scenes) == 1:
        return partial(simulator.predict, batch, prepared[0])
    counts = [scene.cloth.num_vertices for scene in scenes]
    return partial(simulator.predict, batch, simulator.concatenate(batch.cloth, prepared, counts))


def solver_call(potential: Potential, scenes: list[Scene], settings: NewtonSettings) -> Callable[[], object]:
    """A step of the solver, search included."""
    batch = make_batch(scenes)
    return lambda: minimize(potential, potential.prepare(batch), None, settings)


def measure(garments: list[str], counts: list[int], models: list[str], kernels: str, repeats: int) -> None:
    """The table."""
    potential, body, motion = default_potential(), load_body(), load_sequence("walk_proud", 30.0)
    base = [build_scene(load_garment(garment), body, motion) for garment in garments]
    simulators = {}
    for model in models:
        simulators[model] = load_simulator(Path(model) if Path(model).exists() else locate("weights", model)).eval()
        simulators[model].network.use_kernels(kernels)
    calls: dict[tuple[str, int], Callable[[], object]] = {}
    for count in counts:
        scenes = [base[index % len(base)] for index in range(count)]
        calls |= {(model, count): network_call(simulator, scenes) for model, simulator in simulators.items()}
        calls |= {(name, count): solver_call(potential, scenes, settings) for name, settings in SOLVERS.items()}
    times: dict[tuple[str, int], list[float]] = {key: [] for key in calls}
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    for turn in range(repeats + 1):
        for key, call in calls.items():
            began = clock()
            call()
            if turn:
                times[key].append(1e3 * (clock() - began) / key[1])
    print(f"ms per garment and frame, {', '.join(garments)}, kernels {kernels}, threads {torch.get_num_threads()}")
    print("| | " + " | ".join(f"{count} at once" for count in counts) + " |\n|" + (len(counts) + 1) * "---|")
    for name in [*models, *SOLVERS]:
        print(f"| {name} | " + " | ".join(f"{median(times[name, count]):.1f}" for count in counts) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garments", nargs="+", default=["dress", "tshirt"])
    parser.add_argument("--counts", nargs="+", type=int, default=[1, 8, 16])
    parser.add_argument("--models", nargs="+", default=["quickstart", "small-ours"], help="shipped names or model files")
    parser.add_argument("--kernels", default="fused")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    with torch.no_grad():
        measure(arguments.garments, arguments.counts, arguments.models, arguments.kernels, arguments.repeats)


if __name__ == "__main__":
    main()

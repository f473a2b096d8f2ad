"""A whole frame (search, features, network, integration) on a GPU: milliseconds and kernel launches by way of taking it.

    python benchmarks/gpu.py --sizes 5000 12000 50000 --models fine15 ours --precision fp32 tf32 bf16

The embedded dress, refined to the given number of vertices, on the embedded body of 6,890 vertices, walking; random weights;
every frame starts from the garment skinned to the body's pose. Medians over the frames of wall-clock time between two waits
for the device, ways taking turns frame by frame. ``launches`` counts the calls of the CUDA runtime that start something
(kernels, copies, graphs), ``kernels`` what ran on the device. Rows ``fused`` are ``captured`` with the edge step in Triton,
all others without it; they are left out where Triton is not installed.

Without a GPU nothing of that is measured. What can be is printed instead: CPU time of the plain step and of the one of fixed
shapes, how many places its body edges leave empty, and the operations of the traced step, before and after those that
depend on no input have been folded: about the kernels that a GPU would be given.
"""

from __future__ import annotations

import argparse
import copy
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec

import torch
from frame import refined
from torch._subclasses.fake_tensor import FakeTensorMode

from hood.assets.body import load_body
from hood.assets.garment import load_garment
from hood.assets.material import Material
from hood.assets.sequence import load_sequence
from hood.cli import ENVIRONMENT
from hood.dynamics.captured import CapturedSimulator
from hood.dynamics.fixed_problem import step_inputs
from hood.dynamics.fixed_step import FixedStep
from hood.dynamics.simulator import Prepared, Simulator, build_simulator
from hood.dynamics.stepper import Stepper
from hood.dynamics.trace import count_operations, trace
from hood.graph.fixed import Capacity, Layout, lay_out
from hood.losses.problem import StepProblem
from hood.scene.scene import Scene, build_scene, recentre
from hood.testing import without_values

SWITCH = "HOOD_TRITON"
WAYS = ("plain", "fixed", "captured", "compiled", "fused")
FIRST_FRAME = 10
_KERNELS = ("cudaLaunchKernel", "cuLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernelEx")
_LAUNCHES = (*_KERNELS, "cudaMemcpyAsync", "cudaMemsetAsync", "cudaGraphLaunch")


def make_scene(count: int, device: str) -> Scene:
    """The dress of ``count`` vertices on the walking body."""
    garment = refined(load_garment("dress"), count)
    return build_scene(garment, load_body("default"), load_sequence("walk_proud", 30.0), Material(), device=device)


def problems(scene: Scene, count: int) -> list[StepProblem]:
    """The steps of frames from the tenth on, each from the skinned garment."""
    made = []
    for frame in range(FIRST_FRAME, FIRST_FRAME + count):
        state = recentre(scene.start(frame, relaxed=False), scene.cloth.vertex_scene)
        made.append(StepProblem(scene.cloth, state, scene.step_input(frame, state)))
    return made


def take(stepper: Stepper, problem: StepProblem, prepared: Prepared) -> None:
    prediction = stepper.predict(stepper.search(problem), prepared)
    stepper.next_velocity(problem, prediction)


@contextmanager
def edges_fused(on: bool) -> Iterator[None]:
    """Triton for edge steps inside, or not."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = "on" if on else "off"
    try:
        yield
    finally:
        os.environ.pop(SWITCH) if before is None else os.environ.update({SWITCH: before})


def ways_of(names: list[str], simulator: Simulator) -> dict[str, Stepper]:
    steppers: dict[str, Stepper] = {}
    for name in names:
        mode = "captured" if name == "fused" else name
        steppers[name] = simulator if name == "plain" else CapturedSimulator(simulator, mode)
    return steppers


def count_launches(call: Callable[[], None]) -> tuple[int, int]:
    """Calls that start something on the device, and kernels that ran there."""
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        call()
        torch.cuda.synchronize()
    events = profile.events()
    launches = sum(event.name in _LAUNCHES for event in events)
    return launches, sum(event.device_type == torch.autograd.DeviceType.CUDA for event in events)


@torch.no_grad()
def on_gpu(size: int, model: str, precisions: list[str], names: list[str], frames: int) -> None:
    """Print a line per precision and way."""
    scene = make_scene(size, "cuda")
    torch.manual_seed(0)
    simulator = build_simulator(schedule=model).eval().cuda()
    steps = problems(scene, frames + 3)
    prepared = simulator.prepare(steps[0].cloth, scene.garment.rest_pos)
    for precision in precisions:
        simulator.network.use_precision(precision)
        steppers, times = ways_of(names, simulator), {name: [] for name in names}  # type: ignore[var-annotated]
        for problem in steps:
            for name, stepper in steppers.items():
                with edges_fused(name == "fused"):
                    torch.cuda.synchronize()
                    began = time.perf_counter()
                    take(stepper, problem, prepared)
                    torch.cuda.synchronize()
                    times[name].append(1e3 * (time.perf_counter() - began))
        for name, stepper in steppers.items():
            with edges_fused(name == "fused"):
                launches, kernels = count_launches(partial(take, stepper, steps[-1], prepared))
            cells = f"{name} | {statistics.median(times[name][3:]):.2f} | {launches} | {kernels}"
            print(f"| {scene.cloth.num_vertices:,} | {model} | {precision} | {cells} |", flush=True)


@torch.no_grad()
def count_for_gpu(simulator: Simulator, layout: Layout, problem: StepProblem) -> list[int]:
    """Operations of the step as a device other than a CPU is given it, before and after folding."""
    simulator = copy.deepcopy(simulator)
    with FakeTensorMode():
        problem = without_values(problem)
        step = FixedStep(without_values(simulator), without_values(layout), problem)
        return [count_operations(trace(step, step_inputs(problem), fold)) for fold in (False, True)]


@torch.no_grad()
def on_cpu(size: int, model: str, precisions: list[str], frames: int) -> None:
    """Print a line per precision: what fixed shapes cost where they gain nothing."""
    scene = make_scene(size, "cpu")
    torch.manual_seed(0)
    simulator = build_simulator(schedule=model).eval()
    steps = problems(scene, frames + 2)
    prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
    assert prepared.static is not None
    for precision in precisions:
        simulator.network.use_precision(precision)
        fixed = CapturedSimulator(simulator, "fixed")
        times: dict[str, list[float]] = {"plain": [], "fixed": []}
        for problem in steps:
            for name, stepper in (("plain", simulator), ("fixed", fixed)):
                began = time.process_time()
                take(stepper, problem, prepared)
                times[name].append(1e3 * (time.process_time() - began))
        plain, padded = (statistics.median(times[name][2:]) for name in ("plain", "fixed"))
        capacity: Capacity = next(iter(fixed._plans.values())).layout.capacity
        step = FixedStep(simulator, lay_out(prepared.static, capacity), steps[-1], dense=True)
        found = int(step(*step_inputs(steps[-1]))[3][0])
        counts = count_for_gpu(simulator, lay_out(prepared.static, capacity), steps[-1])
        filled = f"{found:,} of {capacity.edges:,}"
        cells = f"{plain:.0f} | {padded:.0f} | {padded / plain:.2f} | {filled} | {counts[0]} | {counts[1]}"
        print(f"| {scene.cloth.num_vertices:,} | {model} | {precision} | {cells} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[5000, 12000, 50000])
    parser.add_argument("--models", nargs="+", default=["fine15", "ours"])
    parser.add_argument("--precision", nargs="+", default=["fp32", "tf32", "bf16"])
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=WAYS)
    parser.add_argument("--frames", type=int, default=21)
    args = parser.parse_args()
    if any(os.environ.get(key) is None for key in ENVIRONMENT):  # read at process start only
        os.execve(sys.executable, [sys.executable, *sys.argv], {**ENVIRONMENT, **os.environ})
    if torch.cuda.is_available():
        ways = [name for name in args.ways if name != "fused" or find_spec("triton") is not None]
        print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}\n")
        print("| vertices | model | precision | way | ms a frame | launches | kernels |\n" + "|---" * 7 + "|")
        for size in args.sizes:
            for model in args.models:
                on_gpu(size, model, args.precision, ways, args.frames)
        return
    torch.set_num_threads(1)
    print("no GPU: milliseconds and launches there are not measured; one thread of the CPU instead\n")
    columns = ("vertices", "model", "precision", "plain ms", "fixed ms", "ratio", "places filled", "operations", "folded")
    print(f"| {' | '.join(columns)} |\n" + "|---" * len(columns) + "|")
    for size in args.sizes:
        for model in args.models:
            on_cpu(size, model, [name for name in args.precision if name != "tf32"], args.frames)


if __name__ == "__main__":
    main()

"""One job of ``benchmarks/gpu.py``, in a process of its own: frames of one method at one size, in every way there is.

    python benchmarks/gpu_frames.py 1000 small-ours fp32    # also bf16, tf32, compiled, or a number of garments at once
    python benchmarks/gpu_frames.py 1000 newton 5           # the solver with five iterations; also compiled
    python benchmarks/gpu_frames.py constants               # of the GPU: bandwidth, rates, gaps between kernels

Prints a line of JSON for every row, with the columns of ``benchmarks/gpu.py``.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch
from frame import refined
from roofline import DATA_SHEETS, Device, Kernel, Work, WorkCounter
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from hood.assets.body.load import load_body
from hood.assets.files.library import locate
from hood.assets.garment.garment import load_garment
from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.cloth.cloth import concatenate_cloths
from hood.cloth.state import State, concatenate_states, concatenate_step_inputs
from hood.contact.contact import find_fixed_contact
from hood.energies.potential import default_potential, scale
from hood.energies.problem import StepProblem
from hood.mesh.closest_point.search import Incidence, build_incidence
from hood.model.graph.static_shapes import lay_out
from hood.scene.scene import Scene, build_scene, recentre
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import in_double
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import NetworkStepper, Prepared
from hood.steppers.newton import NewtonStepper, Stepper
from hood.steppers.static_shapes.cuda_graph import trace
from hood.steppers.static_shapes.newton import CapturedNewton
from hood.steppers.static_shapes.problem import settled_potential, step_inputs
from hood.steppers.static_shapes.simulator import CapturedSimulator, FixedStep, first_capacity
from hood.tensors.dense import has_triton, whole_arrays
from hood.testing import without_values

SWITCH = "HOOD_TRITON"
WAYS = ("plain", "captured", "fused")
COMPILED = "compiled"  # takes a minute or two to make, so it is measured at one size
FIRST_FRAME, LEAD = 10, 3
_LAUNCHES = ("cudaLaunchKernel", "cuLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernelEx",
             "cudaMemcpyAsync", "cudaMemsetAsync", "cudaGraphLaunch")  # fmt: skip
SOLVER = "newton"
Calls = dict[str, Callable[[StepProblem], Tensor]]


@dataclass(frozen=True)
class Row:
    """A line of the table; None where it is not known."""

    vertices: int
    method: str
    precision: str
    way: str
    source: str  # ``measured`` or ``computed``: the time
    ms: float
    floor_ms: float
    kernels: int
    launches: int | None
    megabytes: float | None
    gigabytes: float
    gflop: float
    gamma: float


class Bench:
    """The dress at one size: states of a rollout of the solver, on the CPU and on the device, and their minima."""

    def __init__(self, size: int, device: str, count: int, kept: Path | None = None) -> None:
        garment, sequence = refined(load_garment("dress"), size), load_sequence("walk_proud", 30.0)
        make = partial(build_scene, garment, load_body("default"), sequence, Material())
        self.scene: Scene = make()
        self.there: Scene = self.scene if device == "cpu" else make(device=device)
        self.size, self.potential, self._kept = size, default_potential(), kept
        self.frames = range(FIRST_FRAME + LEAD, FIRST_FRAME + LEAD + count)
        path = None if kept is None else kept / f"{size}.pt"
        if path is not None and path.exists():
            known = torch.load(path, weights_only=True)
            states, self._lowest = [State(*parts) for parts in known["states"]], known["lowest"]
            self.problems = [self._problem(frame, state) for frame, state in zip(self.frames, states, strict=True)]
            return
        self.problems = self._roll()
        self._lowest = [self._minimum(problem) for problem in self.problems]
        if path is not None:
            states = [(problem.state.pos, problem.state.vel, problem.state.origin) for problem in self.problems]
            torch.save({"states": states, "lowest": self._lowest}, path)

    def _problem(self, frame: int, state: State) -> StepProblem:
        return self.potential.prepare(StepProblem(self.scene.cloth, state, self.scene.step_input(frame, state)))

    def _roll(self) -> list[StepProblem]:
        scene, settings, problems = self.scene, NewtonSettings(max_iterations=10), []
        state = recentre(scene.start(FIRST_FRAME, relaxed=False), scene.cloth.vertex_scene)
        for frame in range(FIRST_FRAME, self.frames.stop):
            problem = self._problem(frame, state)
            problems.append(problem)
            pos, report = minimize(self.potential, problem, settings=settings)
            vel = state.vel + problem.vertex_dt * report.acc
            state = recentre(State(pos, vel, state.origin), scene.cloth.vertex_scene)
        return problems[LEAD:]

    def _minimum(self, problem: StepProblem) -> float:
        return float(minimize(self.potential, problem, settings=NewtonSettings(target_rg=1e-3, max_iterations=60))[1].phi)

    def work_of(self, name: str, count: Callable[[], Work]) -> Work:
        """What is counted once for all jobs of a call."""
        path = None if self._kept is None else self._kept / f"{self.size}_{name}.json"
        if path is not None and path.exists():
            return Work([Kernel(**kernel) for kernel in json.loads(path.read_text())])
        work = count()
        if path is not None:
            path.write_text(json.dumps([asdict(kernel) for kernel in work.kernels]))
        return work

    def gamma(self, positions: list[Tensor]) -> float:
        """Median over the states of the gap of positions (V, 3) that steps led to, in their order."""
        gaps = []
        for problem, lowest, pos in zip(self.problems, self._lowest, positions, strict=False):
            work = in_double(problem)
            phi = float(self.potential.total(work, pos.detach().cpu().double()))
            gaps.append((phi - min(lowest, phi)) / float(scale(work)))
        return statistics.median(gaps)

    def on_device(self) -> list[StepProblem]:
        """The same problems, contact not searched for."""
        made = []
        for frame, problem in zip(self.frames, self.problems, strict=True):
            device = self.there.cloth.rest_pos.device
            state = State(problem.state.pos.to(device), problem.state.vel.to(device), problem.state.origin)
            step = self.there.step_input(frame, state)
            made.append(StepProblem(self.there.cloth, state, step, gravity=problem.gravity.to(device)))
        return made


def together(problems: Sequence[StepProblem], count: int) -> StepProblem:
    """Garments of these problems in turn as one problem, contact not searched for."""
    if count == 1:
        return problems[0]
    chosen = [problems[index % len(problems)] for index in range(count)]
    steps = concatenate_step_inputs([one.step for one in chosen], [one.cloth.num_vertices for one in chosen])
    cloth = concatenate_cloths([one.cloth for one in chosen])
    assert len(cloth.scene_sizes) == count  # known from here on, without waiting for the device
    return StepProblem(cloth, concatenate_states([one.state for one in chosen]), steps, gravity=chosen[0].gravity)


def prepare(simulator: NetworkStepper, scene: Scene, problem: StepProblem, count: int) -> Prepared:
    """What a network needs of the cloth of ``count`` garments of a scene."""
    single: Prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
    return single if count == 1 else simulator.concatenate(problem.cloth, [single] * count, [scene.cloth.num_vertices] * count)


# ---- work ------------------------------------------------------------------------------------------------------------


@torch.no_grad()
def network_work(simulator: NetworkStepper, bench: Bench) -> Work:
    """Of a step of fixed shapes as a GPU is given it, what depends on no input computed before; without computing it."""
    problem, simulator = bench.problems[0], copy.deepcopy(simulator)
    simulator.network.use_precision("bf16" if simulator.network.precision == "bf16" else "fp32")
    static = simulator.prepare(problem.cloth, bench.scene.garment.rest_pos).static
    assert static is not None
    capacity = first_capacity(simulator, problem)
    potential = settled_potential(simulator.potential, problem) if simulator.looks_at_potential else None
    inputs, layout = step_inputs(problem, simulator.needs_contact), lay_out(static, capacity)
    with FakeTensorMode():
        step = FixedStep(without_values(simulator), without_values(layout), without_values(problem), potential=potential)
        empty = [without_values(value) for value in inputs]
        module = trace(step, empty)
        with WorkCounter() as counter:
            module(*empty)
    return counter.work


def solver_work(bench: Bench, stepper: Stepper) -> Work:
    """Of a step on one of the states, computed as a GPU does (everything at once), and of the search of all pairs."""
    problem = bench.problems[0]
    obstacle = problem.step.obstacle
    assert obstacle is not None
    stepper.predict(problem, None)  # what is made once per cloth is no part of a frame
    with whole_arrays(), WorkCounter() as counter:
        stepper.predict(problem, None)
    incidence = build_incidence(obstacle.faces, len(obstacle.pos))
    with FakeTensorMode():
        given = problem.state.pos, problem.cloth.vertex_scene
        empty = [without_values(value) for value in (*given, obstacle)]
        tables = Incidence(*(without_values(value) for value in incidence))
        with WorkCounter() as search:
            find_fixed_contact(*empty, tables, 1, 0)
    return Work(search.work.kernels + counter.work.kernels)


def solver_settings(iterations: int) -> NewtonSettings:
    return NewtonSettings(target_rg=1e-6, max_iterations=iterations, engine="torch")


def frame_settings(iterations: int = 5) -> NewtonSettings:
    """Of a frame that asks nobody when to stop."""
    return NewtonSettings(target_rg=1e-6, max_iterations=iterations, cg_iterations=75, engine="torch")


# ---- time ------------------------------------------------------------------------------------------------------------


@contextmanager
def edges_fused(on: bool) -> Iterator[None]:
    """Triton for the network's steps inside, or not."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = "on" if on else "off"
    try:
        yield
    finally:
        os.environ.pop(SWITCH) if before is None else os.environ.update({SWITCH: before})


@contextmanager
def in_way(name: str) -> Iterator[None]:
    with edges_fused(name in ("fused", COMPILED)):
        yield


def count_launches(call: Callable[[], object]) -> int:
    """Calls that start something on the device."""
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        call()
        torch.cuda.synchronize()
    return sum(event.name in _LAUNCHES for event in profile.events())


def device_memory(call: Callable[[], object]) -> float:
    """MB that a first call takes beyond what is there, whatever it keeps included."""
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    call()
    torch.cuda.synchronize()
    return 1e-6 * (torch.cuda.max_memory_allocated() - before)


def measured_device(size: int = 8192) -> Device:
    """The GPU at hand: bandwidth by a copy, operations by matrix products of ``size``, gaps between small kernels."""
    source = torch.empty(2**28, device="cuda")
    target = torch.empty_like(source)
    bandwidth = 2 * 4 * source.numel() / _seconds(lambda: target.copy_(source), 20)
    before, rates = torch.backends.cuda.matmul.fp32_precision, {}
    for name in ("fp32", "tf32", "bf16"):
        torch.backends.cuda.matmul.fp32_precision = "tf32" if name == "tf32" else "ieee"
        square = torch.randn(size, size, device="cuda", dtype=torch.bfloat16 if name == "bf16" else torch.float32)
        rates[name] = 2 * size**3 / _seconds(partial(torch.mm, square, square), 10)
    torch.backends.cuda.matmul.fp32_precision = before
    small, graph = torch.zeros(1024, device="cuda"), torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        for _ in range(200):
            small.add_(1.0)
    launch, replay = _seconds(lambda: small.add_(1.0), 2000), _seconds(graph.replay, 20) / 200
    return Device(torch.cuda.get_device_name(), bandwidth, rates, rates["fp32"], launch, replay)


def _seconds(call: Callable[[], object], count: int) -> float:
    """Of one call among many on the device."""
    for _ in range(3):
        call()
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    for _ in range(count):
        call()
    end.record()
    torch.cuda.synchronize()
    return 1e-3 * start.elapsed_time(end) / count


def time_ways(calls: Calls, problems: list[StepProblem]) -> dict[str, list[float]]:
    """Milliseconds of every way on every state, three times over; the first round counts for nothing."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for round_number in range(4):
        for problem in problems:
            for name, call in calls.items():
                with in_way(name):
                    torch.cuda.synchronize()
                    began = time.perf_counter()
                    call(problem)
                    torch.cuda.synchronize()
                    if round_number:
                        times[name].append(1e3 * (time.perf_counter() - began))
    return times


# ---- rows ------------------------------------------------------------------------------------------------------------


@torch.no_grad()
def network_rows(
    bench: Bench, model: str, precision: str, device: Device, on_gpu: bool, ways: Sequence[str] = WAYS, count: int = 1
) -> Iterator[Row]:
    simulator = load_simulator(locate("weights", model)).eval()
    simulator.network.use_precision("fp32" if not on_gpu and precision == "tf32" else precision)
    work = bench.work_of(f"{model}_{'bf16' if precision == 'bf16' else 'fp32'}", lambda: network_work(simulator, bench))
    work = Work([replace(one, bytes_moved=count * one.bytes_moved, flops=count * one.flops) for one in work.kernels])
    problems = bench.on_device() if count == 1 else [together(bench.on_device(), count)]
    if on_gpu:
        simulator = simulator.to("cuda")
    prepared = prepare(simulator, bench.there, problems[0], count)
    ways = [way for way in ways if way in ("plain", "captured") or (on_gpu and find_spec("triton") is not None)]
    steppers: dict[str, Stepper] = {
        way: simulator if way == "plain" else CapturedSimulator(simulator, _mode(way, on_gpu)) for way in ways
    }
    calls: Calls = {way: partial(_step, stepper, prepared) for way, stepper in steppers.items()}
    frame = f"{model} × {count}" if count > 1 else model
    yield from rows_of(bench, frame, precision, calls, problems, {way: work for way in ways}, device, on_gpu)


def rows_of(
    bench: Bench,
    method: str,
    precision: str,
    calls: Calls,
    problems: list[StepProblem],
    works: dict[str, Work],
    device: Device,
    on_gpu: bool,
) -> Iterator[Row]:
    """A row for every way."""
    memory = {}
    for way, call in calls.items():
        with in_way(way):
            memory[way] = device_memory(partial(call, problems[0])) if on_gpu else None
    times = time_ways(calls, problems) if on_gpu else {}
    size = bench.scene.cloth.num_vertices
    for way, call in calls.items():
        with in_way(way):
            launches = count_launches(partial(call, problems[0])) if on_gpu else None
            reached = [pos for problem in problems for pos in call(problem).split(size)]
        work, floor = works[way], 1e3 * device.seconds(works[way], precision.replace("fp64", "fp32"), way != "plain")
        source, ms = ("measured", statistics.median(times[way])) if times else ("computed", floor)
        moved = 1e-9 * work.bytes_moved, 1e-9 * work.flops
        yield Row(
            size,
            method,
            precision,
            way,
            source,
            ms,
            floor,
            len(work.kernels),
            launches,
            memory[way],
            *moved,
            bench.gamma(reached),
        )


def _mode(way: str, on_gpu: bool) -> str:
    return ("compiled" if way == COMPILED else "captured") if on_gpu else "fixed"


def _step(stepper: Stepper, prepared: Prepared | None, problem: StepProblem) -> Tensor:
    prediction = stepper.predict(stepper.search(problem), prepared)
    stepper.next_velocity(problem, prediction)
    return prediction.next_pos


def solver_rows(bench: Bench, iterations: int, device: Device, on_gpu: bool) -> Iterator[Row]:
    settings = solver_settings(iterations)
    plain, there = NewtonStepper(bench.potential, settings), NewtonStepper(bench.potential, settings)
    works = {
        way: bench.work_of(f"{SOLVER}_{iterations}_{way}", partial(solver_work, bench, stepper))
        for way, stepper in (("plain", plain), ("captured", CapturedNewton(plain, "fixed")))
    }
    there.gravity = there.gravity.to(bench.there.cloth.rest_pos.device)
    steppers: dict[str, Stepper] = {"plain": there}
    if on_gpu:
        steppers["captured"] = CapturedNewton(there, "captured")
    else:  # the compiled form takes the same iterations
        steppers = dict.fromkeys(works, NewtonStepper(bench.potential, replace(settings, engine="auto")))
    calls: Calls = {way: partial(_step, stepper, None) for way, stepper in steppers.items()}
    yield from rows_of(bench, f"{SOLVER} {iterations}", "fp64", calls, bench.on_device(), works, device, on_gpu)


@torch.no_grad()
def solver_frame_rows(bench: Bench, iterations: int, device: Device) -> Iterator[Row]:
    """Of the whole step as one function, beside the plain one; on a GPU with Triton."""
    if not has_triton(bench.there.cloth.rest_pos.device):
        return
    settings = frame_settings(iterations)
    there = NewtonStepper(bench.potential, settings)
    there.gravity = there.gravity.to(bench.there.cloth.rest_pos.device)
    work = solver_work(bench, NewtonStepper(bench.potential, settings))
    calls: Calls = {"plain": partial(_step, there, None), COMPILED: partial(_step, CapturedNewton(there, COMPILED), None)}
    yield from rows_of(
        bench, f"{SOLVER} {iterations}", "fp64", calls, bench.on_device(), dict.fromkeys(calls, work), device, True
    )


def rows_of_job(size: int, method: str, choice: str, device: Device, on_gpu: bool, kept: Path | None) -> Iterator[Row]:
    """The rows of a job: a network and a precision, a number of garments, or ``compiled``; the solver and iterations."""
    if choice == COMPILED and not on_gpu:
        raise SystemExit("compiled frames are measured on a GPU; benchmarks/compiled_kernels.py counts their kernels without")
    bench = Bench(size, "cuda" if on_gpu else "cpu", 1 if size > 20000 else 3, kept)
    if method == SOLVER:
        yield from (
            solver_frame_rows(bench, 5, device) if choice == COMPILED else solver_rows(bench, int(choice), device, on_gpu)
        )
    elif choice == COMPILED:
        yield from network_rows(bench, method, "fp32", device, on_gpu, ("plain", COMPILED))
    elif choice.isdigit():
        yield from network_rows(bench, method, "fp32", device, on_gpu, count=int(choice))
    else:
        yield from network_rows(bench, method, choice, device, on_gpu)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("job", nargs="+", help="SIZE METHOD CHOICE, or constants")
    parser.add_argument("--device", help="the constants, as this command printed them; default: of an H100's data sheet")
    parser.add_argument("--kept", type=Path, default=None, help="folder for what jobs share")
    args = parser.parse_args()
    torch.set_num_threads(1)
    on_gpu = torch.cuda.is_available()
    if args.job == ["constants"]:
        print(json.dumps(asdict(measured_device()) if on_gpu else None))
        return
    if len(args.job) != 3:
        parser.error("give SIZE METHOD CHOICE, or constants")
    size, method, choice = args.job
    device = DATA_SHEETS["h100"] if args.device is None else Device(**json.loads(args.device))
    for row in rows_of_job(int(size), method, choice, device, on_gpu, args.kept):
        print(json.dumps(asdict(row)), flush=True)


if __name__ == "__main__":
    main()

"""All that is to be known about frames on one GPU, in one call of ten minutes: networks and solver at 1k to 50k vertices.

    python benchmarks/gpu.py --minutes 9 --csv gpu.csv
    python benchmarks/gpu.py --device-specs h100            # without a GPU: computed, from that one's data sheet

The embedded dress, refined to the given number of vertices, on the embedded body of 6,890 vertices, walking. States are those
of a rollout of the solver. Rows come in the order of their importance, each printed and written to the CSV file at once, until
the minutes are over; what was left out is said at the end. Columns:

``way``       of a network: ``plain``; ``captured``: fixed shapes, one CUDA graph; ``fused``: the same with the network's
              steps in Triton; ``compiled``: that by torch.compile. Of the solver, with so many Newton iterations: ``plain``;
              ``captured``: a graph for each of its pieces; ``compiled``: all of them one function through torch.compile.
``ms``        of a frame, search included, metrics not: median of wall-clock time between two waits for the device, ways taking
              turns state by state.
``floor ms``  what the frame's kernels take at least, one after the other: for each the longest of the gap between two kernels,
              its bytes over the bandwidth, its operations over their rate (``benchmarks/roofline.py``). On a
              GPU all of these constants are measured first, in this very run; else they are those of ``--device-specs``.
``share``     floor / ms: how near the frame is to the roofline.
``kernels``   of the traced frame, views not counted; of fused and compiled rows those before fusion.
``launches``  calls of the CUDA runtime that start something.
``gamma``     median gap of the step's positions to the minimum of the potential, see :mod:`hood.evaluation.gap`.

Without a GPU everything but kernels, bytes, operations and gamma is computed, and marked so: ``ms`` is the floor then.
"""

from __future__ import annotations

import argparse
import copy
import csv
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch
from frame import refined
from roofline import DATA_SHEETS, Device, Work, WorkCounter
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from hood.assets.body.load import load_body
from hood.assets.files.library import locate
from hood.assets.garment.garment import load_garment
from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.cli.main import ENVIRONMENT
from hood.cloth.state import State
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
from hood.tensors.dense import whole_arrays
from hood.tensors.precision import has_triton
from hood.testing import without_values

SWITCH = "HOOD_TRITON"
WAYS = ("plain", "captured", "fused")
COMPILED = "compiled"  # takes a minute or two to make, so it is measured at one size
FIRST_FRAME, LEAD = 10, 3
ITERATIONS = (1, 2, 5, 10)
_LAUNCHES = ("cudaLaunchKernel", "cuLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernelEx",
             "cudaMemcpyAsync", "cudaMemsetAsync", "cudaGraphLaunch")  # fmt: skip
SOLVER = "newton"


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
    gigabytes: float
    gflop: float
    gamma: float

    def cells(self) -> list[str]:
        share, rate = self.floor_ms / self.ms, f"{1e3 * self.gigabytes / self.ms:,.0f}"
        launches = "–" if self.launches is None else f"{self.launches:,}"
        return [f"{self.vertices:,}", self.method, self.precision, self.way, self.source, f"{self.ms:.2f}",
                f"{self.floor_ms:.2f}", f"{share:.2f}", f"{self.kernels:,}", launches, f"{self.gigabytes:.2f}",
                f"{self.gflop:.1f}", rate, f"{1e3 * self.gflop / self.ms:,.0f}", f"{self.gamma:.2g}"]  # fmt: skip


COLUMNS = ("vertices", "method", "precision", "way", "time is", "ms", "floor ms", "share", "kernels", "launches", "GB", "GFLOP",
           "GB/s", "GFLOP/s", "gamma")  # fmt: skip


class Table:
    """Rows as they come: on the screen, and in a file that is whole at any moment."""

    def __init__(self, path: Path | None) -> None:
        self.path, self.rows = path, list[Row]()
        print(f"| {' | '.join(COLUMNS)} |\n" + "|---" * len(COLUMNS) + "|", flush=True)

    def add(self, row: Row) -> None:
        self.rows.append(row)
        print(f"| {' | '.join(row.cells())} |", flush=True)
        if self.path is not None:
            temporary = self.path.with_name(self.path.name + ".partial")
            with temporary.open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, list(asdict(row)))
                writer.writeheader()
                writer.writerows(map(asdict, self.rows))
            os.replace(temporary, self.path)


class Bench:
    """The dress at one size: states of a rollout of the solver, on the CPU and on the device, and their minima."""

    def __init__(self, size: int, device: str, count: int) -> None:
        garment, sequence = refined(load_garment("dress"), size), load_sequence("walk_proud", 30.0)
        make = partial(build_scene, garment, load_body("default"), sequence, Material())
        self.scene: Scene = make()
        self.there: Scene = self.scene if device == "cpu" else make(device=device)
        self.potential = default_potential()
        self.problems, self.frames = self._roll(count), range(FIRST_FRAME + LEAD, FIRST_FRAME + LEAD + count)
        self._lowest = [self._minimum(problem) for problem in self.problems]
        self._work: dict[tuple[str, bool], Work] = {}

    def _roll(self, count: int) -> list[StepProblem]:
        scene, settings = self.scene, NewtonSettings(max_iterations=10)
        state, problems = recentre(scene.start(FIRST_FRAME, relaxed=False), scene.cloth.vertex_scene), []
        for frame in range(FIRST_FRAME, FIRST_FRAME + LEAD + count):
            problem = self.potential.prepare(StepProblem(scene.cloth, state, scene.step_input(frame, state)))
            problems.append(problem)
            pos, report = minimize(self.potential, problem, settings=settings)
            vel = state.vel + problem.vertex_dt * report.acc
            state = recentre(State(pos, vel, state.origin), scene.cloth.vertex_scene)
        return problems[LEAD:]

    def _minimum(self, problem: StepProblem) -> float:
        return float(minimize(self.potential, problem, settings=NewtonSettings(target_rg=1e-3, max_iterations=60))[1].phi)

    def work_of(self, model: str, simulator: NetworkStepper, precision: str) -> Work:
        """Of a frame of a model on a CPU; the same in fp32 and tf32."""
        key = model, precision == "bf16"
        if key not in self._work:
            self._work[key] = network_work(simulator, self)
        return self._work[key]

    def gamma(self, positions: list[Tensor]) -> float:
        """Median over the states of the gap of positions (V, 3) that steps led to."""
        gaps = []
        for problem, lowest, pos in zip(self.problems, self._lowest, positions, strict=True):
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


def time_ways(calls: dict[str, Callable[[StepProblem], Tensor]], problems: list[StepProblem]) -> dict[str, list[float]]:
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
    table: Table, bench: Bench, model: str, precision: str, device: Device, on_gpu: bool, ways: Sequence[str] = WAYS
) -> None:
    simulator = load_simulator(locate("weights", model)).eval()
    simulator.network.use_precision("fp32" if not on_gpu and precision == "tf32" else precision)
    work, problems = bench.work_of(model, simulator, precision), bench.on_device()
    if on_gpu:
        simulator = simulator.to("cuda")
    prepared: Prepared = simulator.prepare(bench.there.cloth, bench.scene.garment.rest_pos)
    ways = [way for way in ways if way in ("plain", "captured") or (on_gpu and find_spec("triton") is not None)]
    steppers: dict[str, Stepper] = {
        way: simulator if way == "plain" else CapturedSimulator(simulator, _mode(way, on_gpu)) for way in ways
    }
    calls = {way: partial(_step, stepper, prepared) for way, stepper in steppers.items()}
    times = time_ways(calls, problems) if on_gpu else {}
    for way, call in calls.items():
        with in_way(way):
            launches = count_launches(partial(call, problems[0])) if on_gpu else None
            gamma = bench.gamma([call(problem) for problem in problems])
        floor = 1e3 * device.seconds(work, precision, captured=way != "plain")
        table.add(_row(bench, model, precision, way, work, floor, times.get(way), launches, gamma))


def _mode(way: str, on_gpu: bool) -> str:
    return ("compiled" if way == COMPILED else "captured") if on_gpu else "fixed"


def _step(stepper: Stepper, prepared: Prepared | None, problem: StepProblem) -> Tensor:
    prediction = stepper.predict(stepper.search(problem), prepared)
    stepper.next_velocity(problem, prediction)
    return prediction.next_pos


def solver_rows(table: Table, bench: Bench, iterations: int, device: Device, on_gpu: bool) -> None:
    settings, problems = solver_settings(iterations), bench.on_device()
    plain = NewtonStepper(bench.potential, settings)
    works = {"plain": solver_work(bench, plain), "captured": solver_work(bench, CapturedNewton(plain, "fixed"))}
    there = NewtonStepper(bench.potential, settings)
    there.gravity = there.gravity.to(bench.there.cloth.rest_pos.device)
    steppers: dict[str, Stepper] = {"plain": there, "captured": CapturedNewton(there, "captured" if on_gpu else "fixed")}
    calls = {way: partial(_step, stepper, None) for way, stepper in steppers.items()}
    times = time_ways(calls, problems) if on_gpu else {}
    # The compiled form takes the same iterations on the CPU.
    fast = replace(settings, engine="auto")
    gamma = bench.gamma([minimize(bench.potential, problem, settings=fast)[0] for problem in bench.problems])
    for way, call in calls.items():
        launches = count_launches(partial(call, problems[0])) if on_gpu else None
        floor = 1e3 * device.seconds(works[way], captured=way == "captured")
        table.add(_row(bench, f"{SOLVER} {iterations}", "fp64", way, works[way], floor, times.get(way), launches, gamma))


@torch.no_grad()
def solver_frame_row(table: Table, bench: Bench, iterations: int, device: Device) -> None:
    """Of the whole step as one function, beside the plain one; on a GPU with Triton."""
    if not has_triton(bench.there.cloth.rest_pos.device):
        return
    settings, problems = frame_settings(iterations), bench.on_device()
    there = NewtonStepper(bench.potential, settings)
    there.gravity = there.gravity.to(bench.there.cloth.rest_pos.device)
    work = solver_work(bench, NewtonStepper(bench.potential, settings))
    calls = {"plain": partial(_step, there, None), COMPILED: partial(_step, CapturedNewton(there, COMPILED), None)}
    times = time_ways(calls, problems)
    for way, call in calls.items():
        launches, gamma = count_launches(partial(call, problems[0])), bench.gamma([call(problem) for problem in problems])
        floor = 1e3 * device.seconds(work, captured=way == COMPILED)
        table.add(_row(bench, f"{SOLVER} {iterations}", "fp64", way, work, floor, times.get(way), launches, gamma))


def _row(
    bench: Bench,
    method: str,
    precision: str,
    way: str,
    work: Work,
    floor: float,
    times: list[float] | None,
    launches: int | None,
    gamma: float,
) -> Row:
    source, ms = ("computed", floor) if times is None else ("measured", statistics.median(times))
    size, kernels = bench.scene.cloth.num_vertices, len(work.kernels)
    return Row(
        size, method, precision, way, source, ms, floor, kernels, launches, 1e-9 * work.bytes_moved, 1e-9 * work.flops, gamma
    )


def crossover(rows: list[Row]) -> list[str]:
    """At every size, the fastest network against the solver with no larger gap."""
    sentences = []
    for size in sorted({row.vertices for row in rows}):
        own = [row for row in rows if row.vertices == size]
        networks = [row for row in own if not row.method.startswith(SOLVER)]
        if not networks:
            continue
        best = min(networks, key=lambda row: row.ms)
        as_good = [row for row in own if row.method.startswith(SOLVER) and row.gamma <= best.gamma]
        said = f"{size:,} vertices: {best.method} ({best.precision}, {best.way}) {best.ms:.2f} ms at gamma {best.gamma:.2g}"
        if as_good:
            rival = min(as_good, key=lambda row: row.ms)
            said += f"; {rival.method} {rival.ms:.2f} ms at gamma {rival.gamma:.2g}"
            said += ": the solver wins" if rival.ms < best.ms else ": the network wins"
        elif any(row.method.startswith(SOLVER) for row in own):
            said += "; no row of the solver is as near to the minimum"
        else:
            said += "; no row of the solver"
        sentences.append(said)
    return sentences


def jobs(sizes: list[int], models: list[str]) -> list[tuple[int, str, str | int]]:
    """Size, kind (model or solver), precision or iterations; what matters most comes first."""
    first: list[tuple[int, str, str | int]] = []
    for size in sizes:
        first += [(size, models[0], "fp32"), (size, SOLVER, 5)]
    first += [(sizes[0], model, COMPILED) for model in (*models[:2], SOLVER)]
    rest: list[tuple[int, str, str | int]] = []
    for size in sizes:
        rest += [(size, model, "fp32") for model in models[1:]]
        rest += [(size, SOLVER, count) for count in ITERATIONS if count != 5]
    last = [(size, model, precision) for size in sizes for model in models for precision in ("bf16", "tf32")]
    return first + rest + last


def run(args: argparse.Namespace, on_gpu: bool) -> None:
    began = time.perf_counter()
    device = measured_device() if on_gpu else DATA_SHEETS[args.device_specs]
    rates = ", ".join(f"{name} {1e-12 * rate:.0f} TFLOP/s" for name, rate in device.matmul.items())
    origin = "measured" if on_gpu else "data sheet and assumptions; all times below are computed"
    gaps = f"{1e6 * device.launch:.1f} µs from kernel to kernel, {1e6 * device.replay:.1f} µs within a graph"
    print(f"{device.name} ({origin}): {1e-12 * device.bandwidth:.2f} TB/s, {rates}, {gaps}; torch {torch.__version__}\n")
    table, benches, left = Table(args.csv), dict[int, Bench](), []
    for size, kind, choice in jobs(args.sizes, args.models):
        if time.perf_counter() - began > 60 * args.minutes:
            left.append(f"{kind} {choice} at {size:,}")
            continue
        if size not in benches:
            benches[size] = Bench(size, "cuda" if on_gpu else "cpu", 1 if size > 20000 else 3)
        if choice == COMPILED and not on_gpu:
            continue
        if kind == SOLVER and choice == COMPILED:
            solver_frame_row(table, benches[size], 5, device)
        elif kind == SOLVER:
            solver_rows(table, benches[size], int(choice), device, on_gpu)
        elif choice == COMPILED:
            network_rows(table, benches[size], kind, "fp32", device, on_gpu, ("plain", COMPILED))
        else:
            network_rows(table, benches[size], kind, str(choice), device, on_gpu)
    print("\n" + "\n".join(crossover(table.rows)))
    if left:
        print(f"\nleft out after {args.minutes:g} minutes: {', '.join(left)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=9.0)
    parser.add_argument("--sizes", type=int, nargs="+", default=[4400, 1000, 12000, 50000])
    parser.add_argument("--models", nargs="+", default=["quickstart", "small-ours", "small-fine15"], help="embedded weights")
    parser.add_argument("--device-specs", choices=sorted(DATA_SHEETS), default="h100", help="computed for it without a GPU")
    parser.add_argument("--csv", type=Path, default=None)
    args = parser.parse_args()
    if any(os.environ.get(key) is None for key in ENVIRONMENT):  # read at process start only
        os.execve(sys.executable, [sys.executable, *sys.argv], {**ENVIRONMENT, **os.environ})
    if not torch.cuda.is_available():
        torch.set_num_threads(1)
    run(args, torch.cuda.is_available())


if __name__ == "__main__":
    main()

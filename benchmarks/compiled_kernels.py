"""The kernels of a frame that torch.compile makes, counted without a GPU: of ``step=compiled`` with the Triton kernels in it.

    python benchmarks/compiled_kernels.py small-ours 1000          # a model by name, vertices of the dress
    python benchmarks/compiled_kernels.py quickstart 1000 bf16     # the network in bfloat16
    python benchmarks/compiled_kernels.py newton 12000             # the solver, five iterations

The compiler's scheduler decides on a CPU what is one kernel, and nothing is generated or run. A GPU's scheduler decides alike,
but for concatenations: it makes one kernel of up to eight arrays, and so does it here. Printed are the operations of the traced
frame, the kernels by kind, their sum, the bytes that they read and write, and the time of an H100 by these counts
(benchmarks/roofline.py). Operators of our own count as the kernels that they have; arrays whose rows they gather are read once,
from then on they are in the cache, and all of their matrices meet as many rows as their largest array has. Of arrays that the
edge sets of a step share, a set's kernels read and write the columns, and the rows, that are theirs.
"""

from __future__ import annotations

import math
import os
import sys
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import torch
from gpu_frames import SOLVER, Bench, frame_settings
from roofline import DATA_SHEETS

from hood.assets.files.library import locate
from hood.model.graph.static_shapes import lay_out
from hood.model.kernels.triton_step import tile_of
from hood.solver.system.iterate import in_double
from hood.solver.system.plan import plan_for
from hood.steppers.checkpoint import load_simulator
from hood.steppers.static_shapes.cuda_graph import count_operations, trace
from hood.steppers.static_shapes.newton_pieces import NewtonFrame
from hood.steppers.static_shapes.problem import settled_potential, step_inputs
from hood.steppers.static_shapes.simulator import FixedStep, first_capacity
from hood.tensors.dense import assumed, whole_arrays

#: Kernels of an operator that has not one, and how often they read and write what the operator is given.
STEPS = frame_settings().cg_iterations
STEP_EDGES = "torch.ops.hood.step_edges.default"
KERNELS = {STEP_EDGES: (2, 1), "torch.ops.hood.block_cg.default": (1 + 2 * STEPS, STEPS)}
#: Operations on a pair of a point and a vertex in the search for the nearest ones.
PAIR = 20
#: No matrix of a network has more rows or columns.
WIDEST = 512
#: Places for body faces.
PLACES = 64
#: Nodes of the schedule that start nothing.
NOTHING = ("MultiOutput",)


class _Counted(Exception):
    """There is nothing left to know."""


@dataclass
class Frame:
    """What a frame asks of a GPU."""

    kernels: Counter[str] = field(default_factory=Counter)  # by kind; those that the compiler writes itself are ``fused``
    moved: Counter[str] = field(default_factory=Counter)  # bytes by kind
    seconds: float = 0.0  # of an H100
    precision: str = "fp32"

    def add(self, node: Any) -> None:
        kind, device = type(node).__name__, DATA_SHEETS["h100"]
        if kind == "NopKernelSchedulerNode":
            return
        name = "fused"
        if kind == "ExternKernelSchedulerNode":
            name = str(getattr(node.node, "python_kernel_name", None) or type(node.node).__name__)
        if name in NOTHING:
            return
        number, times = KERNELS.get(name, (1, 1))
        moved = edges_of_a_step(node.node) if name == STEP_EDGES else int(node.get_read_write_buffers_sizes()) * times
        own = name.startswith("torch.ops.hood.") and times == 1
        work, rate = matrices(node.node) if own else int(node.estimate_flops() or 0), device.matmul[self.precision]
        if name == "torch.ops.hood.nearest_three.default":
            work, rate = pairs(node.node), device.arithmetic
        self.kernels[name] += number
        self.moved[name] += moved
        self.seconds += max(number * device.replay, moved / device.bandwidth, work / rate)


def matrices(operator: Any) -> int:
    """Floating-point operations of an operator's matrices, as if all of them met every row of its largest array."""
    shapes = [tuple(int(size) for size in given.get_size()) for given in operator.inputs]
    weights = sum(math.prod(shape) for shape in shapes if len(shape) == 2 and max(shape) <= WIDEST)
    return 2 * max(shape[0] for shape in shapes if shape) * weights


def edges_of_a_step(operator: Any) -> int:
    """Bytes of :func:`hood.model.kernels.triton_step.step_edges`."""
    latent, tables, received, receivers, *others = operator.inputs
    one, (_, width) = latent.get_dtype().itemsize, latent.get_size()
    (edges,), (nodes, _) = receivers.get_size(), tables.get_size()
    assert list(received.get_size()) == [nodes, width]
    values = 2 * edges * width + 2 * nodes * width + nodes * width  # latents in and out, two columns of the tables, the sums
    borders = 2 * 2 * -(-edges // tile_of(width, latent.get_dtype())) * width * torch.float32.itemsize  # written and read
    return int(borders + one * values + sum(math.prod(x.get_size()) * x.get_dtype().itemsize for x in (receivers, *others)))


def pairs(search: Any) -> int:
    """Operations of a search for nearest vertices: every pair of a point and a vertex."""
    points, _, vertices, *_ = (math.prod(int(size) for size in given.get_size()) // 3 for given in search.inputs)
    return PAIR * points * vertices


def schedule(module: torch.fx.GraphModule, inputs: list[torch.Tensor], precision: str = "fp32") -> Frame:
    """What the compiler makes of a traced frame."""
    from torch._inductor.scheduler import Scheduler

    found = Frame(precision=precision)

    def count(self: Any) -> None:
        for node in self.nodes:
            found.add(node)
        raise _Counted

    Scheduler.codegen = count  # type: ignore[method-assign]
    _concatenate_as_on_a_gpu()
    try:
        torch.compile(module, fullgraph=True, dynamic=False)(*inputs)
    except Exception as error:
        if not found.kernels:
            raise RuntimeError("the compiler did not come as far as its schedule") from error
    return found


def _concatenate_as_on_a_gpu() -> None:
    from torch._inductor import config, lowering

    plain = lowering.lowerings[torch.ops.aten.cat.default]

    def concatenate(inputs: Any, dim: int = 0) -> Any:
        with config.patch(force_pointwise_cat=len(inputs) <= config.max_pointwise_cat_inputs):
            return plain(inputs, dim)

    lowering.lowerings |= {name: concatenate for name, value in lowering.lowerings.items() if value is plain}


@torch.no_grad()
def main(model: str, size: int, precision: str = "fp32") -> None:
    torch.set_num_threads(1)
    bench = Bench(size, "cpu", 1)
    function, inputs = newton_frame(bench) if model == SOLVER else network_frame(bench, model, precision)
    with assumed():
        module = trace(function, inputs)
        frame = schedule(module, inputs, precision)
    kernels = frame.kernels
    print(
        f"{model}, {size:,} vertices, {precision}: {count_operations(module):,} operations, {sum(kernels.values()):,} kernels"
    )
    print(f"{sum(frame.moved.values()) / 1e9:.2f} GB, {1e3 * frame.seconds:.2f} ms on an H100 (computed)")
    for name, number in kernels.most_common():
        print(f"{number:6,}  {frame.moved[name] / 1e9:6.2f} GB  {name}")


def newton_frame(bench: Bench) -> tuple[Any, list[torch.Tensor]]:
    problem = bench.problems[0]
    like, inputs = problem.with_fold(), step_inputs(problem, surface=True)
    potential = settled_potential(bench.potential, problem)
    given = potential, like, plan_for(in_double(like)), PLACES, frame_settings()
    with whole_arrays():
        NewtonFrame(*given)(*inputs)  # what is made once per cloth is no part of a frame
    return NewtonFrame(*given, dense=True), inputs


def network_frame(bench: Bench, model: str, precision: str) -> tuple[Any, list[torch.Tensor]]:
    problem, simulator = bench.problems[0], load_simulator(locate("weights", model)).eval()
    simulator.network.use_precision(precision)
    static = simulator.prepare(problem.cloth, bench.scene.garment.rest_pos).static
    assert static is not None
    potential = settled_potential(simulator.potential, problem) if simulator.looks_at_potential else None
    layout = lay_out(static, first_capacity(simulator, problem))
    inputs = step_inputs(problem, simulator.needs_contact)
    return FixedStep(simulator, layout, problem, dense=True, potential=potential), inputs


if __name__ == "__main__":
    os.environ["TORCHINDUCTOR_FORCE_DISABLE_CACHES"] = "1"
    main(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])

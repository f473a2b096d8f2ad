"""The kernels of a frame that torch.compile makes, counted without a GPU: of ``step=compiled`` with the Triton kernels in it.

    python benchmarks/compiled_kernels.py small-ours 1000          # a model by name, vertices of the dress
    python benchmarks/compiled_kernels.py quickstart 1000

The compiler's scheduler decides on a CPU what is one kernel, and nothing is generated or run. A GPU's scheduler decides alike,
but joins concatenations of up to eight arrays, which it counts one by one here. Printed are the operations of the traced frame,
the kernels by kind, and their sum; an edge set of a step counts as the two kernels that it has.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from typing import Any

import torch
from gpu import Bench

from hood.assets.files.library import locate
from hood.model.graph.static_shapes import lay_out
from hood.steppers.checkpoint import load_simulator
from hood.steppers.static_shapes.cuda_graph import count_operations, trace
from hood.steppers.static_shapes.problem import settled_potential, step_inputs
from hood.steppers.static_shapes.simulator import CapturedSimulator, FixedStep
from hood.tensors.triton_device import assumed

#: Kernels of an operator that has not one.
KERNELS = {"torch.ops.hood.step_edges.default": 2}
#: Nodes of the schedule that start nothing.
NOTHING = ("MultiOutput",)


class _Counted(Exception):
    """There is nothing left to know."""


def schedule(module: torch.fx.GraphModule, inputs: list[torch.Tensor]) -> Counter[str]:
    """Kernels by kind; those that the compiler writes itself are ``fused``."""
    from torch._inductor.scheduler import Scheduler

    found: Counter[str] = Counter()

    def count(self: Any) -> None:
        for node in self.nodes:
            kind = type(node).__name__
            if kind == "ExternKernelSchedulerNode":
                found[str(getattr(node.node, "python_kernel_name", None) or type(node.node).__name__)] += 1
            elif kind != "NopKernelSchedulerNode":
                found["fused"] += 1
        raise _Counted

    Scheduler.codegen = count  # type: ignore[method-assign]
    try:
        torch.compile(module, fullgraph=True, dynamic=False)(*inputs)
    except Exception as error:
        if not found:
            raise RuntimeError("the compiler did not come as far as its schedule") from error
    for name in NOTHING:
        found.pop(name, None)
    return Counter({name: number * KERNELS.get(name, 1) for name, number in found.items()})


@torch.no_grad()
def main(model: str, size: int) -> None:
    torch.set_num_threads(1)
    bench, simulator = Bench(size, "cpu", 1), load_simulator(locate("weights", model)).eval()
    problem = bench.problems[0]
    static = simulator.prepare(problem.cloth, bench.scene.garment.rest_pos).static
    assert static is not None
    potential = settled_potential(simulator.potential, problem) if simulator.looks_at_potential else None
    layout = lay_out(static, CapturedSimulator(simulator, "fixed")._first_capacity(problem))
    inputs = step_inputs(problem, simulator.needs_contact)
    with assumed():
        module = trace(FixedStep(simulator, layout, problem, dense=True, potential=potential), inputs)
        kernels = schedule(module, inputs)
    print(f"{model}, {size:,} vertices: {count_operations(module):,} operations, {sum(kernels.values()):,} kernels")
    for name, number in kernels.most_common():
        print(f"{number:6,}  {name}")


if __name__ == "__main__":
    os.environ["TORCHINDUCTOR_FORCE_DISABLE_CACHES"] = "1"
    main(sys.argv[1], int(sys.argv[2]))

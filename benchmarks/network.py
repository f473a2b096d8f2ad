"""Time and memory of the network against the same function written naively: one alternating run.

    python benchmarks/network.py --sizes 1000 5000 --models fine15 ours
    python benchmarks/network.py --sizes 5000 --models fine15 --pyg
    python benchmarks/network.py --sizes 5041 --models fine15 ours --compiled

The garment is a square sheet with diagonals, two fifths of its vertices touch a body of 6,890 vertices, weights and
features are random. ``naive`` concatenates both ends and the edge for every edge set, sums with ``index_add`` and runs
the node network on all body vertices, in float32; its output must equal the network's to 1e-5 before anything is timed.
Times are medians of the process's CPU time over runs that take turns, after one warm-up each, so that a busy machine
slows all of them alike. Peak memory is what a fresh process needs on top of weights and inputs (Linux only). GFLOP/s count the
products the network itself computes, against a (1024, 128) × (128, 128) product in the same precision, by the
faster of the machine's two libraries.

Progress goes to the standard error, rows to the standard output and, with ``--output``, to a CSV file as soon as they are
known. ``--compiled`` adds the network by its compiled kernels, in inference also the fused ones. Where one turn of all forms
lasts longer than ``--long`` seconds three turns are taken instead of ``--rounds``; the column ``turns`` says so. A form that
needs more memory than the machine has is left out with a sentence that says how much: memory grows linearly with the number of
vertices, by the line through two small sizes.
"""

from __future__ import annotations

import argparse
import copy
import csv
import ctypes
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hood.assets.material import Material
from hood.cli.main import ENVIRONMENT
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, StepInput
from hood.contact.contact import Contact
from hood.model.graph.builder import (
    BODY,
    Graph,
    build_graph,
    build_static,
    edge_set_names,
    finest_level,
    parse_schedule,
    set_level,
)
from hood.model.graph.hierarchy import build_hierarchy
from hood.model.network.message_passing import ProcessorStep
from hood.model.network.mlp import MLP
from hood.model.network.model import MeshGraphNet
from hood.tensors.dense import PRECISIONS, affine
from hood.testing import grid, plane_contact

NUM_BODY = 6890
TOUCHED = 1500  # body vertices near the cloth
WIDTHS = {"mesh": 12, "coarse": 12, "body": 9}
LATENT = 128
PROBES = (1089, 2209)  # sizes whose memory tells that of larger ones
FUSED = "fused"  # these kernels are for inference alone
FEW = 3  # turns where one lasts long
COLUMNS = ("pass", "form", "turns", "ms", "vs naive", "MB", "vs naive", "GFLOP/s", "of the product's")


@dataclass
class Case:
    """A network with random features on a graph, and the same for the naive form: all body nodes, edges as listed."""

    network: MeshGraphNet
    graph: Graph
    nodes: Tensor
    edges: dict[str, Tensor]
    all_nodes: Tensor
    listed: dict[str, tuple[Tensor, Tensor, Tensor]]  # senders, receivers, row in the sorted set
    listed_edges: dict[str, Tensor]
    level_rows: dict[int, Tensor]  # rows of the listed body edges per level


def make_case(size: int, model: str, device: str = "cpu") -> Case:
    """A sheet of about ``size`` vertices; deterministic."""
    torch.manual_seed(0)
    side = max(round(size**0.5), 3)
    cloth = build_cloth(*grid_with_diagonals(side), Material())
    schedule = parse_schedule(model)
    num_coarse = max(set_level(name) for name in edge_set_names(schedule))
    network = MeshGraphNet(24 if num_coarse else 20, WIDTHS, LATENT, model).to(device)
    hierarchy = build_hierarchy(cloth.num_vertices, cloth.edges.numpy(), cloth.rest_pos.numpy(), num_coarse)
    obstacle, contact = touch(cloth.num_vertices)
    step = StepInput(torch.full((1,), 1 / 30), obstacle)
    graph = build_graph(build_static(cloth, hierarchy, network.edge_set_names), step, contact)
    nodes = torch.randn(graph.num_nodes, network.node_encoder.first.in_features)
    edges = {name: torch.randn(s.num_edges, WIDTHS.get(name, 12)) for name, s in graph.edge_sets.items()}
    all_nodes = torch.randn(graph.num_cloth + NUM_BODY, nodes.shape[1])
    all_nodes[: graph.num_cloth] = nodes[: graph.num_cloth]
    all_nodes[graph.num_cloth + graph.body_vertex] = nodes[graph.num_cloth :]
    listed = {name: list_edges(graph, name) for name in graph.edge_sets}
    listed_edges = {name: edges[name][rows] for name, (_, _, rows) in listed.items()}
    levels = {level: kept_rows(graph, level, listed[BODY][2]) for level in graph.body_subsets}
    return Case(network, graph, nodes, edges, all_nodes, listed, listed_edges, levels)


def grid_with_diagonals(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A sheet of ``side``² vertices with edges of about 1 cm."""
    return grid(side, side, 0.01 * side)


def touch(num_vertices: int) -> tuple[Obstacle, Contact]:
    """Two fifths of the vertices, in one patch, near ``TOUCHED`` body vertices."""
    pos, scene = torch.zeros(NUM_BODY, 3), torch.zeros(NUM_BODY, dtype=torch.int64)
    obstacle = Obstacle(pos, pos, pos, torch.zeros(0, 3, dtype=torch.int64), scene, scene[:0], scene.bool())
    index = torch.arange(num_vertices)
    near = index < round(0.4 * num_vertices)
    vertex = (index * TOUCHED // max(int(near.sum()), TOUCHED)).clamp_max(TOUCHED - 1) * 3
    plane = plane_contact(torch.zeros(num_vertices, 3))
    contact = Contact(**{**vars(plane), "vertex": vertex, "vertex_dist": torch.where(near, 0.01, 1.0)})
    return obstacle, contact


def list_edges(graph: Graph, name: str) -> tuple[Tensor, Tensor, Tensor]:
    """Senders, receivers and sorted rows of a set in the order of its undirected list, one direction after the other."""
    edges = graph.edge_sets[name]
    rows = torch.argsort(edges.source + (edges.senders < edges.receivers) * (edges.num_edges + 1))
    ids = torch.cat([torch.arange(graph.num_cloth), graph.num_cloth + graph.body_vertex])
    return ids[edges.senders[rows]], ids[edges.receivers[rows]], rows


def kept_rows(graph: Graph, level: int, order: Tensor) -> Tensor:
    """Rows of the listed body edges that belong to ``body_subsets[level]``."""
    kept = torch.zeros(graph.edge_sets[BODY].num_edges, dtype=torch.bool)
    rows = graph.body_subsets[level].rows
    kept[slice(None) if rows is None else rows] = True
    return kept[order].nonzero().squeeze(1)


# ---- the naive form --------------------------------------------------------------------------------------------------


def plain(mlp: MLP, x: Tensor) -> Tensor:
    """The perceptron, one operation after the other, nothing in place."""
    hidden = torch.relu(functional.linear(torch.relu(mlp.first(x)), mlp.second.weight, mlp.second.bias))
    out = mlp.third(hidden)
    return out if mlp.norm is None else mlp.norm(out)


def naive(case: Case) -> Tensor:
    """The network by its formulas."""
    network = case.network
    nodes = plain(network.node_encoder, case.all_nodes)
    edges = {name: plain(encoder, case.listed_edges[name]) for name, encoder in network.edge_encoders.items()}
    for sets, step in zip(network.schedule, network.steps, strict=True):
        nodes = naive_step(case, step, nodes, edges, finest_level(sets))
    return plain(network.decoder, nodes[: case.graph.num_cloth])


def naive_step(case: Case, step: ProcessorStep, nodes: Tensor, edges: dict[str, Tensor], level: int) -> Tensor:
    """New nodes; ``edges`` are replaced in the dictionary."""
    parts = [nodes]
    for name in step.sets:
        senders, receivers, _ = case.listed[name]
        latent, rows = edges[name], case.level_rows[level] if name == BODY and level else None
        if rows is not None:
            senders, receivers, latent = senders[rows], receivers[rows], latent[rows]
        message = plain(step.edge_mlps[name], torch.cat([nodes[receivers], nodes[senders], latent], dim=1))
        parts.append(torch.zeros_like(nodes).index_add(0, receivers, message))
        edges[name] = edges[name] + message if rows is None else edges[name].index_add(0, rows, message)
    return nodes + plain(step.node_mlp, torch.cat(parts, dim=1))


def pyg(case: Case) -> Callable[[], Tensor]:
    """The single-level network as torch_geometric's MetaLayer; needs ``pip install "hood-cloth[benchmark]"``."""
    from torch_geometric.nn import MetaLayer  # type: ignore[import-not-found]
    from torch_geometric.utils import scatter  # type: ignore[import-not-found]

    class EdgeModel(nn.Module):
        def __init__(self, mlp: MLP) -> None:
            super().__init__()
            self.mlp = mlp

        def forward(self, src: Tensor, dst: Tensor, attr: Tensor, *_: Any) -> Tensor:
            return plain(self.mlp, torch.cat([dst, src, attr], dim=1))

    network = case.network
    if network.edge_set_names != ("mesh",):
        raise ValueError("--pyg: MetaLayer has one edge set besides the body's; use --models fine15 or fine48")
    index = {name: torch.stack(case.listed[name][:2]) for name in ("mesh", BODY)}
    layers = [{name: MetaLayer(EdgeModel(step.edge_mlps[name])) for name in index} for step in network.steps]

    def run() -> Tensor:
        nodes = plain(network.node_encoder, case.all_nodes)
        edges = {name: plain(encoder, case.listed_edges[name]) for name, encoder in network.edge_encoders.items()}
        for step, layer in zip(network.steps, layers, strict=True):
            parts = [nodes]
            for name, pairs in index.items():
                _, message, _ = layer[name](nodes, pairs, edges[name])
                parts.append(scatter(message, pairs[1], dim=0, dim_size=len(nodes), reduce="sum"))
                edges[name] = edges[name] + message
            nodes = nodes + plain(step.node_mlp, torch.cat(parts, dim=1))
        return plain(network.decoder, nodes[: case.graph.num_cloth])

    return run


# ---- measuring -------------------------------------------------------------------------------------------------------


def forms(case: Case, with_pyg: bool = False, with_compiled: bool = False) -> dict[str, tuple[nn.Module, Callable[[], Tensor]]]:
    """What takes part, by name: the parameters' owner and a call."""
    half = copy.deepcopy(case.network)
    half.precision = "bf16"
    result = {
        "naive": (case.network, partial(naive, case)),
        "fp32": (case.network, partial(case.network, case.graph, case.nodes, case.edges)),
        "bf16": (half, partial(half, case.graph, case.nodes, case.edges)),
    }
    for kernels, precision in (*(("compiled", name) for name in PRECISIONS), (FUSED, "fp32")) if with_compiled else ():
        network = copy.deepcopy(case.network)
        network.use_precision(precision)
        try:
            network.use_kernels(kernels)
        except ValueError as error:  # a processor without bfloat16
            tell(f"without {kernels} {precision}: {error}")
            continue
        result[f"{kernels} {precision}"] = (network, partial(network, case.graph, case.nodes, case.edges))
    if with_pyg:
        result["pyg"] = (case.network, pyg(case))
    return result


def train(owner: nn.Module, run: Callable[[], Tensor]) -> None:
    """One forward and backward pass."""
    owner.zero_grad(set_to_none=True)
    run().square().mean().backward()


def quiet(run: Callable[[], Tensor]) -> None:
    with torch.no_grad():
        run()


def alternate(calls: Mapping[str, Callable[[], None]], rounds: int, long: float = float("inf")) -> dict[str, list[float]]:
    """CPU seconds of every call in ``rounds`` turns, or fewer if one lasts longer than ``long``; they take turns."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        began = time.process_time()
        for name, call in calls.items():
            start = time.process_time()
            call()
            if turn:  # the first is the warm-up
                times[name].append(time.process_time() - start)
        if turn >= FEW and time.process_time() - began > long:
            break
    return times


def check(case: Case, runs: Mapping[str, tuple[nn.Module, Callable[[], Tensor]]]) -> float:
    """Error of bf16 in the RMS sense, the larger of its forms'; float32 forms must agree to 1e-5 with the first one (naive
    where it fits)."""
    with torch.no_grad():
        results = {name: run().double() for name, (_, run) in runs.items()}
    first, reference = next(iter(results.items()))
    scale = reference.square().mean().sqrt()
    for name, value in results.items():
        worst = float((value - reference).abs().max() / scale)
        if not name.endswith("bf16") and worst > 1e-5:
            raise SystemExit(f"{name} differs from {first} by {worst:.1e} of the output's RMS; the comparison is void")
    half = [value for name, value in results.items() if name.endswith("bf16")]
    return max(float((value - reference).square().mean().sqrt() / scale) for value in half)


def network_flops(network: MeshGraphNet, graph: Graph, nodes: Tensor) -> float:
    """Floating-point operations of the matrix products of one forward pass of the network."""
    d = network.latent_dim

    def mlp(rows: int, first: int, out: int = d) -> float:
        return 2.0 * rows * d * (first + d + out)

    total = mlp(graph.num_nodes, nodes.shape[1]) + mlp(graph.num_cloth, d, 3)
    total += sum(mlp(s.num_edges, WIDTHS.get(name, 12)) for name, s in graph.edge_sets.items())
    for sets in network.schedule:
        parts = [graph.edge_sets[name] for name in sets] + [graph.body_subsets[finest_level(sets)].edges]
        total += mlp(graph.num_nodes, d)
        total += sum(mlp(p.num_edges, d) + 2.0 * len(p.nodes) * d * 3 * d for p in parts)
    return total


def product_rate(dtype: torch.dtype) -> dict[str, float]:
    """FLOP/s of (1024, 128) × (128, 128) in ``dtype`` by torch's own product and by the network's."""
    x, weight = torch.randn(1024, LATENT).to(dtype), torch.randn(LATENT, LATENT).to(dtype)
    out = torch.empty(1024, LATENT, dtype=dtype)
    calls = {"torch.mm": lambda: torch.mm(x, weight.t(), out=out), "network": lambda: affine(x, weight)}
    repeated = {name: lambda call=call: [call() for _ in range(100)] and None for name, call in calls.items()}
    return {name: 100 * 2.0 * 1024 * LATENT**2 / np.median(seconds) for name, seconds in alternate(repeated, 15).items()}


@cache
def peak_memory(size: int, model: str, name: str, training: bool) -> float:
    """MB that one pass of ``name`` needs beyond weights and inputs, measured in a fresh process."""
    request = json.dumps([size, model, name, training])
    command = [sys.executable, __file__, "--memory-of", request]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def expected_memory(size: int, model: str, name: str, training: bool) -> float:
    """MB that one pass is going to need: the line through :data:`PROBES`; 0 for sizes not much larger."""
    if size < 2 * PROBES[1]:
        return 0.0
    small, large = (peak_memory(probe, model, name, training) for probe in PROBES)
    slope = max(large - small, 0.0) / (PROBES[1] - PROBES[0])
    return large + slope * (size - PROBES[1])


def available_memory() -> float:
    """MB that new processes may take."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("MemAvailable")) / 1024


def fitting(size: int, model: str, names: Sequence[str], training: bool) -> list[str]:
    """Those of ``names`` that the machine has memory for; a sentence for every other one."""
    kept, room = [], 0.9 * available_memory()  # a tenth is left to everyone else
    for name in names:
        need = expected_memory(size, model, name, training)
        if need < room:
            kept.append(name)
            continue
        what = "forward + backward" if training else "forward"
        print(
            f"{what}: {name} needs about {need / 1024:.1f} GB, more than this machine has ({room / 1024:.1f} GB free)",
            flush=True,
        )
    return kept


def measure_memory(size: int, model: str, name: str, training: bool) -> float:
    """The same in this process: growth of the resident set's high-water mark over one pass."""
    small = forms(make_case(100, model), name == "pyg", " " in name)[name]
    train(*small) if training else quiet(small[1])  # pages of the libraries' code are not counted
    owner, run = forms(make_case(size, model), name == "pyg", " " in name)[name]
    ctypes.CDLL(None).malloc_trim(0)  # what building the case has freed would be used again without being seen
    before = resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the mark starts again from here
    train(owner, run) if training else quiet(run)
    return resident("VmHWM") - before


def resident(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(field)) / 1024


def table(size: int, model: str, args: argparse.Namespace) -> None:
    """Print the rows of one size and model."""
    tell(f"{model}, {size} vertices: building the graph")
    case = make_case(size, model)
    runs = forms(case, args.pyg and model.startswith("fine"), args.compiled)
    tell(f"{model}, {size} vertices: do all forms agree?")
    present = fitting(size, model, list(runs), training=False)
    both = {"fp32", "bf16"} <= set(present)
    error = f"bf16 error {check(case, {name: runs[name] for name in present}):.2%}" if both else "outputs not compared"
    flops = network_flops(case.network, case.graph, case.nodes)
    counts = {name: s.num_edges for name, s in case.graph.edge_sets.items()}
    print(f"\n{model}, {case.graph.num_cloth:,} vertices, edges {counts}, {flops / 1e9:.1f} GFLOP; {error}")
    print(f"| {' | '.join(COLUMNS)} |\n" + "|---" * len(COLUMNS) + "|", flush=True)
    for training in (False, True) if not args.forward_only else (False,):
        names = fitting(size, model, [name for name in runs if not name.startswith(FUSED)], training) if training else present
        rows(size, model, training, {name: runs[name] for name in names}, flops, args)


def rows(
    size: int,
    model: str,
    training: bool,
    runs: Mapping[str, tuple[nn.Module, Callable[[], Tensor]]],
    flops: float,
    args: argparse.Namespace,
) -> None:
    """Measure one pass of every form and print its rows."""
    label = "forward + backward" if training else "forward"
    tell(f"{model}, {size} vertices: {label}, the times of {', '.join(runs)}")
    rate = {"fp32": max(product_rate(torch.float32).values()), "bf16": max(product_rate(torch.bfloat16).values())}
    calls = {name: partial(train, *entry) if training else partial(quiet, entry[1]) for name, entry in runs.items()}
    times = alternate(calls, args.rounds, args.long)
    seconds = {name: float(np.median(values)) for name, values in times.items()}
    for owner, _ in runs.values():
        owner.zero_grad(set_to_none=True)
    memory: dict[str, float] = {}
    for name in runs if args.memory else ():
        tell(f"{model}, {size} vertices: {label}, the memory of {name}")
        memory[name] = peak_memory(size, model, name, training)
    for name, value in seconds.items():
        own = (3 if training else 1) * flops / value
        compared = f"{seconds['naive'] / value:.2f}" if "naive" in seconds else ""
        space = f"{memory[name]:.0f}" if memory else ""
        share = f"{memory[name] / memory['naive']:.2f}" if "naive" in memory else ""
        precision = name.split()[-1]
        fraction = (f"{own / 1e9:.0f}", f"{own / rate[precision]:.0%}") if precision in rate else ("", "")
        cells = (label, name, str(len(times[name])), f"{1e3 * value:.1f}", compared, space, share, *fraction)
        print(f"| {' | '.join(cells)} |", flush=True)
        if args.output:
            with args.output.open("a", newline="") as file:
                csv.writer(file).writerow((model, size, *cells))


def tell(text: str) -> None:
    print(f"[{time.strftime('%H:%M:%S')}] {text}", file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 5041])
    parser.add_argument("--models", nargs="+", default=["fine15", "ours"], help="schedules by name or text")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--long", type=float, default=15.0, help="seconds of a turn from which three turns are enough")
    parser.add_argument("--output", type=Path, help="CSV file to which every row is appended once it is known")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--pyg", action="store_true", help="also torch_geometric's MetaLayer (fine15 and fine48)")
    parser.add_argument("--compiled", action="store_true", help="also the compiled kernels (needs a C++ compiler and AVX2)")
    parser.add_argument("--forward-only", action="store_true")
    parser.add_argument("--no-memory", dest="memory", action="store_false")
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if any(os.environ.get(key) is None for key in ENVIRONMENT):  # read at process start only, and by all forms alike
        environment = {**ENVIRONMENT, **os.environ}
        os.execve(sys.executable, [sys.executable, *sys.argv], environment)
    torch.set_num_threads(args.threads)
    if args.memory_of:
        print(measure_memory(*json.loads(args.memory_of)))
        return
    rates = {name: product_rate(dtype) for name, dtype in (("fp32", torch.float32), ("bf16", torch.bfloat16))}
    for name, rate in rates.items():
        print(f"(1024, 128) × (128, 128) in {name}: " + ", ".join(f"{k} {v / 1e9:.0f} GFLOP/s" for k, v in rate.items()))
    if args.output:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        with args.output.open("w", newline="") as file:
            csv.writer(file).writerow(("model", "vertices", *COLUMNS))
    for model in args.models:
        for size in args.sizes:
            table(size, model, args)


if __name__ == "__main__":
    main()

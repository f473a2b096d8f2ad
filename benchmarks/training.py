"""Where an update of the training goes, and its rate against the same update with the naive network: one alternating run.

    python benchmarks/training.py --parts                    # time of every part, with and without a worker
    python benchmarks/training.py --naive                    # iterations/s in fp32 and bf16 against naive
    python benchmarks/training.py --memory                   # activation checkpointing: memory, time, gradients
    python benchmarks/training.py --kernels                  # torch's operations and the compiled kernels, and their losses

Updates are those of ``hood train`` (trainer=paper at horizon 1, its most expensive phase for the data, unless ``--set``
says otherwise) on embedded garments; ``dress:5000`` is the largest dress below that size with its longest edges split until
it has 5,000 vertices. ``--parts`` counts every part without the parts inside it, in wall-clock time, since waiting is what it
is after. ``--naive`` replaces the network's forward pass by benchmarks/network.py's formulas, checks that both predict the
same, and lets updates take turns on one scene each; times are medians of the process's CPU time, the naive
form's own lists of edges not counted. ``--kernels`` lets updates in fp32 take turns in both forms, with a rate of learning that
leaves the weights as they are, so that losses can be compared. ``ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2`` before the
command has a processor with AVX-512 do without.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from network import NUM_BODY, Case, kept_rows, list_edges, naive, network_flops, resident
from torch import Tensor

from hood.app.settings.compose import load_config
from hood.app.train import make_trainer
from hood.assets.garment.garment import Garment, load_garment, save_garment
from hood.cli.main import ENVIRONMENT
from hood.mesh import topology
from hood.model.graph.builder import BODY, Graph
from hood.model.network.model import MeshGraphNet
from hood.steppers.protocol import Stopwatch
from hood.training.trainer import Trainer

PARTS = ("data", "search", "features", "network", "energies", "backward", "optimiser", "rest")
CASES = ("ours dress:5000", "small dress")


# ---- garments --------------------------------------------------------------------------------------------------------


def garment_file(name: str, folder: Path) -> str:
    """An embedded name, or a refined garment's file: ``dress:5000``."""
    base, _, count = name.partition(":")
    if not count:
        return base
    sizes = [(len(load_garment(n).rest_pos), n) for n in (base, f"{base}_4k")]
    garment = refine(load_garment(max(size for size in sizes if size[0] <= int(count))[1]), int(count))
    path = folder / f"{base}_{count}.npz"
    save_garment(path, garment)
    return str(path)


def refine(garment: Garment, num_vertices: int) -> Garment:
    """The garment with its longest edges split in the middle, no face twice in a round, until it has ``num_vertices``."""
    pos, faces, pinned = garment.rest_pos, garment.faces, garment.pinned
    while len(pos) < num_vertices:
        edges = topology.unique_edges(faces)
        length = np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1)
        number = topology.edge_index(edges, faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)).reshape(-1, 3)
        around: dict[int, list[int]] = {}
        for face, own in enumerate(number.tolist()):
            for edge in own:
                around.setdefault(edge, []).append(face)
        touched, split = np.zeros(len(faces), dtype=bool), {}
        for edge in np.argsort(-length)[: len(edges) // 4].tolist():
            if len(pos) + len(split) < num_vertices and not touched[around[edge]].any():
                touched[around[edge]] = True
                split[edge] = len(pos) + len(split)
        ends = edges[list(split)]
        pos, pinned = np.concatenate([pos, pos[ends].mean(axis=1)]), np.concatenate([pinned, pinned[ends].all(axis=1)])
        halves = [half for f, own in zip(faces, number.tolist(), strict=True) for half in _halves(f, own, split)]
        faces = np.array(halves, dtype=np.int64)
    return Garment(garment.name, pos, faces, pinned)


def _halves(face: np.ndarray, edges: list[int], split: dict[int, int]) -> list[list[int]]:
    for corner, edge in enumerate(edges):
        if edge in split:
            a, b, c = np.roll(face, -corner).tolist()
            return [[a, split[edge], c], [split[edge], b, c]]
    return [face.tolist()]


def trainer_for(case: str, folder: Path, *options: str) -> Trainer:
    """The trainer of ``model garment``; statistics are taken as collected."""
    model, garment = case.split()
    recipe = "fast" if model == "small" else "paper"
    name = garment_file(garment, folder)
    keys = [f"model={model}", f"trainer={recipe}", f"data.garments=['{name}']", "trainer.statistics_iterations=0"]
    return make_trainer(load_config("train", [*keys, f"output={folder}/run", *options]))


# ---- parts -----------------------------------------------------------------------------------------------------------


class Parts:
    """Seconds by part, each without what is counted inside it."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(PARTS, 0.0)
        self._stack = ["rest"]
        self._since = time.perf_counter()

    def call(self, part: str, inner: bool, function: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """``function(…)`` counted as ``part``; unless ``inner`` only where no other part is being counted."""
        if not inner and len(self._stack) > 1:
            return function(*args, **options)
        self._count()
        self._stack.append(part)
        try:
            return function(*args, **options)
        finally:
            self._count()
            self._stack.pop()

    def _count(self) -> None:
        now = time.perf_counter()
        self.seconds[self._stack[-1]] += now - self._since
        self._since = now

    def reset(self) -> None:
        self._count()
        self.seconds = dict.fromkeys(PARTS, 0.0)

    def total(self) -> float:
        self._count()
        return sum(self.seconds.values())


@contextmanager
def counted(trainer: Trainer) -> Iterator[Parts]:
    """Count the trainer's updates by parts."""
    import hood.energies.problem as problem_module
    import hood.steppers.network as simulator_module
    from hood.energies.potential import Potential

    parts = Parts()
    simulator = trainer.simulator
    watched: list[tuple[Any, str, str, bool]] = [
        (trainer.slots, "batch", "data", True),
        (trainer.slots, "advance", "data", True),
        (problem_module, "find_contact", "search", True),
        (simulator_module, "find_nearest", "search", True),
        (simulator, "predict", "features", True),
        (simulator.network, "forward", "network", True),
        (Potential, "gradient", "energies", False),
        (Tensor, "backward", "backward", True),
        (trainer, "_answer", "optimiser", True),
        (trainer, "_optimise", "optimiser", True),
    ]
    originals = [(owner, name, getattr(owner, name), name in vars(owner)) for owner, name, _, _ in watched]
    for (owner, name, part, inner), (_, _, function, _) in zip(watched, originals, strict=True):
        setattr(owner, name, _counter(parts, part, inner, function))
    try:
        yield parts
    finally:
        for owner, name, function, own in originals:
            setattr(owner, name, function) if own else delattr(owner, name)


def _counter(parts: Parts, part: str, inner: bool, function: Callable[..., Any]) -> Callable[..., Any]:
    """A plain function, so that it binds where it replaces a method of a class."""

    def count(*args: Any, **options: Any) -> Any:
        return parts.call(part, inner, function, *args, **options)

    return count


def parts_table(args: argparse.Namespace) -> None:
    print("\n| case | workers | it/s | " + " | ".join(PARTS) + " | forward + backward |\n" + "|---" * (len(PARTS) + 4) + "|")
    with tempfile.TemporaryDirectory() as folder:
        for case in args.cases:
            for workers in args.workers:
                trainer = trainer_for(case, Path(folder), f"trainer.workers={workers}", *args.set)
                while trainer.slots.feed.takes < 20:  # workers have started and are ahead
                    trainer.update()
                time.sleep(8 if workers else 0)
                with counted(trainer) as parts:
                    trainer.update()
                    parts.reset()
                    for _ in range(args.updates):
                        trainer.update()
                    total = parts.total()
                trainer.slots.close()
                shares = {part: seconds / total for part, seconds in parts.seconds.items()}
                both = sum(shares[part] for part in ("features", "network", "backward"))
                row = " | ".join(f"{1e3 * parts.seconds[part] / args.updates:.1f} ms ({shares[part]:.1%})" for part in PARTS)
                print(f"| {case} | {workers} | {args.updates / total:.2f} | {row} | {both:.1%} |", flush=True)


# ---- naive -----------------------------------------------------------------------------------------------------------


class Ledger:
    """CPU seconds that are not the naive form's: its lists of edges would not be made anew every step."""

    seconds = 0.0


def naive_forward(network: MeshGraphNet, ledger: Ledger, graph: Graph, nodes: Tensor, edges: dict[str, Tensor]) -> Tensor:
    """What ``network`` computes, by benchmarks/network.py's formulas: all body vertices, edges as listed."""
    began = time.process_time()
    num_cloth = graph.num_cloth
    num_scenes = 1 if graph.body_vertex.numel() == 0 else int(graph.body_vertex.max()) // NUM_BODY + 1
    rows = torch.cat([torch.arange(num_cloth), num_cloth + graph.body_vertex])
    all_nodes = nodes.new_zeros(num_cloth + num_scenes * NUM_BODY, nodes.shape[1]).index_copy(0, rows, nodes)
    listed = {name: list_edges(graph, name) for name in graph.edge_sets}
    listed_edges = {name: edges[name][order] for name, (_, _, order) in listed.items()}
    levels = {level: kept_rows(graph, level, listed[BODY][2]) for level in graph.body_subsets}
    case = Case(network, graph, nodes, edges, all_nodes, listed, listed_edges, levels)
    ledger.seconds += time.process_time() - began
    return naive(case)


def check_same(trainer: Trainer) -> None:
    """Naive and real network must predict the same on the trainer's present scenes."""
    network, seen = trainer.simulator.network, {}

    def keep(*inputs: Any) -> Tensor:
        seen["own"] = MeshGraphNet.forward(network, *inputs)
        seen["naive"] = naive_forward(network, Ledger(), *inputs)
        return seen["own"]

    network.forward = keep  # type: ignore[method-assign]
    trainer.update()
    del network.forward
    own, other = (seen[name].detach().double() for name in ("own", "naive"))
    worst = float((own - other).abs().max() / other.square().mean().sqrt())
    if worst > 1e-5:
        raise SystemExit(f"naive differs by {worst:.1e} of the output's RMS; the comparison is void")


def naive_table(args: argparse.Namespace) -> None:
    print("\n| case | form | ms per update | it/s | vs naive |\n" + "|---" * 5 + "|")
    with tempfile.TemporaryDirectory() as folder:
        for case in args.cases:
            check_same(trainer_for(case, Path(folder), "trainer.workers=0", *args.set))
            ledger, trainers = Ledger(), {}
            for form in ("naive", "fp32", "bf16"):
                precision = "bf16" if form == "bf16" else "fp32"
                trainer = trainer_for(case, Path(folder), "trainer.workers=0", f"trainer.precision={precision}", *args.set)
                trainers[form] = trainer
                if form == "naive":
                    network = trainer.simulator.network
                    network.forward = partial(naive_forward, network, ledger)  # type: ignore[method-assign]
            times: dict[str, list[float]] = {form: [] for form in trainers}
            for turn in range(args.updates + 2):
                for form, trainer in trainers.items():
                    apart, began = ledger.seconds, time.process_time()
                    trainer.update()
                    spent = time.process_time() - began - (ledger.seconds - apart)
                    if turn > 1:
                        times[form].append(spent)
            # Scenes start every other update: means over pairs, and the median of these.
            middle = {
                form: float(np.median(np.reshape(t[: len(t) // 2 * 2], (-1, 2)).mean(axis=1))) for form, t in times.items()
            }
            for form, seconds in middle.items():
                print(
                    f"| {case} | {form} | {1e3 * seconds:.0f} | {1 / seconds:.2f} | {middle['naive'] / seconds:.2f} |",
                    flush=True,
                )


# ---- kernels ---------------------------------------------------------------------------------------------------------


def kernels_table(args: argparse.Namespace) -> None:
    spent = ("update [ms]", "without scenes", "forward + backward")
    columns = ("case", "vectors", "form", *spent, "vs torch", "", "", "GFLOP", "GFLOP/s", "loss off by")
    print("\n| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    vectors = torch.backends.cpu.get_cpu_capability()
    with tempfile.TemporaryDirectory() as folder:
        for case in args.cases:
            times, losses, flops = updates_in_turns(case, Path(folder), args)
            off = max(abs(a - b) / abs(a) for a, b in zip(losses["torch"], losses["compiled"], strict=True))
            for form, of_form in times.items():
                faster = " | ".join(f"{t / own:.2f}" for t, own in zip(times["torch"], of_form, strict=True))
                parts = " | ".join(f"{1e3 * seconds:.0f}" for seconds in of_form)
                rate = f"{3e-9 * flops:.1f} | {3e-9 * flops / of_form[-1]:.0f}"
                print(f"| {case} | {vectors} | {form} | {parts} | {faster} | {rate} | {off:.0e} |", flush=True)


def updates_in_turns(
    case: str, folder: Path, args: argparse.Namespace
) -> tuple[dict[str, tuple[float, ...]], dict[str, list[float]], float]:
    """By form, median CPU seconds of an update, of it without its scenes, and of forward and backward pass; the losses; and the
    operations of a forward pass in products."""
    trainers, flops = {}, list[float]()
    for form in ("torch", "compiled"):
        keys = (f"trainer.kernels={form}", "trainer.workers=0", "trainer.learning_rate=1e-12", *args.set)
        trainers[form] = trainer_for(case, folder, *keys)
        trainers[form].stopwatch = Stopwatch(time.process_time)
    network = trainers["torch"].simulator.network
    network.register_forward_pre_hook(lambda module, inputs: flops.append(network_flops(network, *inputs[:2])))
    times: dict[str, list[tuple[float, float, float]]] = {form: [] for form in trainers}
    losses: dict[str, list[float]] = {form: [] for form in trainers}
    for turn in range(args.updates + 2):
        for form, trainer in trainers.items():
            watch = trainer.stopwatch
            assert watch is not None
            watch.lap()
            losses[form].append(trainer.update()["loss"])
            parts = {name: milliseconds / 1e3 for name, milliseconds in watch.lap().items()}
            both = sum(parts[part] for part in ("features", "network", "backward"))
            if turn > 1:
                times[form].append((parts["total"], parts["total"] - parts["scenes"], both))
    # Scenes start every other update: means over pairs, and the median of these.
    pairs = {form: np.reshape(t[: len(t) // 2 * 2], (-1, 2, 3)).mean(axis=1) for form, t in times.items()}
    medians = {form: tuple(np.median(t, axis=0).tolist()) for form, t in pairs.items()}
    return medians, losses, float(np.median(flops))


# ---- memory ----------------------------------------------------------------------------------------------------------


def memory_table(args: argparse.Namespace) -> None:
    print("\n| case | activation checkpointing | peak MB of an update | ms per update | same gradient |\n" + "|---" * 5 + "|")
    for case in args.cases:
        lines = {}
        for on in ("false", "true"):
            command = [sys.executable, __file__, "--memory-of", case, on, "--set", *args.set]
            out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            lines[on] = out.strip().splitlines()[-1].split()
        for on, (peak, milliseconds, digest) in lines.items():
            print(f"| {case} | {on} | {peak} | {milliseconds} | {digest == lines['false'][2]} |", flush=True)


def memory_of(case: str, on: str, options: list[str]) -> None:
    """Print peak MB, milliseconds and a digest of the gradients of one update, in this fresh process."""
    import hashlib

    with tempfile.TemporaryDirectory() as folder:
        keys = ("trainer.workers=0", f"trainer.activation_checkpointing={on}", "trainer.clip_norm=1e9", *options)
        trainer = trainer_for(case, Path(folder), *keys)
        trainer.update()  # the scene, and pages of the libraries' code, are not counted
        ctypes.CDLL(None).malloc_trim(0)
        before = resident("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")  # the mark starts again from here
        trainer.update()
        peak = resident("VmHWM") - before
        digest = hashlib.sha256()
        for parameter in trainer.simulator.parameters():
            if parameter.grad is not None:
                digest.update(parameter.grad.numpy().tobytes())
        began = time.process_time()
        trainer.update()
        print(f"{peak:.0f} {1e3 * (time.process_time() - began):.0f} {digest.hexdigest()}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", action="store_true", help="time of every part of an update")
    parser.add_argument("--naive", action="store_true", help="rate against the same update with the naive network")
    parser.add_argument("--memory", action="store_true", help="what activation checkpointing saves and costs")
    parser.add_argument("--kernels", action="store_true", help="torch's operations and the compiled kernels, in turns")
    parser.add_argument("--cases", nargs="+", default=list(CASES), help="'MODEL GARMENT' each")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--updates", type=int, default=20)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--set", nargs="*", default=[], help="further key=value for hood train")
    parser.add_argument("--memory-of", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if any(os.environ.get(key) is None for key in ENVIRONMENT):  # read at process start only, and by all forms alike
        os.execve(sys.executable, [sys.executable, *sys.argv], {**ENVIRONMENT, **os.environ})
    torch.set_num_threads(args.threads)
    if args.memory_of:
        memory_of(*args.memory_of, args.set)
        return
    tables = {"parts": parts_table, "naive": naive_table, "memory": memory_table, "kernels": kernels_table}
    chosen = [table for name, table in tables.items() if vars(args)[name]]
    for table in chosen or tables.values():
        table(args)


if __name__ == "__main__":
    main()

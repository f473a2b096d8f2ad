"""``kernels=auto``: the form of a network that is fastest on this processor, found by a short timing at its first use.

All forms compute the same function in the same precision and differ in rounding. So that one machine gives the same result
twice, a choice is kept in the user's cache folder, by processor, threads, compiler, versions and the network's width; where
nothing can be kept, torch's operations are taken.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch

from hood.cloth.state import StepInput
from hood.model.graph.builder import BODY, MESH, Graph, StaticGraph, build_graph, edge_set
from hood.model.kernels import block
from hood.model.kernels import network as compiled_network
from hood.model.kernels.block import KERNELS, check_kernels
from hood.model.network.model import MeshGraphNet
from hood.native.build import BuildError, cache_folder, find_compiler, processor, source_text
from hood.tensors import dense
from hood.tensors.dense import PRECISIONS

#: Instead of a form's name.
AUTO = "auto"
#: What is timed: two processor steps on a square sheet with so many vertices a side; turns of all forms, after one to warm up.
_SIDE, _STEPS, _TURNS = 33, 2, 5
#: Columns of its features.
_WIDTH = 8


class KernelChoice(NamedTuple):
    """A form, and why."""

    kernels: str
    reason: str

    def __str__(self) -> str:
        return f"kernels=auto: {self.kernels} ({self.reason})"


def choose_kernels(precision: str, width: int, device: torch.device, training: bool = False) -> KernelChoice:
    """The fastest form for latents of ``width`` columns; of forward and backward pass if ``training``."""
    if device.type != "cpu" or precision not in PRECISIONS:
        return KernelChoice("torch", "the others are for a CPU")
    folder = cache_folder()
    if folder is None:
        return KernelChoice("torch", "nothing may be kept, HOOD_CACHE is off, and a timing may end otherwise in the next run")
    path = folder / "kernels" / f"choice-{_digest(precision, width, training)}.json"
    known = _read(path, precision, width)
    if known is not None:
        return known
    choice = _measure(precision, width, training)
    try:
        _write(path, choice)
    except OSError:
        return KernelChoice("torch", f"nothing can be kept in {folder}, and a timing may end otherwise in the next run")
    return choice


def choose_for(network: MeshGraphNet, precision: str, device: torch.device, training: bool = False) -> KernelChoice:
    """The same for a network, which may have parts of an own class."""
    choice = choose_kernels(precision, network.latent_dim, device, training)
    part = network.own_part() if choice.kernels == "fused" else ""
    return KernelChoice("torch", f"{part} is computed as its class says") if part else choice


def _measure(precision: str, width: int, training: bool) -> KernelChoice:
    """Time every form that works here."""
    forms, refusals = ["torch"], []
    for name in KERNELS:
        if name == "torch" or (training and name == "fused"):  # whose gradients are torch's
            continue
        try:
            check_kernels(name, precision, width)
            forms.append(name)
        except ValueError as error:
            refusals.append(str(error).removeprefix(f"kernels={name}: ").replace(" or use kernels=torch", ""))
    if len(forms) == 1:
        return KernelChoice("torch", "; ".join(dict.fromkeys(refusals)))
    times = time_forms(forms, precision, width, training)
    ranked = sorted(forms, key=times.__getitem__)
    listed = ", ".join(f"{name} {1e3 * times[name]:.1f}" for name in ranked)
    what = "forward and backward" if training else "forward"
    return KernelChoice(ranked[0], f"ms of {_STEPS} steps at {_SIDE**2:,} vertices, {what}, {precision}: {listed}")


def time_forms(forms: list[str], precision: str, width: int, training: bool) -> dict[str, float]:
    """Seconds of every form, the best of some turns; of the processor where the process has one thread, else on the clock."""
    with torch.random.fork_rng(devices=[]):  # weights drawn here must not change those drawn later
        network, graph = MeshGraphNet(_WIDTH, {MESH: _WIDTH, BODY: _WIDTH}, width, f"{_STEPS}x({MESH})"), _sheet()
    network.use_precision(precision)
    nodes = torch.linspace(-1, 1, graph.num_nodes * _WIDTH).view(-1, _WIDTH)
    edges = {name: torch.linspace(-1, 1, part.num_edges * _WIDTH).view(-1, _WIDTH) for name, part in graph.edge_sets.items()}
    call = partial(_train if training else _infer, partial(network, graph, nodes, edges))
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    best = dict.fromkeys(forms, float("inf"))
    for turn in range(_TURNS + 1):
        for name in forms:
            network.use_kernels(name)
            start = clock()
            call()
            if turn:
                best[name] = min(best[name], clock() - start)
    return best


def _infer(run: Callable[[], torch.Tensor]) -> None:
    with torch.no_grad():
        run()


def _train(run: Callable[[], torch.Tensor]) -> None:
    with torch.enable_grad():
        run().square().mean().backward()


def _sheet() -> Graph:
    """A square sheet with diagonals that nothing touches."""
    index = torch.arange(_SIDE**2).view(_SIDE, _SIDE)
    pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:]), (index[:-1, :-1], index[1:, 1:])]
    edges = torch.cat([torch.stack([a.flatten(), b.flatten()], dim=1) for a, b in pairs])
    level = torch.zeros(_SIDE**2, dtype=torch.int64)
    return build_graph(StaticGraph(_SIDE**2, edges, {MESH: edge_set(edges)}, level), StepInput(torch.ones(1)))


def _digest(precision: str, width: int, training: bool) -> str:
    """Of everything that the times depend on."""
    try:
        compiler = find_compiler()
    except BuildError:
        compiler = "none"
    sources = [source_text(file) for file in (block.SOURCE, compiled_network.SOURCE, Path(dense.__file__))]
    vectors = torch.backends.cpu.get_cpu_capability()
    parts = [processor(), vectors, torch.__version__, compiler, torch.get_num_threads(), precision, width, training, *sources]
    return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()


def _read(path: Path, precision: str, width: int) -> KernelChoice | None:
    """What was chosen before; None where there is nothing, or nothing that works."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        check_kernels(kept["kernels"], precision, width)
        return KernelChoice(str(kept["kernels"]), str(kept["reason"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _write(path: Path, choice: KernelChoice) -> None:
    """Under another name first: other processes may be doing the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, suffix=".partial")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump(choice._asdict(), file)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise

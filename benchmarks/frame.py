"""Where the time of a rollout's frame goes: body search, features, network, the rest; and what its metrics cost apart.

    python benchmarks/frame.py --sizes 1000 4000 --models small-ours.safetensors quickstart.safetensors --forms torch fused
    python benchmarks/frame.py --sizes 1000 5000 12000 --models fine15 ours --precision fp32 bf16 --forms torch

The embedded dress, refined to the given number of vertices, on the embedded body of 6,890 vertices, walking. A model is an
architecture with random weights, or the name of embedded weights. Every frame starts from the garment skinned to the body's
pose, so that contact is that of a worn garment whatever the weights predict. Medians over the frames of the process's CPU
time [ms]; forms and precisions take turns frame by frame. ``torch`` computes everything in torch but the search; the others
compute features and feedback by the compiled library and the network by these kernels. Feedback is what a model of several
passes sees between them. The share of the network is that of the total, which leaves out the metrics: contact with the body's
triangles, strain, penetration and energies, what ``metrics=all`` adds to a frame (``hood rollout metrics=none`` spares them).
The column ``apart`` is the largest distance [µm] of a step's positions from those of the first form. In single frames (folded
cloth, a contact about to change) a rounding is amplified: the torch form in float32 is then as far from itself in float64.
"""

from __future__ import annotations

import argparse
import os
import sys
import time

import numpy as np
import torch
from torch import Tensor

from hood.assets.body.load import load_body
from hood.assets.files.library import DATA_FOLDER
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.cli.main import ENVIRONMENT
from hood.cloth.state import State
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.mesh.topology import unique_edges
from hood.model.kernels.block import KERNELS
from hood.model.readout import network_step as passes_module
from hood.model.readout.network_step import CorrectionPasses
from hood.native import features as native
from hood.scene.scene import Scene, build_scene, recentre
from hood.solver.step_figures import StepFigures, penetration_metrics, strain_metrics
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import NetworkStepper, build_simulator
from hood.steppers.protocol import Stopwatch

PARTS = ("posing", "search", "features", "feedback", "network", "rest", "total", "metrics")
WEIGHTS = DATA_FOLDER / "weights"
POTENTIAL = default_potential()


def refined(garment: Garment, count: int) -> Garment:
    """The garment's shape in T-pose with the longest edges halved until it has ``count`` vertices; unbound, nothing pinned."""
    pos, faces = garment.worn_pos, garment.faces
    while len(pos) < count:
        pos, faces = _halve(pos, faces, count - len(pos))
    return Garment(garment.name, pos, faces, np.zeros(len(pos), dtype=bool))


def _halve(pos: np.ndarray, faces: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Halve up to ``most`` of the longest edges, no two in one face."""
    edges = unique_edges(faces)
    owners: dict[tuple[int, int], list[int]] = {}
    for index, face in enumerate(np.sort(faces, axis=1).tolist()):
        for a, b in ((0, 1), (0, 2), (1, 2)):
            owners.setdefault((face[a], face[b]), []).append(index)
    length = np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1)
    used, middles, kept, added = set(), [], faces.tolist(), []
    for a, b in edges[np.argsort(-length)][: len(edges) // 3].tolist():
        around = owners[a, b]
        if len(middles) == most or not used.isdisjoint(around):
            continue
        used.update(around)
        new = len(pos) + len(middles)
        middles.append((pos[a] + pos[b]) / 2)
        for index in around:
            added.append([new if v == a else v for v in kept[index]])
            kept[index] = [new if v == b else v for v in kept[index]]
    return np.concatenate([pos, middles]), np.array(kept + added)


def make_scene(count: int) -> Scene:
    """The dress of ``count`` vertices on the walking body."""
    garment = refined(load_garment("dress"), count)
    return build_scene(garment, load_body("default"), load_sequence("walk_proud", 30.0), Material())


class Timed(CorrectionPasses):
    """CorrectionPasses whose looks are timed."""

    spent = 0.0  # ms of CPU time, of all of them

    def look(self, index: int, raw: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        begin = time.process_time()
        seen = super().look(index, raw)
        Timed.spent += 1e3 * (time.process_time() - begin)
        return seen


@torch.no_grad()
def time_frame(simulator: NetworkStepper, scene: Scene, prepared: object, frame: int) -> tuple[dict[str, float], Tensor]:
    """One step from the skinned garment at ``frame``: milliseconds by part, and where it leads."""
    state = recentre(scene.start(frame, relaxed=False), scene.cloth.vertex_scene)
    Timed.spent, watch = 0.0, Stopwatch(time.process_time)
    with watch.part("posing"):
        problem = StepProblem(scene.cloth, state, scene.step_input(frame, state), gravity=simulator.gravity)
    with watch.part("search"):
        problem = simulator.search(problem)
    prediction = simulator.predict(problem, prepared, watch)  # type: ignore[arg-type]
    State(prediction.next_pos, simulator.next_velocity(problem, prediction), state.origin)
    times = watch.lap()
    with watch.aside("metrics"):
        known = POTENTIAL.prepare(problem)
        strain_metrics(scene.cloth, state.pos)
        penetration_metrics(known.contact, scene.cloth)
        StepFigures(POTENTIAL, known, prediction.next_pos, prediction.acc).metrics()
    times |= {"feedback": Timed.spent, "network": times["network"] - Timed.spent}
    return {**times, "metrics": watch.spent_aside("metrics")}, prediction.next_pos


def make_simulator(model: str) -> NetworkStepper:
    """An architecture with random weights, or embedded weights by the name of their file."""
    if model.endswith(".safetensors"):
        return load_simulator(WEIGHTS / model)
    return build_simulator(schedule=model).eval()


def run(size: int, model: str, forms: list[tuple[str, str]], frames: int) -> None:
    """Print one line per form and precision."""
    torch.manual_seed(0)
    scene, simulator = make_scene(size), make_simulator(model)
    prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
    rows: dict[tuple[str, str], list[dict[str, float]]] = {form: [] for form in forms}
    apart = dict.fromkeys(forms, 0.0)
    for frame in range(10, 10 + frames + 3):
        reached = {}
        for kernels, precision in forms:
            simulator.network.use_precision(precision)
            simulator.network.use_kernels(kernels)
            with native.in_torch(kernels == "torch"):
                row, reached[kernels, precision] = time_frame(simulator, scene, prepared, frame)
            rows[kernels, precision].append(row)
        for form, pos in reached.items():
            apart[form] = max(apart[form], 1e6 * float((pos - reached[forms[0]]).abs().max()))
    for form, measured in rows.items():
        # The first frames meet new numbers of body edges, for which kernels are made.
        median = {part: float(np.median([row[part] for row in measured[3:]])) for part in PARTS}
        cells = " | ".join(f"{median[part]:.1f}" for part in PARTS)
        share = median["network"] / median["total"]
        name = " | ".join(form)
        print(f"| {scene.cloth.num_vertices:,} | {model} | {name} | {cells} | {share:.0%} | {apart[form]:.2g} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 5000])
    parser.add_argument("--models", nargs="+", default=["fine15", "ours"])
    parser.add_argument("--precision", nargs="+", default=["fp32", "bf16"])
    parser.add_argument("--forms", nargs="+", default=["torch"], choices=KERNELS)
    parser.add_argument("--frames", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    if any(os.environ.get(key) is None for key in ENVIRONMENT):  # read at process start only
        os.execve(sys.executable, [sys.executable, *sys.argv], {**ENVIRONMENT, **os.environ})
    torch.set_num_threads(args.threads)
    forms = [(form, precision) for precision in args.precision for form in args.forms if (form, precision) != ("fused", "bf16")]
    passes_module.CorrectionPasses = Timed  # type: ignore[misc]
    titles = ["vertices", "model", "form", "precision", *PARTS, "network's share", "apart"]
    print("| " + " | ".join(titles) + " |\n" + "|---" * len(titles) + "|")
    for size in args.sizes:
        for model in args.models:
            run(size, model, forms, args.frames)


if __name__ == "__main__":
    main()

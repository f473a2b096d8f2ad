"""Where the time of a rollout's frame goes: body search, features, network, the rest; and what its metrics cost apart.

    python benchmarks/frame.py --sizes 1000 5000 12000 --models fine15 ours --precision fp32 bf16

The embedded dress, refined to the given number of vertices, on the embedded body of 6,890 vertices, walking; random
weights. Every frame starts from the garment skinned to the body's pose, so that contact is that of a worn garment whatever
the weights predict. Medians over the frames of the process's CPU time [ms]; --precision takes turns frame by frame. The
share of the network is that of the total, which leaves out the metrics: contact with the body's triangles, strain,
penetration and energies, what ``metrics=all`` adds to a frame (``hood rollout metrics=none`` spares them).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace

import numpy as np
import torch

from hood.assets.body import load_body
from hood.assets.garment import Garment, load_garment
from hood.assets.material import Material
from hood.assets.sequence import load_sequence
from hood.cli import ENVIRONMENT
from hood.dynamics.measure import penetration_metrics, strain_metrics
from hood.dynamics.rollout import energy_metrics
from hood.dynamics.simulator import Simulator, build_simulator
from hood.dynamics.stopwatch import Stopwatch
from hood.losses.elements import energies_and_gradient
from hood.losses.potential import default_potential
from hood.losses.problem import StepProblem
from hood.mesh.topology import unique_edges
from hood.scene.scene import Scene, build_scene, recentre
from hood.scene.state import State

PARTS = ("posing", "search", "features", "network", "rest", "total", "metrics")
POTENTIAL = default_potential()


def refined(garment: Garment, count: int) -> Garment:
    """The garment with its longest edges halved until it has ``count`` vertices; unbound, nothing pinned."""
    pos, faces = garment.rest_pos, garment.faces
    while len(pos) < count:
        pos, faces = _halve(pos, faces, count - len(pos))
    bare = dict(lbs_weights=None, shapedirs=None, bound_to=None, uv=None, uv_faces=None)
    return replace(garment, rest_pos=pos, faces=faces, pinned=np.zeros(len(pos), dtype=bool), **bare)


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


@torch.no_grad()
def time_frame(simulator: Simulator, scene: Scene, prepared: object, frame: int) -> dict[str, float]:
    """One step from the skinned garment at ``frame``; milliseconds by part."""
    state = recentre(scene.start(frame, relaxed=False), scene.cloth.vertex_scene)
    watch = Stopwatch(time.process_time)
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
        penetration_metrics(known.contact, scene.cloth.num_vertices)
        energy_metrics(POTENTIAL, known, *energies_and_gradient(POTENTIAL, known, prediction.next_pos, prediction.acc))
    return {**times, "metrics": watch.spent_aside("metrics")}


def run(size: int, model: str, precisions: list[str], frames: int) -> None:
    """Print one line per precision."""
    torch.manual_seed(0)
    scene, simulator = make_scene(size), build_simulator(schedule=model).eval()
    prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in precisions}
    for frame in range(10, 10 + frames + 3):
        for name in precisions:
            simulator.network.use_precision(name)
            rows[name].append(time_frame(simulator, scene, prepared, frame))
    for name, measured in rows.items():
        # The first frames meet new numbers of body edges, for which kernels are made.
        median = {part: float(np.median([row[part] for row in measured[3:]])) for part in PARTS}
        cells = " | ".join(f"{median[part]:.1f}" for part in PARTS)
        share = median["network"] / median["total"]
        print(f"| {scene.cloth.num_vertices:,} | {model} | {name} | {cells} | {share:.0%} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 5000])
    parser.add_argument("--models", nargs="+", default=["fine15", "ours"])
    parser.add_argument("--precision", nargs="+", default=["fp32", "bf16"])
    parser.add_argument("--frames", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    if any(os.environ.get(key) is None for key in ENVIRONMENT):  # read at process start only
        os.execve(sys.executable, [sys.executable, *sys.argv], {**ENVIRONMENT, **os.environ})
    torch.set_num_threads(args.threads)
    print("| vertices | model | precision | " + " | ".join(PARTS) + " | network's share |\n" + "|---" * 11 + "|")
    for size in args.sizes:
        for model in args.models:
            run(size, model, args.precision, args.frames)


if __name__ == "__main__":
    main()

"""How far steps are from their minimum: the estimate of rollouts (``distance_p99``) against the true distance.

    python benchmarks/step_distance.py --rows distance.jsonl                 # all scenes; goes on where the file ends
    python benchmarks/step_distance.py --rows distance.jsonl --scenes skirt_jog_15 --methods quickstart newton
    python benchmarks/step_distance.py --rows distance.jsonl --picture step_distance.png     # needs hood-cloth[charts]
    python benchmarks/step_distance.py --cost                                # its share of a rollout's time

States are steps of rollouts of 28 scenes by seven methods: two networks alone, five iterations after a network and after none,
the solver stopped after three iterations and where it is done, and six sweeps of block descent. Scenes have 1,000 to 12,000
vertices, 15 to 120 frames a second, fabrics from silk to leather, layers and outfits. None of them gave a constant of the
estimate; how many iterations it takes was chosen with nine of them in sight. From every state the solver goes on to a relative
gradient of 1e-6: how far the vertices have moved by then (99th percentile over those that are free) is the true distance.
Another minimum may be nearer: that is the one the solver goes to.

Near the limit of the verdict rollouts look again (:mod:`hood.rollouts.verdict.distance`), and so do these.

Printed are, over all states and by method, size, frames a second and fabric: states, the median of the true distance, rank
correlation, and the shares of the estimates within a factor of 2 and of 4, of the states whose true or estimated distance is at
least 0.5 mm; less is on no picture. Then how often a limit on the estimate says of a step what the same limit on the true
distance says, over all states.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

import hood
from hood.cloth.state import State
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.evaluation.gap import StepSample
from hood.limits import DISTANCE_UNSOUND
from hood.rollouts import loop
from hood.rollouts.loop import simulate
from hood.rollouts.verdict.distance import distance_metrics, estimate
from hood.solver.newton import Further

#: Where the true end is, and the most iterations to there.
FINE, MOST = 1e-6, 400
#: Distances [mm] below which a factor means nothing, and limits that a verdict may have.
FLOOR, LIMITS = 0.5, (2, 3, 5, 8, 10, 15, 20, 30, 50)
#: Iterations whose ways are kept in a row.
KEPT = 6

METHODS: dict[str, dict[str, Any]] = {
    "newton": {"stepper": "newton"},
    "quickstart": {"checkpoint": "quickstart", "refine": 0},
    "edges": {"checkpoint": "edges", "refine": 0},
    "quickstart+5": {"checkpoint": "quickstart", "refine": 5},
    "guess+5": {"stepper": "refine", "refine": 5},
    "newton, 3 iterations": {"stepper": "newton", "solver": {"max_iterations": 3}},
    "6 sweeps": {"stepper": "refine", "refine": {"goal": 6, "method": "sweeps"}},
}


def _scene(garment: str | list[str], sequence: str, material: str = "default", fps: float = 30, **keys: Any) -> dict[str, Any]:
    return {"garment": garment, "sequence": sequence, "material": material, "fps": fps, "start": 0.5, **keys}


SCENES: dict[str, dict[str, Any]] = {
    "tshirt_twists": _scene("tshirt", "twists"),
    "trousers_march_leather": _scene("trousers", "walk_march", "nappa_leather"),
    "shorts_jog_denim": _scene("shorts", "jog", "denim"),
    "dress_disco_canvas": _scene("dress", "dance_disco", "cotton_canvas"),
    "longsleeve_lunges_felt": _scene("longsleeve", "lunges", "wool_felt"),
    "tank_bends_suiting": _scene("tank", "bends", "wool_suiting"),
    "skirt_squats_leather": _scene("skirt", "squats", "nappa_leather"),
    "shirt_raises_60": _scene("shirt", "arm_raises", "cotton_poplin", 60),
    "jacket_circle_canvas": _scene("jacket", "walk_circle", "cotton_canvas"),
    "dress_steps_60": _scene("dress", "side_steps", fps=60),
    "skirt_jog_15": _scene("skirt", "jog", fps=15),
    "tank_squats_24": _scene("tank", "squats", fps=24),
    "tshirt_run_crepe_120": _scene("tshirt", "run_on_spot", "silk_crepe", 120),
    "trousers_bends_leather_120": _scene("trousers", "bends", "nappa_leather", 120),
    "dress_slow_shape": _scene("dress", "dance_slow", betas=[-1.5, 2.0]),
    "outfit_tshirt_skirt": _scene(["tshirt", "skirt"], "twists"),
    "outfit_tank_trousers_leather": _scene(["tank", "trousers"], "walk_brisk", "nappa_leather"),
    "outfit_longsleeve_skirt_60": _scene(["longsleeve", "skirt"], "bends", fps=60),
    "tshirt_jog": _scene("tshirt", "jog"),
    "dress_march_linen": _scene("dress", "walk_march", "linen"),
    "shorts_twists_leather_60": _scene("shorts", "twists", "nappa_leather", 60),
    "tshirt_4k": _scene("tshirt_4k", "dance_disco"),
    "trousers_4k_canvas": _scene("trousers_4k", "lunges", "cotton_canvas"),
    "dress_4k_60": _scene("dress_4k", "twists", fps=60),
    "longsleeve_4k_leather": _scene("longsleeve_4k", "squats", "nappa_leather"),
    "outfit_4k": _scene(["tshirt_4k", "skirt_4k"], "side_steps"),
    "dress_12k": _scene("dress_12k", "squats"),
    "shorts_12k_leather": _scene("shorts_12k", "jog", "nappa_leather"),
}


def measure(potential: Potential, problem: StepProblem, pos: torch.Tensor) -> dict[str, Any]:
    """Estimate and true distance [mm] of a step, and what the iterations between them tell."""
    known = potential.prepare(problem)
    found, free = estimate(potential, known, pos, DISTANCE_UNSOUND.value * float(known.step.dt.max())), known.cloth.free
    way = Further(potential, known, pos)
    gone, steps, residuals = [], [], [way.residual]
    count = 0
    while way.residual > FINE and count < MOST and way.move():
        count += 1
        if count <= KEPT:
            gone.append(_p99(way.pos - pos, free))
            steps.append(_p99(way.direction, free))
            residuals.append(way.residual)
    true = torch.linalg.vector_norm(way.pos - pos, dim=1)[free]
    return {
        "estimate": 1e3 * found.p99,
        "estimate_max": 1e3 * found.most,
        "true": 1e3 * float(true.quantile(0.99)),
        "true_max": 1e3 * float(true.max()),
        "gone": gone,
        "steps": steps,
        "rg": residuals,
        "end_rg": way.residual,
        "iterations": count,
    }


def _p99(moved: torch.Tensor, free: torch.Tensor) -> float:
    """mm."""
    return 1e3 * float(torch.linalg.vector_norm(moved, dim=1)[free].quantile(0.99))


def rows_of(scene: str, method: str, starts: dict[str, State]) -> Iterable[dict[str, Any]]:
    """States of one rollout. ``starts`` keeps where rollouts of a scene begin, which is the same for all methods."""
    words = SCENES[scene]
    frames = round(10 + 8 * (words["fps"] / 15) ** 0.7) if "12k" not in scene else 12
    simulation = hood.simulate(**words, **METHODS[method], num_frames=frames, metrics="none", guard="off")
    sample, start = StepSample(range(3, frames), 3 if "12k" in scene else 4), None
    if scene in starts:
        like, known = simulation.scene.cloth.rest_pos, starts[scene]
        start = State(known.pos.to(like), known.vel.to(like), known.origin)
    rolled = simulate(
        simulation.stepper, simulation.scene, simulation.potential, frames, observe=sample, metrics="none",
        settle="equilibrium", start=start,
    )  # fmt: skip
    for frame in rolled:
        starts.setdefault(scene, frame.state)
    garment = words["garment"]
    known = {
        "scene": scene, "method": method, "fabric": words["material"], "fps": words["fps"],
        "vertices": simulation.scene.cloth.num_vertices, "garments": 1 if isinstance(garment, str) else len(garment),
    }  # fmt: skip
    for problem, prediction in sample.steps:
        yield {**known, **measure(simulation.potential, problem, prediction.next_pos)}


def collect(path: Path, scenes: Iterable[str], methods: Iterable[str]) -> None:
    """Add the rows that the file lacks."""
    done = {(row["scene"], row["method"]) for row in read(path)}
    starts: dict[str, State] = {}
    for scene in scenes:
        for method in methods:
            if (scene, method) in done:
                continue
            found = list(rows_of(scene, method, starts))
            with path.open("a", encoding="utf-8") as file:
                file.writelines(json.dumps(row) + "\n" for row in found)
            print(f"{scene} {method}: " + ", ".join(f"{row['estimate']:.2f} / {row['true']:.2f}" for row in found), flush=True)


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a file; none where there is no file."""
    return [json.loads(text) for text in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def arrays(rows: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Estimates and true distances (N,) mm."""
    found, true = (np.array([row[key] for row in rows]) for key in ("estimate", "true"))
    return found, true


def line(title: str, rows: list[dict[str, Any]]) -> str:
    """The figures of some rows."""
    found, true = arrays(rows)
    seen = np.maximum(found, true) >= FLOOR
    if not seen.any():
        return f"{title:24}{len(rows):8}{0:8}"
    ratio = found[seen] / true[seen]
    ranks = [np.argsort(np.argsort(values)) for values in (found, true)]
    within = (np.mean((ratio <= factor) & (ratio >= 1 / factor)) for factor in (2, 4))
    shares = "".join(f"{share:9.1%}" for share in within)
    spread = "".join(f"{value:8.2f}" for value in np.quantile(ratio, (0.05, 0.5, 0.95)))
    return f"{title:24}{len(rows):8}{seen.sum():8}{np.median(true):9.2f}{np.corrcoef(*ranks)[0, 1]:8.3f}{shares}{spread}"


def report(rows: list[dict[str, Any]]) -> str:
    """The tables."""
    sizes = ((0, 2500, "1,000 to 2,500 vertices"), (2500, 6000, "4,000 to 6,000"), (6000, 10**6, "8,000 to 12,000"))
    groups: list[tuple[str, Callable[[dict[str, Any]], bool]]] = [("all", lambda row: True)]
    groups += [(method, lambda row, method=method: row["method"] == method) for method in METHODS]
    groups += [(title, lambda row, a=a, b=b: a <= row["vertices"] < b) for a, b, title in sizes]
    groups += [("outfits", lambda row: row["garments"] > 1)]
    groups += [(f"{fps:g} fps", lambda row, fps=fps: row["fps"] == fps) for fps in sorted({row["fps"] for row in rows})]
    groups += [(name, lambda row, name=name: row["fabric"] == name) for name in sorted({row["fabric"] for row in rows})]
    heads = ("states", "≥ 0.5", "true mm", "rank", "×2", "×4", "5%", "median", "95%")
    widths = (8, 8, 9, 8, 9, 9, 8, 8, 8)
    lines = [" " * 24 + "".join(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True))]
    for title, belongs in groups:
        chosen = [row for row in rows if belongs(row)]
        lines += [line(title, chosen)] if chosen else []
    found, true = arrays(rows)
    lines += ["", "limit [mm]  beyond it  said the same  false alarms  missed"]
    for limit in LIMITS:
        alarms, misses = (found > limit) & (true <= limit), (found <= limit) & (true > limit)
        same = np.mean((found > limit) == (true > limit))
        lines.append(f"{limit:10}{np.mean(true > limit):11.1%}{same:15.1%}{np.mean(alarms):14.1%}{np.mean(misses):8.1%}")
    own = 1e3 * DISTANCE_UNSOUND.value / np.array([row["fps"] for row in rows])
    alarms, misses = (found > own) & (true <= own), (found <= own) & (true > own)
    same = np.mean((found > own) == (true > own))
    shares = f"{np.mean(true > own):11.1%}{same:15.1%}{np.mean(alarms):14.1%}{np.mean(misses):8.1%}"
    lines.append(f"{'verdict':10}{shares}   ({DISTANCE_UNSOUND.value:g} m/s times the time step)")
    missed = sum(row["end_rg"] > FINE for row in rows)
    lines.append(f"\n{missed} of {len(rows)} ends missed a relative gradient of {FINE:g}")
    return "\n".join(lines)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """The scatter as a picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.6), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    span = np.array([1e-3, 500.0])
    axes.fill_between(span, span / 2, 2 * span, color="0.92", label="within a factor of 2")
    axes.plot(span, span, color="0.6", linewidth=0.8)
    for method in METHODS:
        found, true = arrays([row for row in rows if row["method"] == method])
        axes.scatter(np.maximum(true, span[0]), np.maximum(found, span[0]), s=9, alpha=0.7, label=method)
    axes.set(xscale="log", yscale="log", xlim=span, ylim=span, aspect="equal")
    axes.set(xlabel="true distance to the minimum, 99th percentile over vertices [mm]", ylabel="estimate [mm]")
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(path)


def cost(garments: Iterable[str], motions: Iterable[str], frames: int) -> None:
    """Print the share of a rollout's processor time that measuring takes, with everything else as it is by default."""
    for garment in garments:
        for motion in motions:
            for method in ("quickstart", "quickstart+5", "guess+5", "newton"):
                inside = [0.0, 0.0]
                began, whole = time.process_time(), 0.0
                with mock.patch.object(loop, "distance_metrics", _timed(inside)):
                    for frame in hood.simulate(garment, motion, num_frames=frames, **METHODS[method]):
                        if frame.index == 0:
                            began = time.process_time()  # the start at rest is no part of it
                        whole = time.process_time() - began
                share, each = inside[0] / whole, 1e3 * inside[0] / inside[1]
                print(f"{garment:12}{motion:16}{method:14}{share:7.1%} of {whole:6.1f} s, {each:6.1f} ms each", flush=True)


def _timed(inside: list[float]) -> Callable[..., dict[str, float]]:
    def run(*given: Any) -> dict[str, float]:
        began = time.process_time()
        found = distance_metrics(*given)
        inside[0] += time.process_time() - began
        inside[1] += 1
        return found

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=Path, help="JSON lines of the states; what is missing is added")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES), metavar="SCENE", help="to add")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS), metavar="METHOD")
    parser.add_argument("--picture", type=Path, help="the scatter as a PNG")
    parser.add_argument("--cost", action="store_true", help="measure the time instead")
    parser.add_argument("--garments", nargs="+", default=["tshirt", "dress", "tshirt_4k", "dress_4k"], help="of --cost")
    parser.add_argument("--motions", nargs="+", default=["walk_proud", "dance_mixed"], help="of --cost")
    parser.add_argument("--frames", type=int, default=31, help="of --cost")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # what scenes say of themselves
    if chosen.cost:
        cost(chosen.garments, chosen.motions, chosen.frames)
        return
    if chosen.rows is None:
        parser.error("--rows says where the states are kept")
    collect(chosen.rows, chosen.scenes, chosen.methods)
    rows = read(chosen.rows)
    print(report(rows))
    if chosen.picture is not None:
        draw(rows, chosen.picture)


if __name__ == "__main__":
    main()

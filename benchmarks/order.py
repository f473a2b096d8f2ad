"""The paper's order of Fine15, Ours and Fine48 where physics predicts one: against (radius of the schedule) / ℓ.

    nice python benchmarks/order.py train --kernels compiled   # every run of the family; goes on where it was stopped
    python benchmarks/order.py exact                           # the same scenes without a network, see order_exact
    python benchmarks/order.py report --figure docs/order.png  # the table of what is there, and the figure

The influence of a load decays over ℓ = c_p dt in one implicit step: a schedule whose radius, edges times their length, is
shorter than that cannot be told of it. The family (:mod:`order_scenes`) is of cloth that hangs from shaken pins; from one
scene to the next the frame rate changes on one mesh, or the mesh at one frame rate. Every run is ``hood train`` and ``hood
evaluate`` in processes of their own (:mod:`recipes`), on motions that were not trained on.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from order_exact import PatchStepper, about, make_scene, own_rollout
from order_report import Results, comparisons, draw, exact_table, read_rows, table, write_csv
from order_scenes import Hanging, write_body, write_scene
from recipes import ONE_PASS, Recipe, cell, fast, folder_of, run

from hood.assets.body.load import load_body
from hood.assets.files.atomic import write_atomically
from hood.model.graph.builder import parse_schedule, radius

SCHEDULES = ("fine15", "ours", "fine48")
#: In the order in which they are trained: first what spans the ratios, then what separates edge from frame rate.
FAMILY = (
    Hanging("strip", 0.012, 30),
    Hanging("strip", 0.024, 30),
    Hanging("strip", 0.024, 60),
    Hanging("strip", 0.024, 120),
    Hanging("strip", 0.036, 30),
    Hanging("strip", 0.012, 60),
    Hanging("strip", 0.024, 240),
    Hanging("dress", 0.036, 30),
    Hanging("dress", 0.036, 120),
)
#: Scenes trained with every seed before the next ones begin.
FIRST = 4
UPDATES, LATENT = 200, 16
#: Frames of the longest training rollout and of the evaluated ones; states of each whose gap is computed.
HORIZON, STATES = 24, 4
#: Edges from the pins up to which they are felt in :func:`order_exact.floors`.
RADII = (4, 8, 15, 24, 31, 48, 64)
#: Radii of steps that are exact as far as they go, and the motions of which they take rollouts: many minimisations each.
PATCHES, PATCHED = (15, 48), 2
EXACT = "exact.json"


def recipe(scene: Hanging, schedule: str, updates: int, folder: Path) -> Recipe:
    """The training of a schedule on a scene: one garment, one fabric, one body, so that the ratio is one number."""
    stone = folder / "stone.npz"
    garment, motions, held_out = write_scene(scene, load_body(stone), folder)
    shared = (f"garments=[{garment}]", f"body={stone}")
    base = fast(
        f"{scene.name}/{schedule}_{updates}",
        updates,
        *ONE_PASS,
        f"model.schedule={schedule}",
        f"model.latent_dim={LATENT}",
        f"trainer.horizon.maximum={HORIZON}",
        f"trainer.schedule.warmup={max(updates // 10, 1)}",
        *(f"data.{text}" for text in shared),
        f"data.sequences=[{','.join(map(str, motions))}]",
        f"data.fps={scene.fps}",
        "data.sampling={beta_range:0,size_range:[1,1],piecewise_fraction:0,material:{}}",
    )
    length = (f"fps={scene.fps}", f"num_frames={HORIZON}", f"gap_states={STATES}", "gap_iterations=100")
    return Recipe(base.name, base.overrides, (*shared, f"sequences=[{','.join(map(str, held_out))}]", *length))


def train(updates: int, seeds: list[int], output: Path, kernels: str) -> None:
    """Train and evaluate what is not done yet, one after the other."""
    folder = scene_folder(output)
    begin = time.monotonic()
    for scenes in (FAMILY[:FIRST], FAMILY[FIRST:]):
        for seed in seeds:
            for scene in scenes:
                for schedule in SCHEDULES:
                    one = recipe(scene, schedule, updates, folder)
                    row = run(one, seed, output, kernels)
                    whole = {"scene": scene.name, "schedule": schedule, "ratio": ratio(scene, schedule), **row}
                    write_atomically(folder_of(output, one, seed) / "row.json", json.dumps(whole).encode())
                    done = f"{one.name}, seed {seed}: γ {cell(row.get('gap'))}"
                    print(f"{time.monotonic() - begin:6.0f} s  {done}", file=sys.stderr)


def exact(output: Path) -> None:
    """What the solver says about every scene, by its name; goes on where it was stopped."""
    folder, known = scene_folder(output), read_exact(output)
    for scene in FAMILY:
        stone = folder / "stone.npz"
        garment, _, motions = write_scene(scene, load_body(stone), folder)
        scenes = [make_scene(garment, stone, motion, scene.fps) for motion in motions]
        entry = known.setdefault(scene.name, {})
        if "floors" not in entry:
            entry |= about(scenes, RADII, HORIZON, STATES)
        for number in PATCHES:
            if f"patch{number}" not in entry:
                entry[f"patch{number}"] = own_rollout(PatchStepper(number), scenes[:PATCHED], HORIZON, STATES)
                write_atomically(output / EXACT, json.dumps(known).encode())
        print(exact_table(Results([scene], SCHEDULES, [], known)), flush=True)


def read_exact(output: Path) -> dict[str, dict[str, Any]]:
    """What :func:`exact` has written so far."""
    path = output / EXACT
    return json.loads(path.read_text()) if path.exists() else {}


def scene_folder(output: Path) -> Path:
    """Where the scenes' files are, with the body in place."""
    folder = (output / "scenes").absolute()
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "stone.npz").exists():
        write_body(folder / "stone.npz")
    return folder


def report(updates: int, output: Path, figure: Path | None) -> None:
    """Print what is there of the runs, and draw it."""
    known = read_exact(output)
    rows = [row for row in read_rows(output, updates) if "newton" in known.get(row["scene"], {})]
    if not rows:
        sys.exit(f"{output} holds no runs of {updates} updates beside exact steps; first: order.py train, then order.py exact")
    results = Results(FAMILY, SCHEDULES, rows, known)
    write_csv(output / "order.csv", results)
    print(exact_table(results), table(results), comparisons(results), sep="\n\n")
    if figure is not None:
        draw(results, figure)


def ratio(scene: Hanging, schedule: str) -> float:
    """Radius of the schedule [m] over ℓ."""
    return radius(parse_schedule(schedule)) * scene.edge / scene.reach


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("train", "exact", "report"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--updates", type=int, default=UPDATES)
    parser.add_argument("--kernels", choices=("torch", "compiled"), default="torch", help="of every training, see hood train")
    parser.add_argument("--output", type=Path, default=Path("runs/order"))
    parser.add_argument("--figure", type=Path, default=None, help="PNG that the report draws")
    arguments = parser.parse_args()
    if arguments.what == "train":
        train(arguments.updates, arguments.seeds, arguments.output, arguments.kernels)
    elif arguments.what == "exact":
        exact(arguments.output)
    else:
        report(arguments.updates, arguments.output, arguments.figure)


if __name__ == "__main__":
    main()

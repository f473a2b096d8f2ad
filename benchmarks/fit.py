"""Parameters found again by ``hood fit`` from frames of known ones: how far off, and whether the interval says so.

    python benchmarks/fit.py [--seeds 10] [--only sheet dress size friction points]

``sheet``: a swinging sheet of 144 vertices, 60 frames, air at rest, four numbers of the fabric, each begun five times too high
or too low. ``dress``: the dress on a walking body, 30 frames with noise of 2 mm. ``size``: 1.07, of the tank, 10 frames, 2 mm.
``friction``: a sheet that slides off a ball, 30 frames with 2 mm. ``points``: the sheet as 300 points a frame that belong to no
vertices, with 1 mm, from three times off.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import hood
from hood.mesh.shapes import grid, sphere

Truth = dict[str, float]
FABRIC = {"density": 0.15, "lame_mu": 5e3, "lame_lambda": 8e3, "bending_stiffness": 2e-4}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", nargs="+", choices=[*BARS], default=[*BARS])
    arguments = parser.parse_args()
    print("| scene | seed | parameter | true | begun at | found | off | 95% | inside | met | s |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for name in arguments.only:
        allowed, make = BARS[name]
        met = []
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            with tempfile.TemporaryDirectory() as folder:
                rows = [*run(name, seed, allowed, make, Path(folder))]
            met.append(all(row[-2] == "yes" for row in rows))
            print("\n".join(f"| {' | '.join(row)} |" for row in rows), flush=True)
        print(
            f"{name}: {sum(met)} of {len(met)} within {100 * allowed:g}%, or the interval says that it cannot, and holds it",
            flush=True,
        )


def run(name: str, seed: int, allowed: float, make: Callable[..., Any], folder: Path) -> Iterator[list[str]]:
    rng, begun = np.random.default_rng(seed), time.perf_counter()
    truth, guess, scene, fitted = make(rng, folder)
    frames, more = seen(rng, truth, scene, fitted)
    found = hood.fit(frames, parameters=[*truth], guess=guess, output=str(folder / "fit"), **scene, **more)
    seconds = time.perf_counter() - begun
    for key, true in truth.items():
        one = found["parameters"][key]
        off, inside = abs(one["value"] / true - 1.0), one["low"] <= true <= one["high"]
        cannot = one["high"] / one["low"] > (1.0 + allowed) ** 2  # says that the data cannot tell it to what is allowed
        met = off <= allowed or (cannot and inside)
        values = f"{true:.4g}", f"{guess[key]:.4g}", f"{one['value']:.4g}", f"{100 * off:.2f}%"
        span = f"{one['low']:.4g} to {one['high']:.4g}" + ("" if one["seen"] else ", not seen")
        end = "yes" if met and found["converged"] else "no"
        yield [name, str(seed), key, *values, span, "yes" if inside else "no", end, f"{seconds:.0f}"]


def seen(rng: np.random.Generator, truth: Truth, scene: dict[str, Any], how: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Frames of the truth, with noise, or as points on the surface."""
    keys: dict[str, Any] = {**scene, "num_frames": how["frames"], "stepper": "newton", "metrics": "none"}
    keys |= {"solver": {"target_rg": 1e-7}} | (truth if "size" in truth else {"material": truth})
    simulation = hood.simulate(**keys)
    frames = [frame.world_pos.numpy() for frame in simulation]
    if "points" not in how:
        return np.stack(frames) + how["noise"] * rng.normal(size=(len(frames), *frames[0].shape)), {}
    points = []
    for pos in frames:
        corners = pos[simulation.faces[rng.integers(len(simulation.faces), size=how["points"])]]
        points.append((rng.dirichlet((1, 1, 1), how["points"])[:, :, None] * corners).sum(axis=1))
    return [one + how["noise"] * rng.normal(size=one.shape) for one in points], {"points": True}


def begun_off(rng: np.random.Generator, truth: Truth, factor: float = 5.0) -> Truth:
    return {key: value * factor ** rng.choice([-1, 1]) for key, value in truth.items()}


def varied(rng: np.random.Generator, values: Truth) -> Truth:
    return {key: value * 2.0 ** rng.uniform(-1, 1) for key, value in values.items()}


def swinging(folder: Path, edge: int = 12) -> dict[str, Any]:
    pos, faces = grid(edge, edge, 0.4)
    trimesh.Trimesh(pos + [0, 1, 0], faces, process=False).export(folder / "sheet.obj")
    return {"garment": str(folder / "sheet.obj"), "body": "none", "pins": [0, edge - 1], "settle": 0, "wind": 0}


def sheet(rng: np.random.Generator, folder: Path) -> Any:
    truth = varied(rng, FABRIC)
    return truth, begun_off(rng, truth), swinging(folder), {"frames": 60, "noise": 0.0}


def dress(rng: np.random.Generator, folder: Path) -> Any:
    usual = {"density": 0.2, "lame_mu": 23600.0, "lame_lambda": 44400.0, "bending_stiffness": 4e-5}
    truth = varied(rng, usual)
    scene = {"garment": "dress", "sequence": "walk_proud", "wind": 0}
    return truth, begun_off(rng, truth), scene, {"frames": 30, "noise": 2e-3}


def size(rng: np.random.Generator, folder: Path) -> Any:
    return {"size": 1.07}, {"size": 1.0}, {"garment": "tank", "sequence": "walk_proud"}, {"frames": 10, "noise": 2e-3}


def friction(rng: np.random.Generator, folder: Path) -> Any:
    ball, faces = sphere(3, 0.15)
    trimesh.Trimesh(ball + [0, 1, 0], faces, process=False).export(folder / "ball.obj")
    pos, cells = grid(10, 10, 0.25)
    trimesh.Trimesh(pos + [-0.04, 1.153, -0.11], cells, process=False).export(folder / "sheet.obj")
    scene = {"garment": str(folder / "sheet.obj"), "body": str(folder / "ball.obj"), "settle": 0, "worn": False}
    truth = {"friction": 0.4 * 2.0 ** rng.uniform(-1, 1)}
    return truth, begun_off(rng, truth, 2.0), scene, {"frames": 30, "noise": 2e-3}


def points(rng: np.random.Generator, folder: Path) -> Any:
    truth = varied(rng, FABRIC)
    return truth, begun_off(rng, truth, 3.0), swinging(folder), {"frames": 30, "noise": 1e-3, "points": 300}


#: Allowed error, and scene, by name.
BARS = {
    "sheet": (0.02, sheet),
    "points": (0.15, points),
    "size": (0.005, size),
    "friction": (0.2, friction),
    "dress": (0.15, dress),
}


if __name__ == "__main__":
    main()

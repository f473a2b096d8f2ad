"""What gradients of loosely solved rollouts are off by, beside what ``hood.differentiable(…).gradients`` says of it.

    python benchmarks/gradient_errors.py [--cases 100] [--first 0]

Case k, by its seed: a hanging sheet, one in the wind, one that falls on a ball, or a garment on a walking body; 1 to 10 steps
solved to rg 1e-1 to 1e-4; gradients by stiffness, density, bending, friction, gravity. The true error
is that against steps solved to 1e-10.
An estimate covers a case where it is no smaller than the true error, for every parameter.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

import hood
from hood.cloth.state import State
from hood.energies.friction import Friction
from hood.mesh.shapes import grid, sphere
from hood.rollouts.gradients import SAFETY, DifferentiableFrames, Gradients

EXACT = 1e-10
GARMENTS = ("tank", "skirt")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    arguments = parser.parse_args()
    covered, ratios = [], []
    print("| case | scene | steps | target_rg | parameter | true error | estimate | covered | kinks |")
    print("|---" * 9 + "|")
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(arguments.first, arguments.first + arguments.cases):
            name, steps, target, found, exact = case(seed, Path(folder))
            held = True
            for key, one in exact.items():
                if not one.any():  # as by friction where nothing has moved yet
                    continue
                true = float((found.by[key] - one).norm() / one.norm())
                inside = true <= found.error[key]
                held &= inside
                ratios.append(true * SAFETY / found.error[key])
                row = f"{true:.2e}", f"{found.error[key]:.2e}", "yes" if inside else "no", str(len(found.jumps))
                print("| " + " | ".join([str(seed), name, str(steps), f"{target:.1e}", key, *row]) + " |", flush=True)
            covered.append(held)
    print(f"covered: {sum(covered)} of {len(covered)} cases, {sum(r <= SAFETY for r in ratios)} of {len(ratios)} gradients")
    print(
        "true error over the difference of the two, 50%, 90%, 95%, 100%:", np.round(np.quantile(ratios, [0.5, 0.9, 0.95, 1]), 3)
    )


def case(seed: int, folder: Path) -> tuple[str, int, float, Gradients, dict[str, Tensor]]:
    rng = np.random.default_rng(seed)
    name = ("hanging", "wind", "ball", "hanging", "wind", "ball", "ball", "garment")[seed % 8]
    steps, target = int(rng.integers(1, 11 if name != "garment" else 4)), float(10 ** rng.uniform(-4, -1))
    keys: dict[str, Any] = {"num_frames": steps + 1, "stepper": "newton", "metrics": "none"}
    if name == "garment":
        keys |= {"garment": str(rng.choice(GARMENTS)), "sequence": "walk_brisk"}
    else:
        pos, faces = grid(int(rng.integers(4, 9)), int(rng.integers(4, 9)), float(rng.uniform(0.15, 0.4)))
        pos += rng.normal(0.0, 1e-3, pos.shape) + [-0.07, 0.154 if name == "ball" else 0.0, -0.1]
        trimesh.Trimesh(pos, faces, process=False).export(folder / "sheet.obj")
        keys |= {"garment": str(folder / "sheet.obj"), "settle": 0, "worn": False}
        keys |= {"body": "none", "pins": [0, 1]} if name != "ball" else {"body": str(ball(folder)), "pins": "none"}
        keys |= {"wind": rng.uniform(-4, 4, 3).tolist()} if name == "wind" else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        weights = rng.normal(size=3)
        goal = rng.normal(0.0, 0.1, 3)

        def loss(states: list[State]) -> Tensor:
            last = states[-1]
            if seed % 16 < 8:
                return (last.pos.sin() * torch.as_tensor(weights)).sum() + 0.01 * last.vel.square().sum()
            return torch.stack([(one.pos - torch.as_tensor(goal)).square().sum() for one in states]).sum()

        values = {"lame_mu": 23600.0, "density": 0.2, "bending_stiffness": 4e-5, "g": -9.81, "friction": 0.5}
        scale = {key: value * 3.0 ** rng.uniform(-1, 1) for key, value in values.items() if key != "g"} | {"g": -9.81}
        frames, exactly = (followed({**keys, "solver": {"target_rg": to}}, scale) for to in (target, EXACT))
        found, given = frames.gradients(loss), exactly._given
        exact = torch.autograd.grad(loss(list(exactly)), list(given.values()))
    return name, steps, target, found, dict(zip(given, exact, strict=True))


def ball(folder: Path) -> Path:
    if not (folder / "ball.obj").exists():
        pos, faces = sphere(2, 0.15)
        trimesh.Trimesh(pos, faces, process=False).export(folder / "ball.obj")
    return folder / "ball.obj"


def followed(keys: dict[str, Any], values: dict[str, float]) -> DifferentiableFrames:
    of = {key: torch.tensor(value, dtype=torch.float64, requires_grad=True) for key, value in values.items()}
    simulation = hood.simulate(**keys)
    potential = simulation.potential
    if str(keys.get("body")) != "none":
        potential = potential.with_terms(friction=Friction(of["friction"]))  # type: ignore[arg-type]
    zero = torch.zeros((), dtype=torch.float64)
    gravity = torch.stack([zero, of["g"], zero])
    fabric: dict[str, Any] = {key: of[key] for key in ("lame_mu", "density", "bending_stiffness")}
    return hood.differentiable(simulation, potential=potential, gravity=gravity, **fabric)


if __name__ == "__main__":
    main()

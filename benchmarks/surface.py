"""How much of the cloth the skin cuts, and how much cloth passes through cloth, in rollouts of a network and of the solver.

    python benchmarks/surface.py                                             # seven garments of 1,000 vertices
    python benchmarks/surface.py tshirt_4k trousers_4k dress_4k dress_12k --motions walk_proud --frames 30

Rollouts as of ``hood rollout``: embedded body, default fabric, the motions of the validation list. A line per rollout as soon
as it is done, then a table over the motions: mean and worst share of the cloth's triangles that the body's true surface cuts,
the greatest height of skin above the cloth, mean and worst number of pairs of the cloth's triangles that pass through each
other, over every --stride-th frame, the first and the last.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
import torch

from hood.assets.body import load_body
from hood.assets.garment import load_garment
from hood.assets.library import locate, motion_split
from hood.assets.sequence import load_sequence
from hood.dynamics.checkpoint import load_simulator
from hood.dynamics.rollout import simulate
from hood.dynamics.stepper import NewtonStepper, Stepper
from hood.dynamics.surface import SURFACE_METRICS, SURFACE_STRIDE, SurfaceMeter
from hood.losses.potential import default_potential
from hood.nn.compiled import KERNELS, check_kernels
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings

GARMENTS = ("tshirt", "longsleeve", "tank", "dress", "skirt", "trousers", "shorts")
HEADER = f"{'':38}{'cut, mean':>11}{'worst':>8}{'frame':>7}{'skin, mm':>10}{'crossings':>11}{'worst':>7}"


def make_stepper(name: str, kernels: str) -> Stepper:
    """``newton`` with the command's accuracy, or the weights of that name."""
    if name == "newton":
        return NewtonStepper(default_potential(), NewtonSettings(target_rg=1e-2))
    simulator = load_simulator(locate("weights", name)).eval()
    check_kernels(kernels, "fp32", simulator.network.latent_dim, torch.device("cpu"))
    simulator.network.use_kernels(kernels)
    return simulator


def measure(stepper: Stepper, scene: Scene, num_frames: int, stride: int) -> np.ndarray:
    """(N, 1 + 5): number of the frame and :data:`SURFACE_METRICS` of the measured frames."""
    meter, rows = SurfaceMeter(scene.garment, scene.motion.faces), []
    count = min(num_frames, scene.num_frames)
    for frame in simulate(stepper, scene, default_potential(), count, metrics="none"):
        if frame.index % stride == 0 or frame.index + 1 == count:
            found = meter(frame.world_pos.numpy(), frame.body_pos.numpy())
            rows.append([frame.index, *(found[key] for key in SURFACE_METRICS)])
    return np.array(rows)


def line(title: str, rows: np.ndarray) -> str:
    """Figures of measured frames; those that are not finite count as a whole surface cut."""
    frame, share, _, depth, own, _ = rows.T
    share = np.where(np.isfinite(share), share, 1.0)
    own, depth = np.nan_to_num(own), np.nan_to_num(depth)
    worst = int(share.argmax())
    return (
        f"{title:38}{share.mean():>11.2%}{share[worst]:>8.2%}{frame[worst]:>7.0f}{1e3 * depth.max():>10.1f}"
        f"{own.mean():>11.1f}{own.max():>7.0f}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garments", nargs="*", default=GARMENTS)
    parser.add_argument("--steppers", nargs="+", default=["quickstart", "newton"], help="newton, or weights")
    parser.add_argument("--motions", nargs="+", default=motion_split()["validation"])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--stride", type=int, default=SURFACE_STRIDE)
    parser.add_argument("--kernels", default="torch", choices=KERNELS, help="of the network; compiled ones round differently")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    body, steppers = load_body("default"), {name: make_stepper(name, chosen.kernels) for name in chosen.steppers}
    table: dict[str, list[np.ndarray]] = {}
    print(HEADER)
    for motion in chosen.motions:
        for garment in chosen.garments:
            scene = build_scene(load_garment(garment), body, load_sequence(motion, 30.0))
            for name, stepper in steppers.items():
                rows = measure(stepper, scene, chosen.frames, chosen.stride)
                table.setdefault(f"{garment} {name}", []).append(rows)
                print(line(f"{garment} {name} {motion}", rows), flush=True)
    print(f"\n{HEADER}")
    for title in sorted(table):
        print(line(title, np.concatenate(table[title])))


if __name__ == "__main__":
    main()

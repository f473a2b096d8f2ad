"""How much of the cloth the skin cuts, and how much cloth passes through cloth, in rollouts of a network and of the solver.

    python benchmarks/surface.py                                             # seven garments of 1,000 vertices
    python benchmarks/surface.py tshirt_4k trousers_4k dress_4k dress_12k --motions walk_proud --frames 30
    python benchmarks/surface.py --steppers newton quickstart+5 --reach constant   # contact as it was; a network refined
    python benchmarks/surface.py --cloth-contact off                         # layers of cloth go through each other

Rollouts as of ``hood rollout``: embedded body, default fabric, the motions of the validation list, layers of cloth kept apart
where the solver takes or refines the steps. A line per rollout as soon
as it is done, then a table over the motions: mean and worst share of the cloth's triangles that the body's true surface cuts,
the same apart from those that are caught where the body passes through itself, the greatest height of skin above the cloth,
mean and worst number of pairs of the cloth's triangles that pass through each other, over every --stride-th frame, the first
and the last; of all frames the median distance of the vertices that touch from the skin, the iterations (median and 95th
percentile), the steps that missed the solver's accuracy, and the time.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from hood.assets.body.load import load_body
from hood.assets.files.library import locate, motion_split
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.contact.sample_points import PLACES, REACHES
from hood.energies.contact import SIDES
from hood.energies.potential import Potential, default_potential
from hood.energies.self_contact import LayerBarrier, for_networks
from hood.mesh.closest_point.search import search_surface
from hood.model.kernels.block import KERNELS, check_kernels
from hood.rollouts.loop import simulate
from hood.rollouts.verdict.surface import SURFACE_METRICS, SURFACE_STRIDE, SurfaceMeter
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.checkpoint import load_simulator
from hood.steppers.newton import NewtonStepper, Stepper
from hood.steppers.refined import RefinedStepper
from hood.steppers.stopping import Count

GARMENTS = ("tshirt", "longsleeve", "tank", "dress", "skirt", "trousers", "shorts")
HEADER = (
    f"{'':38}{'cut, mean':>11}{'worst':>8}{'frame':>7}{'apart':>8}{'worst':>8}{'skin, mm':>10}{'crossings':>11}{'worst':>7}"
    f"{'off, mm':>9}{'iterations':>12}{'p95':>5}{'missed':>8}{'ms':>8}"
)
#: Vertices as near to the skin as this [m] count as in touch.
TOUCH = 0.02


class Measured(NamedTuple):
    """A rollout."""

    rows: np.ndarray  # (N, 1 + 6 + 1) number, SURFACE_METRICS and median distance [m] from the skin of the measured frames
    steps: np.ndarray  # (T, 4) solver's iterations, whether converged, ms, refining iterations of all frames but the first


def solves(name: str) -> bool:
    """Whether the solver takes or refines the steps."""
    return name == "newton" or "+" in name


def make_stepper(name: str, kernels: str, potential: Potential) -> Stepper:
    """``newton`` with the command's accuracy, or the weights of that name; ``NAME+K`` refines them by K iterations."""
    if name == "newton":
        return NewtonStepper(potential, NewtonSettings(target_rg=1e-2))
    weights, _, refine = name.partition("+")
    simulator = load_simulator(locate("weights", weights)).eval()
    check_kernels(kernels, "fp32", simulator.network.latent_dim, torch.device("cpu"))
    simulator.network.use_kernels(kernels)
    simulator.use_potential(for_networks(potential))
    return RefinedStepper(simulator, potential, Count(int(refine))) if refine else simulator


def measure(stepper: Stepper, scene: Scene, potential: Potential, num_frames: int, stride: int) -> Measured:
    """One rollout."""
    meter, rows, steps = SurfaceMeter(scene.garment, scene.motion.faces), [], []
    count = min(num_frames, scene.num_frames)
    faces = torch.as_tensor(scene.motion.faces, dtype=torch.int64)
    scenes = [
        torch.zeros(size, dtype=torch.int64) for size in (scene.cloth.num_vertices, scene.motion.num_vertices, len(faces))
    ]
    for frame in simulate(stepper, scene, potential, count, metrics="none"):
        taken = [frame.metrics.get(key, np.nan) for key in ("solver_iterations", "solver_converged", "ms_total")]
        steps.append([*taken, frame.metrics.get("refine_iterations", np.nan)])
        if frame.index % stride == 0 or frame.index + 1 == count:
            found = meter(frame.world_pos.numpy(), frame.body_pos.numpy())
            dist = search_surface(frame.world_pos.double(), scenes[0], frame.body_pos.double(), faces, *scenes[1:]).dist
            off = float(dist[(dist < TOUCH) & scene.cloth.free].median())
            rows.append([frame.index, *(found[key] for key in SURFACE_METRICS), off])
    return Measured(np.array(rows), np.array(steps[1:]))


def line(title: str, measured: Measured) -> str:
    """Figures of measured frames; those that are not finite count as a whole surface cut."""
    frame, share, _, depth, own, _, folds, off = measured.rows.T
    share = np.where(np.isfinite(share), share, 1.0)
    own, depth, folds = np.nan_to_num(own), np.nan_to_num(depth), np.nan_to_num(folds)
    worst = int(share.argmax())
    return (
        f"{title:38}{share.mean():>11.2%}{share[worst]:>8.2%}{frame[worst]:>7.0f}"
        f"{(share - folds).mean():>8.2%}{(share - folds).max():>8.2%}{1e3 * depth.max():>10.1f}"
        f"{own.mean():>11.1f}{own.max():>7.0f}{1e3 * np.median(off):>9.2f}{_effort(measured.steps)}"
    )


def _effort(steps: np.ndarray) -> str:
    solved, converged, time, refined = steps.T
    used = refined if np.isnan(solved).all() else solved
    iterations = f"{np.median(used):>12.0f}{np.quantile(used, 0.95):>5.0f}" if len(used) else f"{'':17}"
    missed = f"{int((converged == 0).sum()):>8}" if np.isfinite(converged).any() else f"{'':8}"
    return f"{iterations}{missed}{np.median(time):>8.1f}"


def joined(parts: Sequence[Measured]) -> Measured:
    """Several rollouts as one."""
    return Measured(np.concatenate([part.rows for part in parts]), np.concatenate([part.steps for part in parts]))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garments", nargs="*", default=GARMENTS)
    parser.add_argument(
        "--steppers", nargs="+", default=["quickstart", "newton"], help="newton, weights, or weights+iterations"
    )
    parser.add_argument("--reach", default="curvature", choices=REACHES, help="of contact")
    parser.add_argument("--contact", default="vertices", choices=PLACES, help="where the cloth meets the body")
    parser.add_argument("--sides", default="both", choices=SIDES, help="of folds of the body that cloth is kept off")
    parser.add_argument("--cloth-contact", default="auto", choices=["auto", "off"], help="of layers of cloth with each other")
    parser.add_argument("--motions", nargs="+", default=motion_split()["validation"])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--stride", type=int, default=SURFACE_STRIDE)
    parser.add_argument("--kernels", default="torch", choices=KERNELS, help="of the network; compiled ones round differently")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    body, plain = load_body("default"), default_potential(contact=chosen.contact, reach=chosen.reach, sides=chosen.sides)
    layered = plain.with_terms(layers=LayerBarrier()) if chosen.cloth_contact == "auto" else plain
    potentials = {name: layered if solves(name) else plain for name in chosen.steppers}
    steppers = {name: make_stepper(name, chosen.kernels, potentials[name]) for name in chosen.steppers}
    table: dict[str, list[Measured]] = {}
    print(HEADER)
    for motion in chosen.motions:
        for garment in chosen.garments:
            parts = load_garment(garment), body, load_sequence(motion, 30.0)
            for name, stepper in steppers.items():
                scene = build_scene(*parts, dtype=torch.float64 if solves(name) else torch.float32)
                measured = measure(stepper, scene, potentials[name], chosen.frames, chosen.stride)
                table.setdefault(f"{garment} {name}", []).append(measured)
                print(line(f"{garment} {name} {motion}", measured), flush=True)
    print(f"\n{HEADER}")
    for title in sorted(table):
        print(line(title, joined(table[title])))
    for name in steppers:
        print(
            line(f"all {name}", joined([part for title, parts in table.items() if title.split()[1] == name for part in parts]))
        )


if __name__ == "__main__":
    main()

"""What a guard looks at in rollouts of nominal cloth, and how often it would speak: where its limits come from.

    python benchmarks/guard.py                    # quickstart, quickstart+5 and newton on the validation list
    python benchmarks/guard.py --steppers small-ours --garments dress tshirt --motions walk_proud --frames 30
    python benchmarks/guard.py --cost             # also its time: rollouts with and without it, by turns
    python benchmarks/guard.py --mode repair      # with guard=repair, which also looks for triangles in the skin

Rollouts as of ``hood rollout`` with ``metrics=none`` and ``guard=report``. A line per rollout: median, 99.5th percentile and
maximum of the relative gradient, of the typical vertex's force (of networks alone), of the strain p99, of the body's turn
[degrees] and way [m] in a step, and the alarms; at the end the same over all, and the share of steps that ``guard=repair``
would repair. With ``--cost`` the time of a frame with the guard over that without.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from surface import GARMENTS, make_stepper, solves

from hood.assets.body.load import load_body
from hood.assets.files.library import motion_split
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier
from hood.model.kernels.block import KERNELS
from hood.rollouts.checks.guard import Guard
from hood.rollouts.checks.step_repair import step_quality
from hood.rollouts.loop import simulate
from hood.scene.jumps import moved_in_step
from hood.scene.scene import Scene, build_scene
from hood.steppers.network import Prediction
from hood.steppers.newton import Stepper

COLUMNS = ("rg", "typical", "strain", "turn", "way")


class Watched(Guard):
    """A guard that keeps what it looks at."""

    def __init__(self, mode: str, stepper: Stepper, potential: Potential, alone: bool) -> None:
        super().__init__(mode, stepper, potential)
        self.rows: list[list[float]] = []
        self._typical = alone

    def see(self, frame: int, problem: StepProblem, prediction: Prediction, figures: Any = None) -> Prediction:
        found = step_quality(self._potential, problem, prediction, figures, typical=self._typical)
        self.rows.append([found.residual, found.typical, found.strain, *moved_in_step(problem.step.obstacle)])
        return super().see(frame, problem, prediction, figures)


def times(stepper: Stepper, scene: Scene, potential: Potential, frames: int, mode: str | None) -> np.ndarray:
    """Milliseconds of the frames of a rollout with a guard of this mode; None for none."""
    guard = None if mode is None else Guard(mode, stepper, potential)
    rolled = simulate(stepper, scene, potential, frames, metrics="none", settle="equilibrium", guard=guard)
    return np.array([frame.metrics["ms_total"] for frame in rolled if frame.index > 1])


def cost(mode: str, stepper: Stepper, scene: Scene, potential: Potential, frames: int, rounds: int = 4) -> float:
    """Time of a frame with a guard over that without: the median over frames of the least over rounds that take turns."""
    both = [[times(stepper, scene, potential, frames, one) for one in (None, mode)] for _ in range(rounds)]
    without, with_it = (np.min([one[index] for one in both], axis=0) for index in (0, 1))
    return float(np.median(with_it / without))


def line(title: str, rows: np.ndarray, repaired: int, alarms: int) -> str:
    """Figures of steps (N, 5)."""
    parts = [
        f"{name} {np.nanmedian(values):.3g} {np.nanquantile(values, 0.995):.3g} {np.nanmax(values):.3g}"
        for name, values in zip(COLUMNS, rows.T, strict=True)
        if np.isfinite(values).any()
    ]
    return f"{title:38} {' | '.join(parts)} | alarms {alarms}, repairs {repaired} of {len(rows)} ({repaired / len(rows):.2%})"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garments", nargs="*", default=GARMENTS)
    parser.add_argument("--motions", nargs="+", default=motion_split()["validation"])
    parser.add_argument("--steppers", nargs="+", default=["quickstart", "quickstart+5", "newton"])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--kernels", default="torch", choices=KERNELS, help="of the network")
    parser.add_argument("--mode", default="report", choices=("report", "repair"), help="repair also looks at the skin")
    parser.add_argument("--cost", action="store_true", help="also the time")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    body, plain = load_body("default"), default_potential()
    for name in chosen.steppers:
        potential = plain.with_terms(layers=LayerBarrier()) if solves(name) else plain
        stepper, kept, counts = make_stepper(name, chosen.kernels, potential), [], np.zeros(2, int)
        for motion in chosen.motions:
            for garment in chosen.garments:
                real = torch.float64 if solves(name) else torch.float32
                scene = build_scene(load_garment(garment), body, load_sequence(motion, 30.0), dtype=real)
                guard = Watched(chosen.mode, stepper, potential, alone=not solves(name))
                for _ in simulate(stepper, scene, potential, chosen.frames, metrics="none", settle="equilibrium", guard=guard):
                    pass
                rows = np.array(guard.rows)
                found = np.array([sum(alarm.mendable for alarm in guard.alarms), len(guard.alarms)])
                kept, counts = [*kept, rows], counts + found
                ratio = f", time ×{cost(chosen.mode, stepper, scene, potential, chosen.frames):.3f}" if chosen.cost else ""
                print(line(f"{name} {garment} {motion}", rows, *found) + ratio, flush=True)
        print(line(f"all {name}", np.concatenate(kept), *counts), flush=True)


if __name__ == "__main__":
    main()

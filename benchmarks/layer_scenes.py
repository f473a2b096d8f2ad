"""Cloth that meets cloth in small scenes at four time steps: folding strip, sheet over a bar, sheets on a ball, stack of ten.

    python benchmarks/layer_scenes.py --seconds 1
    python benchmarks/layer_scenes.py --scenes stack --rates 30 --engine torch --friction 0

Prints, per scene and time step: pairs of triangles that pass through each other in the worst frame (by
:mod:`hood.mesh.crossing`, which shares nothing with the solver's search), the least distance of two features at the end of a
step, iterations (mean, 95th percentile, most), steps that missed the accuracy, and milliseconds of CPU time of a step.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the tests' own scenes
from layer_scenes import SCENES

from hood.dynamics.march import Marched, march
from hood.losses.layer_friction import LayerFriction
from hood.losses.layers import LayerBarrier
from hood.losses.potential import Potential, default_potential
from hood.mesh.crossing import self_crossings
from hood.solver.newton import NewtonSettings


@dataclass
class Line:
    """One scene at one time step."""

    pairs: int = 0
    least: float = float("inf")  # m
    missed: list[int] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)

    def add(self, index: int, step: Marched, spent: float) -> None:
        """Take a step into account."""
        pos = step.state.pos.numpy()
        self.pairs = max(self.pairs, len(self_crossings(pos, step.problem.cloth.faces.numpy())))
        found = step.problem.layers[0].layers.contacts(pos)
        gap = np.linalg.norm(np.einsum("nc,nck->nk", found.weights, pos[found.corners]), axis=1)
        self.least = min(self.least, gap.min(initial=self.least))
        self.iterations.append(step.report.iterations)
        self.milliseconds.append(spent)
        if not bool(step.report.converged.all()):
            self.missed.append(index)

    def __str__(self) -> str:
        most, p95 = max(self.iterations), np.percentile(self.iterations, 95)
        return (
            f"pairs {self.pairs:3d}   least {1e3 * self.least:.2g} mm   iterations {np.mean(self.iterations):5.1f} / {p95:.0f}"
            f" / {most}   missed {len(self.missed)} of {len(self.iterations)}   {np.mean(self.milliseconds):.0f} ms"
        )


def timed(steps: Iterator[Marched]) -> Iterator[tuple[Marched, float]]:
    """Steps with the milliseconds of CPU time that each took."""
    began = time.process_time()
    for step in steps:
        yield step, 1e3 * (time.process_time() - began)
        began = time.process_time()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--rates", nargs="+", type=float, default=[240.0, 60.0, 30.0, 15.0], help="steps a second")
    parser.add_argument("--seconds", type=float, default=1.0, help="of simulated time")
    parser.add_argument("--friction", type=float, default=0.5, help="coefficient between layers")
    parser.add_argument("--engine", default="auto", help="form of the solver: auto, compiled or torch")
    args = parser.parse_args()
    potential: Potential = default_potential().with_terms(layers=LayerBarrier())
    if args.friction > 0:
        potential = potential.with_terms(layer_friction=LayerFriction(args.friction))
    for rate in args.rates:
        for name in args.scenes:
            line, steps = Line(), max(1, round(args.seconds * rate))
            marched = march(potential, SCENES[name](1 / rate), steps, NewtonSettings(engine=args.engine))
            for index, (step, spent) in enumerate(timed(marched)):
                line.add(index, step, spent)
            print(f"{name:17s} 1/{rate:<4g} {line}", flush=True)


if __name__ == "__main__":
    main()

"""How many minima a step has, and how far apart: what limits the certainty of γ.

    python benchmarks/minima.py dress_4k walk_proud
    python benchmarks/minima.py tshirt_4k dance_mixed

A network alone dresses the body. At five of its steps the potential is minimised from three starts, as for γ: the inertial
guess, the positions before the step and those after it. Then every minimum is shaken twice, by 2 mm at every vertex, and
minimised again; the lower one is kept. Printed is how far the minima lie above the lowest of the three [e0], how far single
vertices are from where they are in the first one, where shaking led, and how many minimisations did not converge.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from hood.assets.body.load import load_body
from hood.assets.files.library import locate
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.energies.potential import default_potential, scale
from hood.energies.problem import StepProblem
from hood.evaluation.gap import REFERENCE, StepSample, starts
from hood.rollouts.loop import simulate
from hood.scene.scene import build_scene
from hood.solver.newton import minimize
from hood.solver.system.iterate import in_double
from hood.steppers.checkpoint import load_simulator

FRAMES, STATES, SHAKES, SHAKE = 24, 5, 2, 2e-3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garment", nargs="?", default="dress_4k")
    parser.add_argument("sequence", nargs="?", default="walk_proud")
    parser.add_argument("--checkpoint", default="small-ours")
    arguments = parser.parse_args()
    potential, sample = default_potential(), StepSample(range(3, FRAMES), STATES)
    scene = build_scene(load_garment(arguments.garment), load_body(), load_sequence(arguments.sequence))
    simulator = load_simulator(locate("weights", arguments.checkpoint))
    for _ in simulate(simulator, scene, potential, num_frames=FRAMES, observe=sample):
        pass
    generator = torch.Generator().manual_seed(0)
    print(f"{'above the lowest [e0]':28}{'apart [mm]':22}{'shaken [e0]':28}{'lower by':10}unconverged")
    for problem, prediction in sample.steps:
        work = in_double(potential.prepare(problem))
        unconverged = 0

        def minimum(start: Tensor | None, work: StepProblem = work) -> tuple[float, Tensor]:
            """Potential [e0] and positions (V, 3) m where the minimisation from ``start`` ends."""
            nonlocal unconverged
            pos, report = minimize(potential, work, start, REFERENCE)
            unconverged += int(not bool(report.converged.all()))
            return float(report.phi / scale(work)), pos

        minima = [minimum(start) for start in starts(work, prediction.next_pos)]
        shaken = []
        for best in minima:
            for _ in range(SHAKES):
                noise = SHAKE * torch.randn(best[1].shape, generator=generator, dtype=torch.float64)
                best = min(best, minimum(best[1] + noise), key=lambda found: found[0])
            shaken.append(best[0])
        lowest = min(phi for phi, _ in minima)
        above = " ".join(f"{phi - lowest:8.4f}" for phi, _ in minima)
        apart = " ".join(f"{1e3 * float((pos - minima[0][1]).norm(dim=1).max()):6.1f}" for _, pos in minima)
        after = " ".join(f"{phi - lowest:8.4f}" for phi in shaken)
        print(f"{above:28}{apart:22}{after:28}{lowest - min(shaken):<10.4f}{unconverged} of {3 * (1 + SHAKES)}", flush=True)


if __name__ == "__main__":
    main()

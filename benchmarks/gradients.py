"""What derivatives of a rollout by the solver cost: time of a step forward and backward, and memory of many steps.

    python benchmarks/gradients.py
    python benchmarks/gradients.py --garments dress_4k --steps 4 --rounds 3 --memory-steps 20

The dress walks (`walk_brisk`), with contact and friction. The mean height of the last frame is differentiated by three numbers
of the fabric, through all positions and velocities in between. Rounds of so many steps forward and backward follow each other;
of their times a step the medians are told. Memory is what a process of its own, which takes so many steps forward and backward,
needs more than it had before.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import time

import torch

import hood
from hood.cloth.cloth import with_values
from hood.cloth.state import State
from hood.rollouts.differentiable import differentiable_states
from hood.steppers.newton import NewtonStepper
from hood.tensors.batch import to_device

FABRIC = {"lame_mu": 23600.0, "density": 0.2022, "bending_stiffness": 3.96e-5}


class Round:
    """Steps from the same start, each time by new tensors."""

    def __init__(self, garment: str, motion: str, steps: int) -> None:
        simulation = hood.simulate(garment, motion, num_frames=steps + 1, stepper="newton", metrics="none")
        assert isinstance(simulation.stepper, NewtonStepper)
        self._stepper, self._scene, self._steps = simulation.stepper, simulation.scene, steps
        self.start: State = next(iter(simulation)).state
        self._cloth = to_device(simulation.scene.cloth, dtype=torch.float64)

    def __call__(self) -> tuple[float, float]:
        """Seconds of a step forward and backward."""
        fabric = {name: torch.tensor(value, dtype=torch.float64, requires_grad=True) for name, value in FABRIC.items()}
        began = time.perf_counter()
        *_, last = differentiable_states(
            self._stepper, self._scene, self.start, self._steps, with_values(self._cloth, **fabric)
        )
        between = time.perf_counter()
        last.pos[:, 1].mean().backward()
        return (between - began) / self._steps, (time.perf_counter() - between) / self._steps


def peak() -> int:
    """Bytes that this process has had in memory at most."""
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size if sys.platform == "darwin" else 1024 * size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garments", nargs="+", default=["dress", "dress_4k"])
    parser.add_argument("--motion", default="walk_brisk")
    parser.add_argument("--steps", type=int, default=8, help="of a round")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--memory-steps", type=int, default=100, help="0: memory is not measured")
    parser.add_argument("--only-memory", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.only_memory:
        Round(given.garments[0], given.motion, 1)()
        many = Round(given.garments[0], given.motion, given.memory_steps)
        before = peak()
        many()
        print(peak() - before)
        return
    memory = f"MB, {given.memory_steps} steps"
    print(f"{'garment':12}{'vertices':>10}{'forward ms':>12}{'backward ms':>13}{'ratio':>7}{memory:>16}")
    for garment in given.garments:
        run = Round(garment, given.motion, given.steps)
        run()  # compiles, and fills tables
        times = [run() for _ in range(given.rounds)]
        ahead, back = (1e3 * statistics.median(column) for column in zip(*times, strict=True))
        ratio = statistics.median(b / a for a, b in times)
        memory = ""
        if given.memory_steps:
            command = [sys.executable, *sys.argv, "--only-memory", "--garments", garment]
            memory = f"{int(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1]) / 1e6:.0f}"
        print(f"{garment:12}{len(run.start.pos):>10}{ahead:>12.1f}{back:>13.1f}{ratio:>7.2f}{memory:>16}")


if __name__ == "__main__":
    main()

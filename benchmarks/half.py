"""What storing weights in float16 changes: ``hood convert half=true`` first, then

    python benchmarks/half.py run/model.safetensors small.safetensors

Both models predict the same steps from the same states, those of the first one's rollouts on a held-out motion; printed is how
far the positions they predict lie apart, and how far the accelerations.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from hood.assets.body.load import load_body
from hood.assets.files.library import locate
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.rollouts.loop import simulate
from hood.scene.scene import build_scene
from hood.steppers.checkpoint import load_simulator
from hood.steppers.network import NetworkStepper, Prediction
from hood.steppers.refined import prepare_stepper

START = 5  # frames that are not compared: the start settles


@torch.no_grad()
def compare(
    first: NetworkStepper, second: NetworkStepper, garment: str, sequence: str, num_frames: int
) -> tuple[float, float, float]:
    """Root of the mean square and largest distance of the next positions [mm], and the accelerations' median relative one."""
    scene = build_scene(load_garment(garment), load_body(), load_sequence(sequence).window(0, num_frames))
    steps: list[tuple[StepProblem, Prediction]] = []

    def keep(_: int, problem: StepProblem, prediction: Prediction) -> None:
        steps.append((problem, prediction))

    for _ in simulate(first, scene, default_potential(), num_frames, metrics="none", observe=keep):
        pass
    prepared = prepare_stepper(second, scene)
    apart, relative = [], []
    for problem, own in steps[START:]:
        other = second.predict(second.search(problem), prepared)
        apart.append((other.next_pos - own.next_pos).norm(dim=1))
        relative.append(((other.acc - own.acc).square().mean() / own.acc.square().mean()).sqrt())
    distance = 1e3 * torch.cat(apart)
    return float(distance.square().mean().sqrt()), float(distance.max()), float(torch.stack(relative).median())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first")
    parser.add_argument("second")
    parser.add_argument("--garments", nargs="+", default=["tshirt", "dress"])
    parser.add_argument("--sequence", default="walk_proud")
    parser.add_argument("--frames", type=int, default=30)
    arguments = parser.parse_args()
    first, second = (load_simulator(Path(locate("weights", name))) for name in (arguments.first, arguments.second))
    print("| garment | positions, root mean square mm | largest mm | accelerations |\n|---|---|---|---|")
    for garment in arguments.garments:
        rms, most, acc = compare(first, second, garment, arguments.sequence, arguments.frames)
        print(f"| {garment} | {rms:.4f} | {most:.3f} | {100 * acc:.3f}% |")


if __name__ == "__main__":
    main()

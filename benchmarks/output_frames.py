"""How near interpolated frames (``output_fps``) are to simulated ones.

    python benchmarks/output_frames.py dance_mixed jog

A dress is simulated at 120 steps a second. Every fourth frame is kept, as of 30 a second, and the frames between are
interpolated and compared with those that were simulated there: by ``output_fps``, on a straight line, and by a cubic with the
velocities of the states, which are those of the steps before. The last columns are of the cloth of ``output_fps`` on the body
where the motion has it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

import hood
from hood.assets.garment.binding import signed_distances
from hood.rollouts.file.step_table import OutputRate
from hood.rollouts.frame import Frame
from hood.rollouts.frames import hermite, output_frames

FPS, EVERY = 120, 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", nargs="+", help="embedded motions")
    parser.add_argument("--garment", default="dress")
    parser.add_argument("--seconds", type=float, default=2.0)
    given = parser.parse_args()
    print(f"{'motion':12}{'way':>24}{'rms mm':>9}{'p99 mm':>9}{'worst mm':>10}{'in the body':>13}{'deepest mm':>12}")
    for motion in given.motions:
        count = round(given.seconds * FPS) + 1
        keys = {"stepper": "newton", "start": 1.0, "metrics": "none", "guard": "off"}
        simulation = hood.simulate(given.garment, motion, fps=FPS, num_frames=count, **keys)
        frames = list(simulation)
        kept = [replace(frame, index=index) for index, frame in enumerate(frames[::EVERY])]
        smooth = list(output_frames(iter(kept), OutputRate(FPS, FPS / EVERY), body=lambda index: frames[index].body_pos))  # noqa: B023
        ways = {"output_fps": [frame.world_pos for frame in smooth], **dict(plain_ways(kept))}
        for name, found in ways.items():
            between = [index for index in range(EVERY, len(found)) if index % EVERY]
            off = 1e3 * torch.cat([(found[at] - frames[at].world_pos).norm(dim=1) for at in between]).numpy()
            figures = f"{np.sqrt((off**2).mean()):9.2f}{np.quantile(off, 0.99):9.2f}{off.max():10.1f}"
            print(f"{motion:12}{name:>24}{figures}" + (on_the_body(smooth, simulation) if name == "output_fps" else ""))


def plain_ways(kept: list[Frame]) -> Iterator[tuple[str, list[Tensor]]]:
    """Positions at all frames: on straight lines, and by a cubic with the velocities of the steps before."""
    pos = [frame.world_pos for frame in kept]
    places = [(at // EVERY, at % EVERY / EVERY) for at in range((len(kept) - 1) * EVERY)]
    yield "straight line", [torch.lerp(pos[at], pos[at + 1], share) for at, share in places]
    ways = [pos[max(at, 1)] - pos[max(at, 1) - 1] for at in range(len(pos))]
    yield "velocities of states", [hermite(pos[at], pos[at + 1], ways[at], ways[at + 1], share)[0] for at, share in places]


def on_the_body(frames: list[Frame], simulation: hood.Simulation) -> str:
    """Share of the vertices inside the body and the deepest, of interpolated frames."""
    faces = simulation.scene.motion.faces
    chosen = [frame for frame in frames if not frame.simulated][::3]
    dist = np.concatenate([signed_distances(frame.world_pos.numpy(), frame.body_pos.numpy(), faces) for frame in chosen])
    return f"{(dist < 0).mean():13.3%}{max(-1e3 * float(dist.min()), 0.0):12.1f}"


if __name__ == "__main__":
    main()

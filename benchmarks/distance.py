"""How far a network's rollout is from the solver's after some frames, of all embedded garments and held-out motions.

    python benchmarks/distance.py                                    # quickstart, 1,000 vertices, 30 frames
    python benchmarks/distance.py small-ours --garments dress --frames 60

Both begin at the same rest and know no contact of cloth with cloth. Printed are distances of vertices at the last frame: the
root of the mean square over a garment's vertices, and the farthest one, in millimetres; and beside them how far cloth moves in
that time. Two rollouts of one chaotic system part in any case: what it says is how soon.
"""

from __future__ import annotations

import argparse
import statistics

import torch
from torch import Tensor

import hood
from hood.assets.files.library import motion_split


def last_frame(garment: str, motion: str, frames: int, **keys: object) -> tuple[Tensor, Tensor]:
    """World positions (V, 3) [m] at the last of the frames, and at the first."""
    positions = [
        frame.world_pos
        for frame in hood.simulate(
            garment, motion, num_frames=frames + 1, cloth_contact="off", metrics="none", guard="off", **keys
        )
    ]
    return positions[-1], positions[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", nargs="?", default="quickstart", help="name or file of a model")
    parser.add_argument("--garments", nargs="+", default="tshirt longsleeve tank trousers shorts skirt dress".split())
    parser.add_argument("--frames", type=int, default=30)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    motions = motion_split()["validation"]
    print(f"{'garment':14}{'motion':14}{'rms mm':>9}{'farthest':>10}{'moved':>9}")
    table: list[tuple[float, float]] = []
    for garment in arguments.garments:
        for motion in motions:
            exact, first = last_frame(garment, motion, arguments.frames, stepper="newton")
            found, _ = last_frame(garment, motion, arguments.frames, checkpoint=arguments.checkpoint, refine=0)
            apart, moved = 1e3 * (found - exact).norm(dim=1), 1e3 * (exact - first).norm(dim=1)
            rms, most = float(apart.square().mean().sqrt()), float(apart.max())
            table.append((rms, most))
            print(f"{garment:14}{motion:14}{rms:9.2f}{most:10.1f}{float(moved.square().mean().sqrt()):9.0f}", flush=True)
    rms, most = zip(*table, strict=True)
    print(f"median {statistics.median(rms):.2f} mm rms, worst {max(rms):.2f}")
    print(f"farthest vertex: median {statistics.median(most):.1f} mm")


if __name__ == "__main__":
    main()

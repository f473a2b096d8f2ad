"""A coarse garment whose stored mesh is finer (``refine_mesh``) beside one that is simulated finer.

    python benchmarks/refined_mesh.py

A dress of 1,000 vertices as simulated, with every face cut into four once and twice, and the dress of 4,400 vertices, all by
the solver on one motion. The angle is that between neighbouring faces, in the mean of all frames; triangles that the skin cuts,
pairs of triangles of the cloth that cross, and vertices in the body are those of the mesh that is stored.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

import hood
from hood.assets.garment.binding import signed_distances
from hood.mesh.editing.subdivision import Subdivision
from hood.mesh.geometry import face_normals
from hood.mesh.topology import hinges
from hood.rollouts.frame import Frame
from hood.rollouts.frames import refined_frames
from hood.rollouts.verdict.surface import SurfaceMeter


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garments", nargs=2, default=("dress", "dress_4k"), help="embedded garments, coarse and fine")
    parser.add_argument("--motion", default="dance_mixed")
    parser.add_argument("--frames", type=int, default=40)
    given = parser.parse_args()
    titles = ("simulated ms", "refined ms", "angle", "cut", "crossing", "in the body", "deepest mm")
    print(f"{'mesh':>20}" + "".join(f"{title:>14}" for title in titles))
    for name, times in zip(given.garments, ((0, 1, 2), (0,)), strict=True):
        keys = {"stepper": "newton", "start": 1.0, "metrics": "none", "guard": "off"}
        simulation = hood.simulate(name, given.motion, num_frames=given.frames, **keys)
        frames = list(simulation)
        spent = float(np.median([frame.metrics["ms_total"] for frame in frames[2:]]))
        for levels in times:
            report(name, simulation, frames, levels, spent)


def report(name: str, simulation: hood.Simulation, frames: list[Frame], levels: int, spent: float) -> None:
    """A line of the table."""
    scene = simulation.scene
    finer = Subdivision(scene.garment.faces, scene.cloth.rest_pos.cpu().numpy(), levels)
    begin = time.perf_counter()
    stored = list(refined_frames(frames, finer, scene.motion.faces, scene.clearance)) if levels else frames
    refining = 1e3 * (time.perf_counter() - begin) / len(frames)
    pairs, faces = hinges(finer.faces).faces, torch.as_tensor(finer.faces)
    garment = hood.Garment(name, finer.rest_pos, finer.faces, np.zeros(finer.num_vertices, dtype=bool))
    meter = SurfaceMeter(garment, scene.motion.faces)
    angles, found, dist = [], [], []
    for frame in stored[::4]:
        normal = face_normals(frame.world_pos, faces).numpy()
        angles.append(np.degrees(np.arccos(np.clip((normal[pairs[:, 0]] * normal[pairs[:, 1]]).sum(axis=1), -1, 1))).mean())
        found.append(meter(frame.world_pos.numpy(), frame.body_pos.numpy()))
        dist.append(signed_distances(frame.world_pos.numpy(), frame.body_pos.numpy(), scene.motion.faces))
    inside, title = np.concatenate(dist), f"{name} {finer.num_vertices}"
    skin, crossing = (np.mean([one[key] for one in found]) for key in ("cut_face_share", "self_crossings"))
    print(
        f"{title:>20}{spent:14.1f}{refining:14.1f}{np.mean(angles):14.1f}{skin:14.3%}{crossing:14.2f}"
        f"{(inside < 0).mean():14.3%}{max(-1e3 * float(inside.min()), 0.0):14.2f}"
    )


if __name__ == "__main__":
    main()

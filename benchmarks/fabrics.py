"""What fabrics do to the parts of a garment: strain and bending, part by part, of rollouts of one garment and motion.

    hood rollout garment=dress sequence=walk_brisk num_frames=45 material=silk_habotai wind=null output=outputs/silk
    python benchmarks/fabrics.py outputs/silk outputs/denim outputs/two --garment dress --parts below_waistband above_waistband

Printed for each part, over all frames but the first ten: the 99th percentile of the stretch of edges; by how many degrees the
two faces of an edge are turned against their rest angle, on average; and the mean curvature that is, turn over the distance of
the centres of the faces.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch

import hood
from hood.assets.garment.parts import part_faces
from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.mesh.geometry import dihedral_angles
from hood.rollouts.file.reader import read_rollout
from hood.solver.step_figures import edge_strain

#: Frames in which the cloth is still taking up the motion.
LEAD = 10


def figures(path: Path, parts: dict[str, np.ndarray]) -> dict[str, tuple[float, float, float]]:
    """Stretch (99th percentile, a share), turn [degrees] and curvature [1/m] by part, of masks (F,)."""
    data = read_rollout(path / "rollout.h5" if path.is_dir() else path)
    cloth = build_cloth(data.rest_pos, data.cloth_faces, Material(), dtype=torch.float64)
    frames = [torch.as_tensor(pos, dtype=torch.float64) for pos in data.cloth_pos[LEAD:]]
    strain = np.stack([edge_strain(cloth, pos).numpy() for pos in frames])
    turn = np.stack([(dihedral_angles(pos, cloth.hinges) - cloth.rest_angle).numpy() for pos in frames])
    turn = np.abs(turn - 2.0 * math.pi * np.round(turn / (2.0 * math.pi)))
    apart = (2.0 * cloth.hinge_area / (3.0 * cloth.hinge_rest_length)).numpy()
    found = {}
    for name, faces in parts.items():
        inside = np.zeros(cloth.num_vertices, dtype=bool)
        inside[data.cloth_faces[faces].reshape(-1)] = True
        edges, hinges = inside[cloth.edges.numpy()].all(axis=1), inside[cloth.hinges.numpy()].all(axis=1)
        found[name] = (
            float(np.quantile(strain[:, edges], 0.99)),
            math.degrees(float(turn[:, hinges].mean())),
            float((turn[:, hinges] / apart[hinges]).mean()),
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rollouts", nargs="+", type=Path, help="rollout.h5, or the folder that holds it")
    parser.add_argument("--garment", default="dress", help="garment of the rollouts, whose parts are meant")
    parser.add_argument("--parts", nargs="+", default=["below_waistband", "above_waistband"])
    arguments = parser.parse_args()
    garment, body = hood.load_garment(arguments.garment), hood.load_body()
    parts = {name: part_faces(name, garment, body) for name in arguments.parts}
    print(f"{'rollout':<16}{'part':<18}{'stretch p99':>12}{'turn':>8}{'curvature':>12}")
    for path in arguments.rollouts:
        for name, (stretch, turn, curvature) in figures(path, parts).items():
            print(f"{path.name:<16}{name:<18}{100 * stretch:11.2f}%{turn:7.1f}°{curvature:8.2f} 1/m")


if __name__ == "__main__":
    main()

"""A garment file as found in the wild: centimetres, quads, torn texture seams, vertices inside the body."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hood.assets.body.body import Body
from hood.assets.garment.binding import push_out, signed_distances
from hood.assets.garment.garment import Garment
from hood.assets.garment.outfit import join_garments
from hood.mesh import topology
from hood.testing import cylinder

CENTIMETRES = 100.0


@dataclass(frozen=True)
class WildFile:
    """The file, and what was done to the garment that it shows."""

    path: Path
    garment: Garment  # before it was spoilt
    num_quads: int
    num_torn: int  # vertices that texture seams doubled
    num_inside: int


def write_wild_garment(path: Path, garments: dict[str, Garment], body: Body, share: float = 0.05) -> WildFile:
    """An OBJ of a T-shirt, shorts and an armband with every fault at once."""
    garment = join_garments([garments["tshirt"], garments["shorts"], armband(body)])
    assert garment.skin_pos is not None  # the T-shirt is drafted in another pose
    pos = garment.skin_pos.copy()
    chosen = np.random.default_rng(3).choice(len(pos), round(share * len(pos)), replace=False)
    pos[chosen] = sink(pos[chosen], body, 5e-3)
    assert garment.uv is not None
    assert garment.uv_faces is not None
    # A vertex of its own for every texture coordinate: what exporters make of a seam.
    pairs = np.unique(np.stack([garment.uv_faces.ravel(), garment.faces.ravel()], axis=1), axis=0)
    number = {tuple(pair): row for row, pair in enumerate(pairs.tolist())}
    corners = np.array(
        [[number[u, v] for u, v in zip(*row, strict=True)] for row in zip(garment.uv_faces, garment.faces, strict=True)]
    )
    torn = pos[pairs[:, 1]]
    quads, triangles = pair_up(corners)
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in CENTIMETRES * torn]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in garment.uv[pairs[:, 0]]]
    lines += ["f " + " ".join(f"{c + 1}/{c + 1}" for c in face) for face in [*quads, *triangles]]
    path.write_text("\n".join(lines) + "\n")
    inside = signed_distances(pos, body.v_template, body.faces) < 0
    return WildFile(path, garment, len(quads), len(torn) - len(pos), int(inside.sum()))


def armband(body: Body) -> Garment:
    """A tube around the left upper arm, bound to nothing."""
    tube, faces = cylinder(24, 8, radius=0.075, height=0.12)
    joints = body.shaped(np.zeros(10))[1]
    middle = 0.5 * (joints[16] + joints[18])
    pos = np.stack([tube[:, 1] - 0.06, tube[:, 0], -tube[:, 2]], axis=1) + middle
    pos = push_out(pos, body.v_template, body.faces, 6e-3).pos
    uv = np.stack([np.arctan2(tube[:, 2], tube[:, 0]) / 7 + 0.5, tube[:, 1] * 8], axis=1)
    return Garment("armband", pos, faces, np.zeros(len(pos), dtype=bool), uv=uv, uv_faces=faces)


def sink(points: np.ndarray, body: Body, depth: float) -> np.ndarray:
    """``points`` moved along the way to the skin until they are ``depth`` [m] inside."""
    moved = points.copy()
    for _ in range(4):
        dist = signed_distances(moved, body.v_template, body.faces)
        step = 1e-4 * np.eye(3)
        slope = np.stack([signed_distances(moved + d, body.v_template, body.faces) - dist for d in step], axis=1) / 1e-4
        moved -= (dist + depth)[:, None] * slope / np.maximum((slope**2).sum(axis=1, keepdims=True), 1e-6)
    return moved


def pair_up(faces: np.ndarray) -> tuple[list[list[int]], list[list[int]]]:
    """Quads of as many neighbouring triangles as a greedy walk finds, and the triangles left over."""
    hinges = topology.hinges(faces)
    edges = set(map(tuple, topology.unique_edges(faces).tolist()))
    used = np.zeros(len(faces), dtype=bool)
    quads = []
    for (a, b, c, d), (first, second) in zip(hinges.vertices.tolist(), hinges.faces.tolist(), strict=True):
        # Cut along its other diagonal, a quad around a vertex of three or four faces would double a face of another.
        if used[first] or used[second] or (min(c, d), max(c, d)) in edges:
            continue
        used[[first, second]] = True
        edges.add((min(c, d), max(c, d)))
        face = faces[first].tolist()
        forward = face[(face.index(a) + 1) % 3] == b
        quads.append([a, d, b, c] if forward else [b, d, a, c])
    return quads, faces[~used].tolist()

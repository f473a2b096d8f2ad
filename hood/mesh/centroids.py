"""Nearest face centroids: the body search of HOOD's published code, kept for comparisons with it."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from hood.mesh import geometry

#: Pairs evaluated at once on an accelerator: bounds the memory.
_CHUNK_PAIRS = 4_000_000


@torch.no_grad()
def nearest_centroids(
    points: Tensor, point_scene: Tensor, vertices: Tensor, faces: Tensor, face_scene: Tensor
) -> tuple[Tensor, Tensor]:
    """The face (N,) whose centroid is nearest to each point among those of its scene, and that distance (N,) [m].

    Faces without a normal (degenerate ones) are left out; without any other the distance is infinite. Not the nearest
    face: on faces of different sizes another one's surface may be closer. Not differentiable.

    Args:
        points: (N, 3) m.
        point_scene: (N,) scene of each point.
        vertices: (W, 3) m.
        faces: (G, 3) indices into ``vertices``.
        face_scene: (G,).
    """
    index = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    dist = points.new_full((len(points),), torch.inf)
    if len(faces) == 0:
        return index, dist
    centroids = vertices[faces].mean(dim=1)
    usable = geometry.face_normals(vertices, faces).any(dim=1)
    query = torch.nan_to_num(points, nan=0.0, posinf=0.0, neginf=0.0)
    for scene in point_scene.unique().tolist():
        rows = (point_scene == scene).nonzero().squeeze(1)
        targets = ((face_scene == scene) & usable).nonzero().squeeze(1)
        if len(targets):
            found, found_dist = _nearest(query[rows], centroids[targets])
            index[rows], dist[rows] = targets[found], found_dist
    return index, dist


def _nearest(points: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    if points.device.type == "cpu":
        dist, index = cKDTree(targets.numpy()).query(points.numpy(), workers=1)
        return torch.from_numpy(index), torch.from_numpy(dist).to(points.dtype)
    parts = []
    for chunk in points.split(max(1, _CHUNK_PAIRS // len(targets))):
        # The matrix-product form loses half the digits for points close to the surface.
        parts.append(torch.cdist(chunk, targets, compute_mode="donot_use_mm_for_euclid_dist").min(dim=1))
    return torch.cat([part.indices for part in parts]), torch.cat([part.values for part in parts])

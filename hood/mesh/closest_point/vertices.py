"""Nearest vertices within a radius: the search behind body edges, by a tree on a CPU and by all pairs elsewhere.

The three nearest vertices on a GPU, without a table of all pairs.

Nearest face centroids: the body search of HOOD's published code, kept for comparisons with it.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from hood.mesh import geometry
from hood.tensors.dense import has_triton

#: Pairs evaluated at once on an accelerator: bounds the memory.
_CHUNK_PAIRS = 4_000_000
#: Points of a program of :func:`nearest_three`, vertices that it looks at together, and its warps.
TILE, CHUNK, WARPS = 64, 64, 8


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


@torch.library.custom_op("hood::nearest_three", mutates_args=())
def nearest_three(
    points: Tensor, point_scene: Tensor, vertices: Tensor, vertex_scene: Tensor, usable: Tensor
) -> tuple[Tensor, Tensor]:
    """The nearest usable vertices (N, 3) of the same scene, ascending, the first of equals first, and distances (N, 3) [m],
    infinite where there is none; the nearest is then repeated. One kernel, in Triton.

    Args:
        points: (N, 3) m, finite. The others as in :func:`nearest_vertices`, scenes ascending.
    """
    index = torch.empty(len(points), 3, dtype=torch.int64, device=points.device)
    away = points.new_empty(len(points), 3)
    if len(points):
        given = (points.contiguous(), point_scene, vertices.contiguous(), vertex_scene, usable, index, away)
        _kernels().nearest_pass[(-(-len(points) // TILE),)](
            *given, len(points), len(vertices), TILE=TILE, CHUNK=CHUNK, num_warps=WARPS
        )
    return index, away


@nearest_three.register_fake
def _(points: Tensor, point_scene: Tensor, vertices: Tensor, vertex_scene: Tensor, usable: Tensor) -> tuple[Tensor, Tensor]:
    return torch.empty(len(points), 3, dtype=torch.int64, device=points.device), torch.empty_like(points)


@cache
def _kernels() -> Any:
    """The module of the kernel; imports Triton."""
    from hood.mesh.closest_point import triton_nearest

    return triton_nearest


class Nearest(NamedTuple):
    """Nearest vertices of N points."""

    vertex: Tensor  # (N,) int64, 0 where there is none
    dist: Tensor  # (N,) m, infinite where no vertex is closer than the radius


@torch.no_grad()
def nearest_vertices(
    points: Tensor,
    point_scene: Tensor | None,
    vertices: Tensor,
    vertex_scene: Tensor | None,
    usable: Tensor | None = None,
    radius: float = float("inf"),
) -> Nearest:
    """The nearest usable vertex of its own scene to every point, if it is closer than ``radius``.

    Among equally near vertices the choice is the same every time. Points that are not finite are searched for at the
    origin, vertices that are not finite are left out. Not differentiable. On an accelerator: :func:`nearest_dense`.

    Args:
        points: (N, 3) m.
        point_scene: (N,) scene of each point; None, here and below, where there is only one.
        vertices: (W, 3) m.
        vertex_scene: (W,).
        usable: (W,) bool, vertices that count; None for all of them.
        radius: [m].
    """
    if points.device.type != "cpu" or len(points) == 0:
        return nearest_dense(points, point_scene, vertices, vertex_scene, usable, radius)
    dist = points.new_full((len(points),), torch.inf)
    found = Nearest(torch.zeros(len(points), dtype=torch.int64), dist)
    query = torch.nan_to_num(points, nan=0.0, posinf=0.0, neginf=0.0).detach().numpy()
    candidates = _finite(vertices) if usable is None else _finite(vertices) & usable
    for rows, targets in _scenes(point_scene, vertex_scene, candidates):
        _search_tree(query, vertices.detach().numpy(), rows, targets, radius, found)
    return found


@torch.no_grad()
def nearest_dense(
    points: Tensor,
    point_scene: Tensor | None,
    vertices: Tensor,
    vertex_scene: Tensor | None,
    usable: Tensor | None = None,
    radius: float = float("inf"),
) -> Nearest:
    """The same as :func:`nearest_vertices` by all pairs, what an accelerator is fast at; the first of equals wins. With Triton
    these are pairs of one scene, which have to be ascending then.

    No shape depends on data and the host waits for nothing, so that the search can be part of a captured graph.
    """
    num_points, num_vertices = len(points), len(vertices)
    if num_points == 0 or num_vertices == 0:
        index = torch.zeros(num_points, dtype=torch.int64, device=points.device)
        return Nearest(index, points.new_full((num_points,), torch.inf))
    query = torch.nan_to_num(points, nan=0.0, posinf=0.0, neginf=0.0)
    candidates = _finite(vertices) if usable is None else _finite(vertices) & usable
    if has_triton(points.device):
        none = torch.zeros_like(candidates, dtype=torch.int64)
        scenes = (
            (none.new_zeros(num_points), none) if point_scene is None or vertex_scene is None else (point_scene, vertex_scene)
        )
        found, away = nearest_three(query, scenes[0], vertices, scenes[1], candidates)
        within = away[:, 0] < radius
        return Nearest(torch.where(within, found[:, 0], 0), torch.where(within, away[:, 0], torch.inf))
    targets = torch.where(candidates.unsqueeze(1), vertices, torch.inf)
    separate = False
    if point_scene is not None and vertex_scene is not None:
        separate = True
        query = torch.cat([query, point_scene.to(query).unsqueeze(1)], dim=1)
        targets = torch.cat([targets, vertex_scene.to(query).unsqueeze(1)], dim=1)
    rows = max(1, _CHUNK_PAIRS // num_vertices)
    axes = targets.t().contiguous()
    index = torch.cat([_squared_distances(chunk, axes, separate).argmin(dim=1) for chunk in query.split(rows)])
    offset = query - targets.index_select(0, index)
    dist = offset[:, :3].norm(dim=1)
    within = dist < radius
    if separate:
        within = within & (offset[:, 3] == 0)
    return Nearest(torch.where(within, index, 0), torch.where(within, dist, torch.inf))


def _squared_distances(points: Tensor, axes: Tensor, separate: bool) -> Tensor:
    """All pairs (N, W) of points (N, 3) and vertices by components (3, W); both with their scene as a fourth if ``separate``.

    Other scenes are infinitely far. Differences first: the matrix-product form loses half the digits of points close to
    the surface.
    """
    total = (points[:, :1] - axes[:1]).square_()
    for k in (1, 2):
        step = points[:, k : k + 1] - axes[k : k + 1]
        total.addcmul_(step, step)
    if separate:
        total.masked_fill_(points[:, 3:] != axes[3:], torch.inf)
    return total


def _scenes(
    point_scene: Tensor | None, vertex_scene: Tensor | None, candidates: Tensor
) -> list[tuple[np.ndarray | None, np.ndarray | None]]:
    """Per scene its points and its candidates as indices, None for all of them; scenes without either are left out."""
    if point_scene is None or vertex_scene is None or _one_scene(point_scene, vertex_scene):
        if bool(candidates.all()):
            return [(None, None)] if len(candidates) else []
        targets = np.flatnonzero(candidates.numpy())
        return [(None, targets)] if len(targets) else []
    pairs: list[tuple[np.ndarray | None, np.ndarray | None]] = []
    for scene in point_scene.unique().tolist():
        targets = np.flatnonzero((candidates & (vertex_scene == scene)).numpy())
        if len(targets):
            pairs.append((np.flatnonzero((point_scene == scene).numpy()), targets))
    return pairs


def _one_scene(point_scene: Tensor, vertex_scene: Tensor) -> bool:
    first = point_scene[:1]
    return bool((vertex_scene == first).all()) and bool((point_scene == first).all())


def _search_tree(
    points: np.ndarray,
    vertices: np.ndarray,
    rows: np.ndarray | None,
    targets: np.ndarray | None,
    radius: float,
    found: Nearest,
) -> None:
    """Fill ``rows`` of ``found`` with the nearest of ``targets``."""
    among = vertices if targets is None else vertices[targets]
    # Few points a query: large leaves and the median's approximation are faster to build and no slower to search.
    tree = cKDTree(among, leafsize=32, balanced_tree=False, compact_nodes=False)
    dist, index = tree.query(points if rows is None else points[rows], distance_upper_bound=radius, workers=1)
    index = np.where(index < len(among), index, 0)
    index = index if targets is None else np.where(np.isinf(dist), 0, targets[index])
    selected = slice(None) if rows is None else torch.from_numpy(rows)
    found.vertex[selected] = torch.from_numpy(index)
    found.dist[selected] = torch.from_numpy(dist).to(found.dist.dtype)


def _finite(vertices: Tensor) -> Tensor:
    """Vertices (W,) without infinite or undefined coordinates."""
    return torch.isfinite(vertices).all(dim=1)

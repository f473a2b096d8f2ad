"""The search of :func:`hood.mesh.closest_point.search.search_surface` without a shape that depends on data and without a wait
for the device: what a captured graph can hold."""

from __future__ import annotations

import torch
from torch import Tensor

from hood.mesh.closest_point.search import (
    CHUNK_PAIRS,
    LARGE_EDGE_RATIO,
    NUM_NEAREST,
    SMALL_SURFACE,
    Fans,
    Incidence,
    SurfaceHit,
    build_fans,
    closest_of_fans,
    gain,
    no_hit,
    pseudonormals,
    span,
    weights_and_offset,
)
from hood.mesh.closest_point.vertices import nearest_three
from hood.tensors.batch import gather_true
from hood.tensors.dense import at_once, has_triton, sum_scenes


@torch.no_grad()
def search_surface_fixed(
    points: Tensor,
    point_scene: Tensor,
    vertices: Tensor,
    faces: Tensor,
    vertex_scene: Tensor,
    face_scene: Tensor,
    incidence: Incidence,
    num_scenes: int,
    places: int,
) -> tuple[SurfaceHit, Tensor]:
    """Closest surface points, and the number (1,) of faces that have to be tested against every point.

    Those are the faces of small surfaces and faces much larger than the rest of theirs. ``places`` of them are tested: with
    fewer than there are, the search is to be repeated with more.

    Args:
        points, point_scene, vertices, faces, vertex_scene, face_scene: see
        :func:`hood.mesh.closest_point.search.search_surface`.
        incidence: of ``faces``, by :func:`hood.mesh.closest_point.search.build_incidence`.
        num_scenes: B.
    """
    if len(faces) == 0 or len(points) == 0:
        return no_hit(points), point_scene.new_zeros(1)
    fans = build_fans(vertices, incidence)
    nearest, nearest_dist = _nearest(points, point_scene, vertices, vertex_scene, incidence.valence > 0)
    face = closest_of_fans(points, vertices, nearest, incidence, fans)
    bary, offset = weights_and_offset(points, vertices, faces, face)
    exhaustive = _exhaustive(faces, vertex_scene, face_scene, incidence, fans, num_scenes)
    if places > 0:
        candidates = gather_true(exhaustive, places + 1)[:places]
        other, found = _closest_of(points, point_scene, vertices, faces, face_scene, candidates)
        other_bary, other_offset = weights_and_offset(points, vertices, faces, other)
        better = found & ((other_offset**2).sum(dim=1) < (offset**2).sum(dim=1))
        face, row = torch.where(better, other, face), better.unsqueeze(1)
        bary, offset = torch.where(row, other_bary, bary), torch.where(row, other_offset, offset)
    side = (offset * pseudonormals(vertices, faces, face, bary, incidence, fans)).sum(dim=1)
    dist = torch.where(side < 0, -1.0, 1.0) * offset.norm(dim=1)
    missing = torch.isinf(nearest_dist[:, 0])
    vertex = torch.where(missing, 0, nearest[:, 0])
    hit = SurfaceHit(vertex, nearest_dist[:, 0], face, bary, dist.masked_fill(missing, torch.inf))
    return hit, exhaustive.sum().reshape(1)


def _nearest(
    points: Tensor, point_scene: Tensor, vertices: Tensor, vertex_scene: Tensor, usable: Tensor
) -> tuple[Tensor, Tensor]:
    """The nearest usable vertices of the same scene (N, 3), ascending, and distances (N, 3), infinite where there is none; of
    fewer than three the nearest is repeated."""
    query = torch.nan_to_num(points, nan=0.0, posinf=0.0, neginf=0.0)
    if has_triton(points.device):
        return nearest_three(query, point_scene, vertices, vertex_scene, usable)
    count = min(NUM_NEAREST, len(vertices))
    index, dist = [], []
    rows = max(1, _pairs_at_once(query) // len(vertices))
    for chunk, scene in zip(query.split(rows), point_scene.split(rows), strict=True):
        pairs = torch.cdist(chunk, vertices, compute_mode="donot_use_mm_for_euclid_dist")
        pairs = pairs.masked_fill_(~usable | (scene.unsqueeze(1) != vertex_scene), torch.inf)
        nearest = pairs.topk(count, dim=1, largest=False, sorted=True)
        index.append(nearest.indices)
        dist.append(nearest.values)
    vertex, away = torch.cat(index), torch.cat(dist)
    vertex = torch.where(torch.isinf(away), vertex[:, :1], vertex)
    places = [min(place, count - 1) for place in range(NUM_NEAREST)]
    return torch.stack([vertex[:, i] for i in places], dim=1), torch.stack([away[:, i] for i in places], dim=1)


def _pairs_at_once(points: Tensor) -> int:
    """How many distances are in memory together: 16 MB of them in the cache of a CPU, 512 MB and few kernels on a GPU."""
    return 32 * CHUNK_PAIRS if at_once(points) else CHUNK_PAIRS


def _exhaustive(
    faces: Tensor, vertex_scene: Tensor, face_scene: Tensor, incidence: Incidence, fans: Fans, num_scenes: int
) -> Tensor:
    """Faces (G,) to test against every point of their scene: all of a small scene, else those at oversized edges."""
    length = fans.uu.sqrt().mean(dim=1)
    total = sum_scenes(length, vertex_scene, num_scenes)
    mean = total / sum_scenes(torch.ones_like(length), vertex_scene, num_scenes).clamp_min(1.0)
    limit_sq = (LARGE_EDGE_RATIO * mean.index_select(0, vertex_scene)) ** 2
    oversized = (fans.uu.amax(dim=1) > limit_sq) & (incidence.valence > 0)
    count = face_scene.new_zeros(num_scenes).index_add(0, face_scene, torch.ones_like(face_scene))
    around = oversized.index_select(0, faces.reshape(-1)).view(-1, 3).any(dim=1)
    return around | (count <= SMALL_SURFACE).index_select(0, face_scene)


def _closest_of(
    points: Tensor, point_scene: Tensor, vertices: Tensor, faces: Tensor, face_scene: Tensor, candidates: Tensor
) -> tuple[Tensor, Tensor]:
    """The closest of the faces ``candidates`` (P,) of the same scene to every point, and whether there is one; candidates
    beyond the last face are none."""
    there = candidates < len(faces)
    candidates = candidates.clamp_max(len(faces) - 1)
    corners = vertices[faces[candidates]]
    a, b, c = (list(corners[:, corner].t()) for corner in range(3))
    fan = span([y - x for x, y in zip(a, b, strict=True)], [y - x for x, y in zip(a, c, strict=True)])
    scene = torch.where(there, face_scene[candidates], -1)
    closest, found = [], []
    rows = max(1, _pairs_at_once(points) // (8 * len(candidates)))
    for chunk, of_points in zip(points.split(rows), point_scene.split(rows), strict=True):
        p = [chunk[:, i : i + 1] - a[i] for i in range(3)]
        best, place = gain(p, fan).masked_fill(of_points.unsqueeze(1) != scene, -torch.inf).max(dim=1)
        closest.append(candidates[place])
        found.append(~torch.isinf(best))
    return torch.cat(closest), torch.cat(found)

"""The bulge of a triangle surface: how far flat triangles that lie on it must keep clear of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from hood.mesh.geometry import normals_of_fans

if TYPE_CHECKING:
    from hood.mesh.proximity import Incidence

#: Curvatures are bounded by this [1/m]: a bulge of 25 mm radius. Fingers and slivers curve more.
MOST_CURVATURE = 40.0
#: A curvature is averaged so often with those of the faces around, so that a single edge does not stand out.
ROUNDS = 2


@torch.no_grad()
def convex_curvature(pos: Tensor, faces: Tensor, incidence: Incidence) -> Tensor:
    """Curvature [1/m] (W,) of the surface at its vertices, between 0 (flat, hollow) and :data:`MOST_CURVATURE`.

    The largest normal curvature over the edges at a vertex, (n_j − n_i)·(x_j − x_i)/‖x_j − x_i‖² with area-weighted vertex
    normals n: 1/r on a sphere, and around a cylinder, of radius r. Bounded, then averaged twice over the corners of the faces
    around. Edges without length, and vertices without faces or of no finite place, have none.

    The compiled search finds the same where the cloth is (:func:`hood.mesh.surface_tree.search`).

    Args:
        pos: (W, 3) m.
        faces: (G, 3), outward winding; open, closed or in several pieces.
        incidence: of ``faces``.
    """
    normals = normals_of_fans(pos, faces, incidence.around, incidence.first)
    start, end = faces.reshape(-1), faces.roll(-1, dims=1).reshape(-1)
    along = pos.index_select(0, end) - pos.index_select(0, start)
    turn = normals.index_select(0, end) - normals.index_select(0, start)
    length_sq = (along * along).sum(dim=1)
    bend = (turn * along).sum(dim=1) / length_sq.clamp_min(torch.finfo(pos.dtype).tiny)
    # Comparisons with not-a-number are false.
    bend = torch.where(bend > 0, bend, 0.0).clamp_max(MOST_CURVATURE)
    most = pos.new_zeros(len(pos)).scatter_reduce(0, torch.cat([start, end]), torch.cat([bend, bend]), "amax")
    for _ in range(ROUNDS):
        of_faces = most.index_select(0, faces.reshape(-1)).view(-1, 3).mean(dim=1, keepdim=True)
        most = functional.embedding_bag(incidence.around, of_faces, incidence.first, mode="mean").squeeze(1)
    return most

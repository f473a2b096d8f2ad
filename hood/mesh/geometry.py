"""Differential quantities of triangle meshes in torch: areas, normals, masses, dihedral angles, rest shapes.

All functions follow the dtype of the positions, are differentiable, and have finite values and gradients for
every finite input, degenerate triangles included.

The bulge of a triangle surface: how far flat triangles that lie on it must keep clear of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from hood.tensors.dense import add_rows

if TYPE_CHECKING:
    from hood.mesh.closest_point.search import Incidence


#: A triangle counts as degenerate when the sine between its edges is below this many units of rounding.
_DEGENERATE_ULPS = 8.0


def triangle_areas(pos: Tensor, faces: Tensor) -> Tensor:
    """Triangle areas [m²], shape (F,). Zero, with zero gradient, for degenerate faces."""
    return 0.5 * _safe_norm(_cross(pos, faces))


def face_normals(pos: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (F, 3), right-handed with the winding; the zero vector for degenerate faces."""
    cross, regular = _face_cross(pos, faces)
    length = torch.where(regular, (cross * cross).sum(dim=1), 1.0).sqrt()
    return torch.where(regular, 1.0 / length, 0.0).unsqueeze(1) * cross


def vertex_normals(pos: Tensor, faces: Tensor) -> Tensor:
    """Area-weighted unit normals (V, 3); zero where undefined (isolated vertex, cancelling faces)."""
    cross = _cross(pos, faces)
    return _unit(add_rows(torch.zeros_like(pos), faces.t().reshape(-1), cross.repeat(3, 1)))


def normals_of_fans(pos: Tensor, faces: Tensor, around: Tensor, first: Tensor, rows: Tensor | None = None) -> Tensor:
    """The same where the faces at every vertex are known, of the vertices ``rows`` (N,) or of all of them.

    Sums have a fixed order also on an accelerator, where those of :func:`vertex_normals` come as they come.

    Args:
        pos: (V, 3).
        faces: (F, 3).
        around: (3F,) faces by vertex (:class:`hood.mesh.closest_point.search.Incidence`).
        first: (V,) where those of each vertex begin.
    """
    total = functional.embedding_bag(around, _cross(pos, faces), first, mode="sum")
    return _unit(total if rows is None else total.index_select(0, rows))


def vertex_masses(rest_pos: Tensor, faces: Tensor, density: Tensor | float) -> Tensor:
    """Vertex masses [kg], shape (V,): a third of each incident face's mass.

    Args:
        rest_pos: (V, 3) m.
        faces: (F, 3).
        density: kg/m², one number or per face (F,).
    """
    share = triangle_areas(rest_pos, faces) * density / 3.0
    mass = rest_pos.new_zeros(rest_pos.shape[0])
    for corner in range(3):
        mass = add_rows(mass, faces[:, corner], share)
    return mass


def dihedral_angles(pos: Tensor, hinges: Tensor) -> Tensor:
    """Signed bending angles [rad] in (-π, π], shape (H,); 0 when flat, independent of the faces' winding.

    With e = x₁ - x₀ the shared edge and a, b the opposite vertices relative to x₀, the opposite-vertex
    normals are n₁ = e × a and n₂ = b × e, and θ = atan2(-‖e‖ n₁·b, n₁·n₂), which is atan2((n₁×n₂)·e, ‖e‖
    n₁·n₂) with the common factor ‖e‖² cancelled. No normal is normalised, and coordinates are divided by the
    hinge's size first (θ does not depend on it), so 0.1 mm edges do not underflow in float32.

    A hinge with a degenerate face has no angle: 0 with zero gradient.

    Args:
        pos: (V, 3).
        hinges: (H, 4) edge start, edge end, opposite vertex of each face.
    """
    corners = pos[hinges]
    local = corners[:, 1:] - corners[:, :1]
    size = local.detach().abs().amax(dim=(1, 2)).clamp_min(torch.finfo(pos.dtype).tiny)
    edge, a, b = (local / size[:, None, None]).unbind(dim=1)
    n1 = torch.linalg.cross(edge, a)
    n2 = torch.linalg.cross(b, edge)
    edge_sq = (edge * edge).sum(dim=1)
    regular = _regular(n1, edge_sq, a) & _regular(n2, edge_sq, b)
    # where() before sqrt and atan2: their derivatives at zero must never enter the graph.
    length = torch.where(regular, edge_sq, 1.0).sqrt()
    sine = torch.where(regular, -length * (n1 * b).sum(dim=1), 0.0)
    cosine = torch.where(regular, (n1 * n2).sum(dim=1), 1.0)
    return torch.atan2(sine, cosine)


def rest_inverse(rest_pos: Tensor, faces: Tensor) -> Tensor:
    """Inverse rest edge matrices D_m⁻¹ [1/m], shape (F, 2, 2), in a frame whose x axis is each face's first
    edge.

    The deformation gradient (3×2) is D_s @ rest_inverse with D_s = [x₁ - x₀, x₂ - x₀]. Zero for degenerate
    faces.
    """
    corners = rest_pos[faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross, regular = _face_cross(rest_pos, faces)
    e1_sq = torch.where(regular, (e1 * e1).sum(dim=1), 1.0)
    length = e1_sq.sqrt()
    height = torch.where(regular, (cross * cross).sum(dim=1), 1.0).sqrt() / length
    along = (e1 * e2).sum(dim=1) / length
    scale = regular.to(rest_pos.dtype)
    zero = torch.zeros_like(length)
    rows = [scale / length, -scale * along / (length * height), zero, scale / height]
    return torch.stack(rows, dim=1).reshape(-1, 2, 2)


def _edges(pos: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """The edges x₁ - x₀ and x₂ - x₀ of every face, each (F, 3)."""
    first, second, third = (pos.index_select(0, corner) for corner in faces.unbind(dim=1))
    return second.sub_(first), third.sub_(first)


def _cross(pos: Tensor, faces: Tensor) -> Tensor:
    """Cross product of the edges x₁ - x₀ and x₂ - x₀, (F, 3)."""
    return torch.linalg.cross(*_edges(pos, faces))


def _face_cross(pos: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """The same, and which faces are not degenerate (F,) bool."""
    e1, e2 = _edges(pos, faces)
    cross = torch.linalg.cross(e1, e2)
    return cross, _regular(cross, (e1 * e1).sum(dim=1), e2)


def _unit(vectors: Tensor) -> Tensor:
    """Vectors (N, 3) divided by their lengths; zero where that is nothing."""
    length = _safe_norm(vectors)
    defined = length > torch.finfo(vectors.dtype).tiny
    return torch.where(defined, 1.0 / torch.where(defined, length, 1.0), 0.0).unsqueeze(1) * vectors


def _regular(cross: Tensor, first_sq: Tensor, second: Tensor) -> Tensor:
    """Whether the sine between two edges with this cross product exceeds rounding (bool, no gradient)."""
    limit = (_DEGENERATE_ULPS * torch.finfo(cross.dtype).eps) ** 2
    cross, first_sq, second = cross.detach(), first_sq.detach(), second.detach()
    cross_sq = (cross * cross).sum(dim=1)
    # The absolute floor keeps squares and their reciprocals representable.
    floor = torch.finfo(cross.dtype).tiny / torch.finfo(cross.dtype).eps
    return (cross_sq > limit * first_sq * (second * second).sum(dim=1)) & (cross_sq > floor)


def _safe_norm(vectors: Tensor) -> Tensor:
    """Euclidean norm over the last axis with zero gradient at zero."""
    norm_sq = (vectors * vectors).sum(dim=-1)
    positive = norm_sq > 0
    return torch.where(positive, torch.where(positive, norm_sq, 1.0).sqrt(), 0.0)


#: Curvatures are bounded by this [1/m]: a bulge of 25 mm radius. Fingers and slivers curve more.
MOST_CURVATURE = 40.0
#: A curvature is averaged so often with those of the faces around, so that a single edge does not stand out.
ROUNDS = 2


def convex_curvature(pos: Tensor, faces: Tensor, incidence: Incidence) -> Tensor:
    """Curvature [1/m] (W,) of the surface at its vertices, between 0 (flat, hollow) and :data:`MOST_CURVATURE`.

    The largest normal curvature over the edges at a vertex, (n_j − n_i)·(x_j − x_i)/‖x_j − x_i‖² with area-weighted vertex
    normals n: 1/r on a sphere, and around a cylinder, of radius r. Bounded, then averaged twice over the corners of the faces
    around. Edges without length, and vertices without faces or of no finite place, have none.

    The compiled search finds the same where the cloth is (:func:`hood.mesh.closest_point.tree.search`).

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

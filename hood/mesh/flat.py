"""Rest shapes that are flat patterns: every face has its own place in the plane, and need not fit its neighbours there.

Along a seam the two faces of an edge may disagree about its length (gathers); the edge then counts as long as their mean.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hood.mesh import geometry, topology

#: Faces whose edges change by less than this share keep their flat shape bit by bit.
_SAME = 1e-12


def laid_out(pos: Tensor, faces: Tensor, flat: np.ndarray | None = None) -> Tensor:
    """Edges x₁ - x₀ and x₂ - x₀ of every face in the plane, (F, 2, 2) [m], a row an edge.

    Args:
        pos: (V, 3) m at rest.
        faces: (F, 3).
        flat: (F, 3, 2) m, corners in the pattern; faces of NaN, and all without it, are turned into the plane as they are.
    """
    first, second = pos[faces[:, 1]] - pos[faces[:, 0]], pos[faces[:, 2]] - pos[faces[:, 0]]
    length = first.norm(dim=1)
    along = (first * second).sum(dim=1) / length
    height = torch.linalg.cross(first, second).norm(dim=1) / length
    own = torch.stack([length, torch.zeros_like(length), along, height], dim=1).reshape(-1, 2, 2)
    if flat is None:
        return own
    edges = torch.as_tensor(flat[:, 1:] - flat[:, :1], dtype=pos.dtype, device=pos.device)
    return torch.where(torch.isnan(edges).any(dim=(1, 2), keepdim=True), own, edges)


def flat_mesh(flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces (F, 2, 2) [m] side by side: positions (3F, 3) [m] and faces (F, 3), for what takes heights of a mesh."""
    corners = np.zeros((len(flat), 3, 3))
    corners[:, 1:, :2] = flat
    return corners.reshape(-1, 3), np.arange(3 * len(flat)).reshape(-1, 3)


def inverse(flat: Tensor) -> Tensor:
    """Inverse rest edge matrices (F, 2, 2) [1/m]: their frame is that of the pattern, of each face."""
    return torch.linalg.inv(flat.transpose(1, 2))


def areas(flat: Tensor) -> Tensor:
    """Areas (F,) [m²]."""
    return 0.5 * torch.linalg.det(flat).abs()


def masses(flat: Tensor, faces: Tensor, density: Tensor | float, num_vertices: int) -> Tensor:
    """Vertex masses (V,) [kg]: a third of every face around, of ``density`` [kg/m²], a number or (F,)."""
    share = (areas(flat) * density / 3.0).repeat_interleave(3)
    return share.new_zeros(num_vertices).index_add(0, faces.reshape(-1), share)


def edge_lengths(flat: Tensor, faces: Tensor, edges: Tensor) -> Tensor:
    """Lengths (E,) [m] of ``edges`` (E, 2) of a mesh with ``faces`` (F, 3), means over the faces at each."""
    sides = torch.stack([flat[:, 0], flat[:, 1] - flat[:, 0], flat[:, 1]], dim=1).norm(dim=2).reshape(-1)
    ends = faces[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2)
    row = torch.as_tensor(topology.edge_index(edges.cpu().numpy(), ends.cpu().numpy()), device=flat.device)
    total, count = flat.new_zeros(2, len(edges)).unbind(dim=0)
    return total.index_add(0, row, sides) / count.index_add(0, row, torch.ones_like(sides)).clamp_min(1.0)


def hinge_lengths(flat: Tensor, faces: Tensor, hinges: Tensor) -> Tensor:
    """Lengths (H,) [m] of the edges of ``hinges`` (H, 4)."""
    edges = topology.unique_edges(faces.cpu().numpy())
    row = topology.edge_index(edges, hinges[:, :2].cpu().numpy())
    return edge_lengths(flat, faces, torch.as_tensor(edges))[torch.as_tensor(row, device=flat.device)]


def rest_of(flat: Tensor, faces: Tensor, hinges: Tensor, density: Tensor, num_vertices: int) -> dict[str, Tensor]:
    """What a :class:`hood.cloth.cloth.Cloth` knows of its rest shape, from the faces in the plane, by name of field."""
    area, owners = areas(flat), topology.hinges(faces.cpu().numpy()).faces
    return {
        "flat": flat,
        "mass": masses(flat, faces, density, num_vertices),
        "rest_area": area,
        "rest_inverse": inverse(flat),
        "hinge_rest_length": hinge_lengths(flat, faces, hinges),
        "hinge_area": area[torch.as_tensor(owners, device=area.device)].sum(dim=1),
    }


def rest_angles(pos: Tensor, hinges: Tensor, owners: np.ndarray, flat: np.ndarray) -> Tensor:
    """Rest angles (H,) [rad]: 0 in the pattern and along its seams, that of ``pos`` (V, 3) where a face has no flat shape.

    Args:
        owners: (H, 2) faces of the hinges.
        flat: (F, 3, 2), NaN of faces without.
    """
    known = torch.as_tensor(np.isfinite(flat).all(axis=(1, 2))[owners].all(axis=1))
    angle = geometry.dihedral_angles(pos, hinges)
    return torch.where(known.to(angle.device), 0.0, angle)


def followed(flat: np.ndarray, faces: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The flat faces (F, 3, 2) [m] stretched as each face is from ``before`` (V, 3) to ``after``: sizes, and bodies of another
    shape. A turn in space changes nothing."""
    old, new = (_plane(pos, faces) for pos in (before, after))
    change = new @ np.linalg.inv(old)  # in the frames of the faces
    metric = np.einsum("fki,fkj->fij", change, change)
    same = np.abs(metric - np.eye(2)).max(axis=(1, 2), initial=0.0) < _SAME
    edges = (flat[:, 1:] - flat[:, :1]).transpose(0, 2, 1)  # columns
    known = np.isfinite(edges).all(axis=(1, 2))
    # The turn from the face's frame to that of the pattern is the nearest rotation, or reflection, of what lays it there.
    left, _, right = np.linalg.svd(np.where(known[:, None, None], edges, old) @ np.linalg.inv(old))
    turn, root = left @ right, _root(metric)
    moved = (turn @ root @ turn.transpose(0, 2, 1) @ edges).transpose(0, 2, 1) + flat[:, :1]
    result = flat.copy()
    result[:, 1:] = np.where((same | ~known)[:, None, None], flat[:, 1:], moved)
    return result


def _plane(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 2, 2): edges as columns in the frame of each face."""
    return laid_out(torch.as_tensor(np.asarray(pos, np.float64)), torch.as_tensor(faces)).numpy().transpose(0, 2, 1)


def _root(metric: np.ndarray) -> np.ndarray:
    """Square roots of symmetric matrices (F, 2, 2)."""
    values, vectors = np.linalg.eigh(metric)
    return np.asarray((vectors * np.sqrt(values)[:, None]) @ vectors.transpose(0, 2, 1))

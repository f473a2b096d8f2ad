"""Rest shapes that are flat patterns: every face has its own place in the plane, and need not fit its neighbours there.

Along a seam the two faces of an edge may disagree about its length (gathers); the edge then counts as long as their mean, and
as stretched by what is beyond both.

How cloth is made beyond its fabric and its lengths: elastic, folds, and the layers of seams and hems, as numbers of the sides
of faces. Side k of a face is opposite to its corner k: it goes wherever its corner goes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hood.mesh import geometry, topology

#: Faces whose edges change by less than this share keep their flat shape bit by bit.
_SAME = 1e-12
#: Pairs of points and triangles that are looked at at once.
_AT_ONCE = 1 << 21


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
    sides, row = _lengths_by_edge(flat, faces, edges)
    total, count = flat.new_zeros(2, len(edges)).unbind(dim=0)
    return total.index_add(0, row, sides) / count.index_add(0, row, torch.ones_like(sides)).clamp_min(1.0)


def edge_extents(flat: Tensor, faces: Tensor, edges: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the greatest length (E,) [m] that the faces at each of ``edges`` (E, 2) say."""
    sides, row = _lengths_by_edge(flat, faces, edges)
    least, most = (flat.new_full((len(edges),), start) for start in (torch.inf, 0.0))
    return least.scatter_reduce(0, row, sides, "amin"), most.scatter_reduce(0, row, sides, "amax")


def _lengths_by_edge(flat: Tensor, faces: Tensor, edges: Tensor) -> tuple[Tensor, Tensor]:
    """Lengths (3F,) [m] of the sides of the faces, and their rows in ``edges`` (E, 2)."""
    sides = torch.stack([flat[:, 0], flat[:, 1] - flat[:, 0], flat[:, 1]], dim=1).norm(dim=2).reshape(-1)
    ends = faces[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2)
    row = topology.edge_index(edges.cpu().numpy(), ends.cpu().numpy())
    return sides, torch.as_tensor(row, device=flat.device)


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
    turn, root = left @ right, root_of(metric)
    moved = (turn @ root @ turn.transpose(0, 2, 1) @ edges).transpose(0, 2, 1) + flat[:, :1]
    result = flat.copy()
    result[:, 1:] = np.where((same | ~known)[:, None, None], flat[:, 1:], moved)
    return result


def _plane(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 2, 2): edges as columns in the frame of each face."""
    return laid_out(torch.as_tensor(np.asarray(pos, np.float64)), torch.as_tensor(faces)).numpy().transpose(0, 2, 1)


def root_of(metric: np.ndarray) -> np.ndarray:
    """Square roots of symmetric matrices (F, 2, 2)."""
    values, vectors = np.linalg.eigh(metric)
    return np.asarray((vectors * np.sqrt(values)[:, None]) @ vectors.transpose(0, 2, 1))


#: What is known of sides, and what says nothing of one.
SIDE_TABLES = {"elastic": 1.0, "fold": float("nan"), "bending": 1.0}


@dataclass(frozen=True)
class Construction:
    """What is known of the sides of faces; None: nothing.

    Args:
        elastic: (F, 3) lengths at rest, in shares of those that the sides are cut at.
        fold: (F, 3) rad, angles at rest across the sides; above 0 bends away from where the faces look. NaN: no fold.
        bending: (F, 3) factors on the bending stiffness across the sides.
    """

    elastic: np.ndarray | None = None
    fold: np.ndarray | None = None
    bending: np.ndarray | None = None

    def contracted(self, cut: Tensor, density: Tensor) -> tuple[Tensor, Tensor]:
        """Edges (F, 2, 2) [m] of the faces at rest, and densities (F,) [kg/m²] there: they weigh what they are cut with.

        Args:
            cut: edges x₁ - x₀ and x₂ - x₀ as rows, :func:`hood.mesh.flat.laid_out`.
            density: kg/m² of what is cut.
        """
        assert self.elastic is not None
        shape = torch.as_tensor(_contracted(cut.double().cpu().numpy(), self.elastic)).to(cut)
        return shape, density * areas(cut) / areas(shape)

    def rest_angles(self, angles: Tensor, faces: np.ndarray, hinges: np.ndarray, owners: np.ndarray) -> Tensor:
        """``angles`` (H,) [rad] with those of folds in their places.

        Args:
            hinges: (H, 4), and ``owners`` (H, 2), of :func:`hood.mesh.topology.hinges`.
        """
        assert self.fold is not None
        found = np.full(len(hinges), np.nan)
        for place in (1, 0):  # of two faces that disagree the first counts
            face, corner = owners[:, place], _corner(faces, owners[:, place], hinges[:, 2 + place])
            # The angle of a hinge is seen from where its first face looks, if that goes from the edge's start to its end.
            after = faces[face, (corner + 1) % 3] == hinges[:, place]
            own = np.where(after, 1.0, -1.0) * self.fold[face, corner]
            found = np.where(np.isnan(own), found, own)
        folds = torch.as_tensor(found).to(angles)
        return torch.where(torch.isnan(folds), angles, folds)

    def turned(self, faces: np.ndarray) -> Construction:
        """The same where ``faces`` (F,) bool have the other winding: the first corner is the last."""
        tables = [None if table is None else np.where(faces[:, None], table[:, ::-1], table) for table in vars(self).values()]
        if tables[1] is not None:
            tables[1] = np.where(faces[:, None], -1.0, 1.0) * tables[1]
        return Construction(*tables)

    def factors(self, faces: np.ndarray, hinges: np.ndarray, owners: np.ndarray) -> np.ndarray:
        """Factors (H,) on the bending stiffness, the mean of both faces'."""
        assert self.bending is not None
        both = [self.bending[owners[:, k], _corner(faces, owners[:, k], hinges[:, 2 + k])] for k in (0, 1)]
        return np.asarray(0.5 * (both[0] + both[1]))


def stretched_sides(edges: np.ndarray, axis: np.ndarray, along: float, across: float = 1.0) -> np.ndarray:
    """Factors (F, 3) of the sides of faces that are ``along`` times as long in a direction, and ``across`` times in the other.

    Args:
        edges: (F, 2, 2) [m], edges x₁ - x₀ and x₂ - x₀ as rows.
        axis: (F, 2) that direction in the same plane; of zero nothing changes.
    """
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    unit = axis / np.where(length > 0.0, length, 1.0)
    normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    sides = _sides(edges)
    parts = [factor * np.einsum("fkx,fx->fk", sides, way) for factor, way in ((along, unit), (across, normal))]
    factor = np.hypot(*parts) / np.linalg.norm(sides, axis=2)
    return np.where(length > 0.0, factor, 1.0)


def no_triangles(lengths: np.ndarray) -> np.ndarray:
    """(F,) bool: lengths (F, 3) of sides that make no triangle."""
    a, b, c = np.square(lengths).T
    return np.asarray(~(2.0 * (a * b + b * c + c * a) > a * a + b * b + c * c))


def _corner(faces: np.ndarray, face: np.ndarray, vertex: np.ndarray) -> np.ndarray:
    """Which corner (H,) of ``face`` (H,) ``vertex`` (H,) is."""
    return np.asarray((faces[face] == vertex[:, None]).argmax(axis=1))


def _sides(edges: np.ndarray) -> np.ndarray:
    """(F, 3, 2): the sides opposite to corners 0, 1 and 2."""
    return np.stack([edges[:, 1] - edges[:, 0], edges[:, 1], edges[:, 0]], axis=1)


def _contracted(cut: np.ndarray, elastic: np.ndarray) -> np.ndarray:
    """Edges (F, 2, 2) whose sides are ``elastic`` (F, 3) times as long, by a stretch without rotation."""
    opposite, second, first = (np.square(elastic * np.linalg.norm(_sides(cut), axis=2))).T
    mixed = 0.5 * (first + second - opposite)
    gram = np.stack([first, mixed, mixed, second], axis=1).reshape(-1, 2, 2)
    inverse = np.linalg.inv(cut)
    metric = inverse @ gram @ inverse.transpose(0, 2, 1)
    plain = (elastic == 1.0).all(axis=1)
    return np.asarray(np.where(plain[:, None, None], cut, cut @ root_of(metric)))


def in_triangles(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The triangle (N,) of ``corners`` (F, 3, 2) that each of ``points`` (N, 2) lies in, or is beside, and weights (N, 3)."""
    inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
    face, weights = np.zeros(len(points), dtype=np.int64), np.zeros((len(points), 3))
    for rows in np.array_split(np.arange(len(points)), len(points) * len(corners) // _AT_ONCE + 1):
        share = np.einsum("fij,nfj->nfi", inverse, points[rows][:, None] - corners[:, 0])
        bary = np.concatenate([1.0 - share.sum(axis=2, keepdims=True), share], axis=2)
        face[rows] = bary.min(axis=2).argmax(axis=1)
        weights[rows] = bary[np.arange(len(rows)), face[rows]]
    weights = weights.clip(min=0.0)
    return face, weights / weights.sum(axis=1, keepdims=True)


def inside(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """(N,) bool: points (N, 2) inside a closed outline, by the number of its edges to their right."""
    (x, y), following = outline.T, np.roll(outline, -1, axis=0)
    u, v = following.T
    result = np.zeros(len(points), dtype=bool)
    for k in range(len(outline)):
        crossed = (y[k] > points[:, 1]) != (v[k] > points[:, 1])
        if crossed.any():
            height = (points[crossed, 1] - y[k]) / (v[k] - y[k])
            result[crossed] ^= points[crossed, 0] < x[k] + height * (u[k] - x[k])
    return result

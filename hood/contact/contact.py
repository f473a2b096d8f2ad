"""The two searches of a step: nearest body vertices, which body edges are made of, and contact with the body's surface.

A step that needs the surface (energies, corrections to a base outside the body) finds the nearest vertices on the way;
a step that needs body edges alone is spared the triangles.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import Obstacle
from hood.mesh import geometry
from hood.mesh.closest_point import tree
from hood.mesh.closest_point.search import Incidence, SurfaceHit, build_incidence, search_surface
from hood.mesh.closest_point.static_shapes import search_surface_fixed
from hood.mesh.closest_point.tree import FoldRule, Match
from hood.mesh.closest_point.vertices import Nearest, nearest_centroids, nearest_dense, nearest_vertices
from hood.mesh.geometry import convex_curvature
from hood.tensors.batch import to_device


def find_nearest(cloth: Cloth, pos: Tensor, obstacle: Obstacle, radius: float, dense: bool = False) -> Nearest:
    """The nearest body vertex to each of the positions ``pos`` (V, 3) at t, if closer than ``radius`` [m].

    Body vertices without faces are passed over, as they are by :func:`find_contact`; omitted ones are not.
    ``dense`` tries all pairs whatever the device.
    """
    used = torch.zeros(len(obstacle.pos), dtype=torch.bool, device=obstacle.pos.device)
    used.index_fill_(0, obstacle.faces.reshape(-1), True)
    single = cloth.num_scenes == 1
    scenes = (None, None) if single else (cloth.vertex_scene, obstacle.vertex_scene)
    search = nearest_dense if dense else nearest_vertices
    return search(pos, scenes[0], obstacle.pos, scenes[1], used, radius)


@dataclass(frozen=True)
class Contact:
    """Found at x_t against the body at t and held constant during the step, so that the potential is one and the
    same function for loss, solver and gap. Rows of vertices without a match within the cap have ``valid`` False.
    """

    vertex: Tensor  # (V,) nearest body vertex, index into the batch's body vertices
    vertex_dist: Tensor  # (V,) m, to that vertex
    face: Tensor  # (V,) closest body face, index into the batch's body faces
    bary: Tensor  # (V, 3) barycentric weights of the closest point
    dist: Tensor  # (V,) m, signed distance at t, negative inside
    valid: Tensor  # (V,) bool, unsigned distance <= cap
    point: Tensor  # (V, 3) m, the matched body point at t
    normal: Tensor  # (V, 3) outward unit normal there at t
    next_point: Tensor  # (V, 3) m, the same material point at t + 1
    next_normal: Tensor  # (V, 3) outward unit normal there at t + 1
    curvature: Tensor  # (V,) 1/m, of the body there at t, see hood.mesh.geometry
    #: (V,) m, how much farther off vertices are held, see hood.contact.further.
    raised: Tensor | None = field(default=None, kw_only=True)

    @property
    def nearest(self) -> Nearest:
        """Nearest body vertices, whatever their distance."""
        return Nearest(self.vertex, self.vertex_dist)

    def next_dist(self, next_pos: Tensor) -> Tensor:
        """Signed distance [m] of ``next_pos`` (V, 3) to the matched point's tangent plane at t + 1."""
        return ((next_pos - self.next_point) * self.next_normal).sum(dim=1)


#: The other side of a fold is looked for 15 mm off the skin, of vertices nearer than 20 mm. It is one where its normals are
#: turned by more than 73 degrees, and where it lies in front of the nearest side, or no more than 1 mm behind: what is farther
#: behind is the back of the same limb.
_RULE = FoldRule(ahead=15e-3, near=20e-3, cosine=0.3, behind=1e-3)


#: Off the skin by this [m].
AHEAD = _RULE.ahead


@dataclass(frozen=True)
class SecondContact:
    """The other side of folds of the body: of vertices between two parts of the skin that face each other, as in the bend of an
    elbow, contact with the one that is not nearest. Everything else is not ``valid``; None where nothing is."""

    contact: Contact | None  # rows of all vertices; None: no fold is near

    def to(self, dtype: torch.dtype) -> SecondContact:
        """The same with its numbers in ``dtype``."""
        return SecondContact(None if self.contact is None else to_device(self.contact, dtype=dtype))


def find_contact(pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle, cap: float = 0.1) -> Contact:
    """Contact data of cloth positions ``pos`` (V, 3) against the obstacle at t; one search per scene.

    Matches farther than ``cap`` [m] are kept but marked invalid.
    """
    match = match_surface(pos, vertex_scene, obstacle, curved=True)
    return Contact(**match._asdict(), valid=match.dist.abs() <= cap)


def find_second_contact(pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle, contact: Contact) -> SecondContact:
    """The other side of folds for cloth positions ``pos`` (V, 3) at t, whose ``contact`` is known.

    A vertex is matched with the nearest skin, and nothing would keep it out of what faces that: while a bend closes it would
    pass from one side into the other and back. The other side is the skin nearest to a place 15 mm ahead of the vertex.
    """
    if not len(obstacle.faces) or not len(pos):
        return SecondContact(None)
    match, other = _match_folds(pos, vertex_scene, obstacle, contact)
    return SecondContact(Contact(**match._asdict(), valid=other) if bool(other.any()) else None)


def _match_folds(pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle, contact: Contact) -> tuple[Match, Tensor]:
    """Matches (V,) on the other side, and which of them there are, (V,) bool."""
    incidence = build_incidence(obstacle.faces, len(obstacle.pos))
    surface = obstacle.pos, obstacle.faces, obstacle.face_scene, incidence.adjacency, obstacle.next_pos
    near = {name: getattr(contact, name) for name in ("valid", "dist", "point", "normal")}
    found = tree.search_folds(pos, vertex_scene, *surface, near, _RULE)
    if found is not None:
        return found
    near_enough = contact.valid & (contact.dist.abs() < _RULE.near)
    ahead = torch.where(near_enough.unsqueeze(1), _ahead(pos, contact), pos)
    match = match_surface(ahead, vertex_scene, obstacle, curved=True)
    other = near_enough & _is_other(match, obstacle, contact.point, contact.normal)
    return match._replace(dist=_plane_dist(pos, match)), other


def moving_contacts(
    contact: Contact, second: SecondContact | None, pos: Tensor, obstacle: Obstacle
) -> tuple[Contact, SecondContact | None]:
    """Contacts of positions ``pos`` (V, 3) at t as functions of these and of the body, which autograd follows.

    Their closest points stay on the faces, edges and vertices of the body that they were found on. The values are those of the
    searches, to rounding.
    """
    skin = skin_of(obstacle)
    near = _moving(contact, pos, obstacle, skin)
    dist = torch.copysign((pos - near.point).norm(dim=1), contact.dist)
    first = replace(near, dist=torch.where(contact.valid & (contact.dist != 0), dist, contact.dist))
    if second is None or second.contact is None:
        return first, second
    other = _moving(second.contact, _ahead(pos, first), obstacle, skin)
    dist = ((pos - other.point) * other.normal).sum(dim=1)
    return first, SecondContact(replace(other, dist=torch.where(other.valid, dist, other.dist)))


class BodyAtVertices(NamedTuple):
    """The body at its vertices: unit normals (W, 3) at t and t + 1, curvatures (W,) [1/m] at t."""

    normal: Tensor
    next_normal: Tensor
    curvature: Tensor


def skin_of(obstacle: Obstacle) -> BodyAtVertices:
    """The body at its vertices, which autograd follows where it moves them."""
    incidence = build_incidence(obstacle.faces, len(obstacle.pos))
    both = obstacle.pos, obstacle.next_pos
    if not any(pos.requires_grad for pos in both):
        given = obstacle.faces, incidence.adjacency
        found, next_found = (tree.vertex_skin(pos, *given, curved) for pos, curved in zip(both, (True, False), strict=True))
        if found is not None and next_found is not None:
            like = obstacle.pos.dtype  # the compiled pass computes in float64
            return BodyAtVertices(*(part.to(like) for part in (found[0], next_found[0], found[1])))
    now, later = (geometry.normals_of_fans(pos, obstacle.faces, incidence.around, incidence.first) for pos in both)
    return BodyAtVertices(now, later, convex_curvature(obstacle.pos, obstacle.faces, incidence))


def _moving(contact: Contact, at: Tensor, obstacle: Obstacle, skin: BodyAtVertices) -> Contact:
    """A contact whose closest points follow the positions ``at`` (V, 3) and the body."""
    face = torch.where(contact.valid, contact.face, 0)
    corners = obstacle.faces[face]
    bary = torch.where(contact.valid.unsqueeze(1), _weights(at, obstacle.pos[corners], contact.bary), 1.0 / 3.0)
    found = {
        "bary": bary,
        "point": _weigh(bary, obstacle.pos[corners]),
        "next_point": _weigh(bary, obstacle.next_pos[corners]),
        "normal": _mean_normal(skin.normal, corners, bary),
        "next_normal": _mean_normal(skin.next_normal, corners, bary),
    }
    row = contact.valid.unsqueeze(1)
    moved = {name: torch.where(row, values, getattr(contact, name)) for name, values in found.items()}
    curvature = torch.where(contact.valid, (bary * skin.curvature[corners]).sum(dim=1), contact.curvature)
    return replace(contact, curvature=curvature, **moved)


#: Weights that differ by more belong to another place.
_SAME = 1e-6


def _weights(at: Tensor, corners: Tensor, known: Tensor) -> Tensor:
    """Weights (N, 3) of the points of triangles ``corners`` (N, 3, 3) nearest to ``at`` (N, 3), on the face, the edge or at the
    corner that the ``known`` weights (N, 3) are on; those themselves where they were found for another place."""
    first, second, offset = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], at - corners[:, 0]
    a, b, c = (first * first).sum(1), (first * second).sum(1), (second * second).sum(1)
    p, q = (first * offset).sum(1), (second * offset).sum(1)
    area = a * c - b * b
    inside = (known > 0).all(dim=1)
    area = torch.where(inside, area, 1.0)
    u, v = (c * p - b * q) / area, (a * q - b * p) / area
    found = torch.where(inside.unsqueeze(1), torch.stack([1.0 - u - v, u, v], dim=1), known)
    for corner in range(3):
        start, end = (corner + 1) % 3, (corner + 2) % 3
        on = (known[:, corner] <= 0) & (known[:, start] > 0) & (known[:, end] > 0)
        edge, way = corners[:, end] - corners[:, start], at - corners[:, start]
        share = (edge * way).sum(1) / torch.where(on, (edge * edge).sum(1), 1.0)
        column = [torch.zeros_like(share)] * 3
        column[start], column[end] = 1.0 - share, share
        found = torch.where(on.unsqueeze(1), torch.stack(column, dim=1), found)
    same = ((found.detach() - known).abs() < _SAME).all(dim=1, keepdim=True)
    return torch.where(same, found, known)


def find_static_second_contact(
    pos: Tensor,
    vertex_scene: Tensor,
    contact: Contact,
    obstacle: Obstacle,
    incidence: Incidence,
    num_scenes: int,
    places: int,
) -> SecondContact:
    """The same as :func:`find_second_contact` without waiting for the device: contact of as many rows whatever is found."""
    ahead = torch.where(contact.valid.unsqueeze(1), _ahead(pos, contact), pos)
    match = _match_fixed(ahead, vertex_scene, obstacle, incidence, num_scenes, places)[0]
    near = contact.valid & (contact.dist.abs() < _RULE.near)
    valid = near & _is_other(match, obstacle, contact.point, contact.normal)
    match = match._replace(dist=_plane_dist(pos, match))
    return SecondContact(Contact(**match._asdict(), valid=valid))


def _ahead(pos: Tensor, contact: Contact) -> Tensor:
    return pos + _RULE.ahead * contact.normal


def _is_other(match: Match, obstacle: Obstacle, point: Tensor, normal: Tensor) -> Tensor:
    """Which matches (N,) are on another side than the one with these points and normals (N, 3)."""
    # Of a sharp edge only the faces are turned, of a bulge between two faces only the normals on the way.
    of_face = geometry.face_normals(obstacle.pos, obstacle.faces[match.face])
    turned = ((of_face * normal).sum(dim=1) < _RULE.cosine) & ((match.normal * normal).sum(dim=1) < _RULE.cosine)
    in_front = ((match.point - point) * normal).sum(dim=1) > -_RULE.behind
    return turned & in_front & (match.dist.abs() <= _RULE.ahead + _RULE.near)


def _plane_dist(pos: Tensor, match: Match) -> Tensor:
    """Signed distances [m] (N,) of positions (N, 3) to the tangent planes at matched points at t."""
    return ((pos - match.point) * match.normal).sum(dim=1)


def match_surface(pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle, curved: bool = False) -> Match:
    """The closest body points at t of positions (V, 3), and where they go: by the compiled search where there is one.

    With the body's curvature at t there if it is to be ``curved``.
    """
    incidence = build_incidence(obstacle.faces, len(obstacle.pos)) if len(obstacle.faces) and len(pos) else None
    if incidence is not None:
        surface = obstacle.pos, obstacle.faces, obstacle.face_scene, incidence.adjacency, obstacle.next_pos
        found = tree.search(pos, vertex_scene, *surface, curved)
        if found is not None:
            return found
    hit = search_surface(pos, vertex_scene, obstacle.pos, obstacle.faces, obstacle.vertex_scene, obstacle.face_scene)
    incidence = incidence or build_incidence(obstacle.faces, len(obstacle.pos))
    match = _match_of(hit, obstacle, incidence)
    return match._replace(curvature=_matched_curvature(match, obstacle, incidence)) if curved else match


def find_fixed_contact(
    pos: Tensor,
    vertex_scene: Tensor,
    obstacle: Obstacle,
    incidence: Incidence,
    num_scenes: int,
    places: int,
    cap: float = 0.1,
) -> tuple[Contact, Tensor]:
    """The same as :func:`find_contact` without waiting for the device, and the number (1,) of faces that need a place; see
    :func:`hood.mesh.closest_point.static_shapes.search_surface_fixed`."""
    match, needed = _match_fixed(pos, vertex_scene, obstacle, incidence, num_scenes, places)
    return Contact(**match._asdict(), valid=match.dist.abs() <= cap), needed


def _match_fixed(
    pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle, incidence: Incidence, num_scenes: int, places: int
) -> tuple[Match, Tensor]:
    surface = obstacle.pos, obstacle.faces, obstacle.vertex_scene, obstacle.face_scene
    hit, needed = search_surface_fixed(pos, vertex_scene, *surface, incidence, num_scenes, places)
    match = _match_of(hit, obstacle, incidence)
    return match._replace(curvature=_matched_curvature(match, obstacle, incidence)), needed


def _match_of(hit: SurfaceHit, obstacle: Obstacle, incidence: Incidence) -> Match:
    """Where the surface points of a search are at t and at t + 1."""
    corners = obstacle.faces[hit.face]
    points = (_weigh(hit.bary, at[corners]) for at in (obstacle.pos, obstacle.next_pos))
    normals = (
        _interpolated_normal(at, obstacle.faces, corners, hit.bary, incidence) for at in (obstacle.pos, obstacle.next_pos)
    )
    (point, next_point), (normal, next_normal) = points, normals
    return Match(*hit, point=point, normal=normal, next_point=next_point, next_normal=next_normal)


def _matched_curvature(match: Match, obstacle: Obstacle, incidence: Incidence) -> Tensor:
    """Curvature [1/m] (N,) of the body at t where it was matched."""
    at_vertices = convex_curvature(obstacle.pos, obstacle.faces, incidence).to(match.bary)
    return (match.bary * at_vertices[obstacle.faces[match.face]]).sum(dim=1)


@dataclass(frozen=True)
class CentroidContact(Contact):
    """Contact that also knows, for every vertex, the body face whose centroid was nearest at x_t: a compatibility form.

    What the surface search found stays as it is. There is no distance cap: rows are ``facing`` a plane unless
    their scene has no face with a normal.
    """

    centroid_face: Tensor  # (V,) index into the batch's body faces
    facing: Tensor  # (V,) bool
    next_centroid: Tensor  # (V, 3) m, the face's centroid at t + 1
    next_face_normal: Tensor  # (V, 3) its outward unit normal at t + 1


def find_centroid_contact(contact: Contact, pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle) -> CentroidContact:
    """``contact`` of the positions ``pos`` (V, 3) at t, extended by one search for the nearest face centroids."""
    face, dist = nearest_centroids(pos, vertex_scene, obstacle.pos, obstacle.faces, obstacle.face_scene)
    matched = torch.isfinite(dist)
    if len(obstacle.faces) == 0:
        nowhere = torch.zeros_like(pos)
        return CentroidContact(
            **vars(contact), centroid_face=face, facing=matched, next_centroid=nowhere, next_face_normal=nowhere
        )
    corners = obstacle.faces[face]
    normal = geometry.face_normals(obstacle.next_pos, corners)
    return CentroidContact(
        **vars(contact),
        centroid_face=face,
        facing=matched & normal.any(dim=1),
        next_centroid=obstacle.next_pos[corners].mean(dim=1),
        next_face_normal=normal,
    )


@dataclass(frozen=True)
class LaggedContact(CentroidContact):
    """Contact that also knows the nearest face centroid on the body at t - 1, and where that face is at t.

    Terms of HOOD's published code that look one frame back read it. In the first frame of a motion and in a relaxing step
    with a still body t - 1 is t.
    """

    lagged_facing: Tensor  # (V,) bool
    lagged_face: Tensor  # (V,) of the body
    lagged_dist: Tensor  # (V,) m, from x_t to the centroid at t - 1
    lagged_centroid: Tensor  # (V, 3) m, the same centroid at t
    lagged_motion: Tensor  # (V, 3) m, of the centroid from t - 1 to t
    lagged_normal: Tensor  # (V, 3) the face's outward unit normal at t


def find_lagged_contact(contact: CentroidContact, pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle) -> LaggedContact:
    """``contact`` of the positions ``pos`` (V, 3) at t, extended by a search among the centroids of the body at t - 1."""
    face, dist = nearest_centroids(pos, vertex_scene, obstacle.prev_pos, obstacle.faces, obstacle.face_scene)
    matched = torch.isfinite(dist)
    if len(obstacle.faces) == 0:
        nowhere = torch.zeros_like(pos)
        return LaggedContact(
            **vars(contact), lagged_facing=matched, lagged_face=face, lagged_dist=dist, lagged_centroid=nowhere,
            lagged_motion=nowhere, lagged_normal=nowhere,
        )  # fmt: skip
    corners = obstacle.faces[face]
    centroid, before = obstacle.pos[corners].mean(dim=1), obstacle.prev_pos[corners].mean(dim=1)
    normal = geometry.face_normals(obstacle.pos, corners)
    return LaggedContact(
        **vars(contact), lagged_facing=matched & normal.any(dim=1), lagged_face=face, lagged_dist=dist,
        lagged_centroid=centroid, lagged_motion=centroid - before, lagged_normal=normal,
    )  # fmt: skip


def _weigh(bary: Tensor, corner_values: Tensor) -> Tensor:
    return (bary.unsqueeze(-1) * corner_values).sum(dim=1)


def _interpolated_normal(pos: Tensor, faces: Tensor, corners: Tensor, bary: Tensor, incidence: Incidence) -> Tensor:
    """Normals vary continuously over the surface, so a sliding vertex sees no jump between facets."""
    return _mean_normal(geometry.normals_of_fans(pos, faces, incidence.around, incidence.first), corners, bary)


def _mean_normal(at_vertices: Tensor, corners: Tensor, bary: Tensor) -> Tensor:
    normal = _weigh(bary, at_vertices.index_select(0, corners.reshape(-1)).view(-1, 3, 3))
    return normal / normal.norm(dim=1, keepdim=True).clamp_min(torch.finfo(normal.dtype).tiny)

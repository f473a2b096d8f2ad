"""Contact at points inside the cloth's edges and faces: weighted sums of up to three vertices, each against a body point.

At its vertices alone the cloth holds off the body only there: an edge of 35 mm over a limb of 60 mm sags by 2.5 mm between two
vertices that lie on the skin. Like :class:`hood.contact.contact.Contact` all of this is found once, at x_t against the body at
t.

How far off the body contact holds the cloth's vertices so that the flat triangles between them stay off it as well.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import Obstacle
from hood.contact.contact import Contact, find_contact, match_surface, moving_contacts
from hood.mesh import topology
from hood.mesh.closest_point.search import build_incidence
from hood.mesh.closest_point.tree import Match
from hood.mesh.flat import masses
from hood.mesh.geometry import normals_of_fans, vertex_masses
from hood.tensors.batch import made_of
from hood.tensors.dense import add_rows

#: Where the cloth meets the body: at its vertices alone; at the midpoints of its edges as well; at the midpoints of its rims
#: and, face by face, where vertices of the body are nearest.
PLACES = ("vertices", "edges", "strict")
#: Matches farther away [m] are none: the vertices, which are matched farther, come first.
_CAP = 0.03
#: A body vertex and the cloth nearest to it face each other where less of the gap is along the skin than across it, or all of
#: it is below this [m].
_CLOSE = 2e-3
#: And where the skin that the cloth's own vertices are matched with looks the same way, to 60 degrees.
_SAME_SIDE = 0.5


@dataclass(frozen=True)
class PointContact:
    """N points x_p = Σ w_i x_i of the cloth, each matched with a point of the body during the step t → t+1.

    ``share`` is the area that a point stands for, over the mean area of its vertices (thirds of the faces around, at rest).
    With energies times their shares points press as hard per area as vertices do, however many there are.
    """

    place: str  # of PLACES
    vertices: Tensor  # (N, 3) cloth vertices; what is not needed repeats one
    weights: Tensor  # (N, 3) >= 0, sum to 1
    scene: Tensor  # (N,)
    share: Tensor  # (N,)
    dist: Tensor  # (N,) m, signed distance at t, negative inside
    point: Tensor  # (N, 3) m, the body point at t
    next_point: Tensor  # (N, 3) m, the same material point at t + 1
    next_normal: Tensor  # (N, 3) outward unit normal there at t + 1
    face: Tensor  # (N,) of the body, there

    def at(self, values: Tensor) -> Tensor:
        """``values`` (V, 3) of vertices at the points, (N, 3)."""
        return (self.weights.unsqueeze(2) * values[self.vertices]).sum(dim=1)


def find_point_contact(place: str, cloth: Cloth, pos: Tensor, obstacle: Obstacle, contact: Contact) -> PointContact:
    """Contact of the points of a cloth at ``pos`` (V, 3) with the obstacle at t, which autograd follows where these require it:
    which points are matched, with which faces, edges and corners, is constant.

    Args:
        place: ``edges``: all edges' midpoints. ``strict``: midpoints of edges with one face, and the points of faces that are
            nearest to vertices of the body.
        contact: that of the vertices at ``pos``.
    """
    middles = _midpoints(cloth)
    if place == "strict":
        rims = _match_midpoints(place, middles.take(middles.rim), pos, obstacle, contact)
        return _joined(rims, _match_skin(place, cloth, pos, obstacle, contact))
    return _match_midpoints(place, middles, pos, obstacle, contact)


@dataclass(frozen=True)
class _Midpoints:
    """Midpoints of edges: what does not change during a rollout."""

    vertices: Tensor  # (N, 3), the third weighs nothing
    share: Tensor  # (N,)
    scene: Tensor  # (N,)
    rim: Tensor  # (N,) bool, one face at the edge

    def take(self, rows: Tensor) -> _Midpoints:
        return _Midpoints(self.vertices[rows], self.share[rows], self.scene[rows], self.rim[rows])


def _midpoints(cloth: Cloth) -> _Midpoints:
    """Midpoints of all edges, kept as long as the cloth lives. An edge stands for a third of its faces."""
    made = made_of(cloth)
    if "midpoints" in made:
        return made["midpoints"]
    faces, edges = cloth.faces.cpu().numpy(), cloth.edges.cpu().numpy()
    sides = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    side = torch.as_tensor(topology.edge_index(edges, sides), device=cloth.faces.device)
    area = add_rows(cloth.rest_area.new_zeros(len(edges)), side, cloth.rest_area.repeat_interleave(3) / 3.0)
    share = area / _cloth_areas(cloth)[cloth.edges].mean(dim=1)
    rim = torch.as_tensor(np.bincount(side.cpu().numpy(), minlength=len(edges)) == 1, device=share.device)
    found = made["midpoints"] = _Midpoints(cloth.edges[:, [0, 1, 1]], share, cloth.edge_scene, rim)
    return found


def _cloth_areas(cloth: Cloth) -> Tensor:
    """(V,) m², a third of the faces around every vertex at rest."""
    if cloth.flat is not None:
        return masses(cloth.flat, cloth.faces, 1.0, cloth.num_vertices)
    return vertex_masses(cloth.rest_pos, cloth.faces, 1.0)


def _match_midpoints(place: str, middles: _Midpoints, pos: Tensor, obstacle: Obstacle, contact: Contact) -> PointContact:
    ends = middles.vertices[:, :2]
    half = 0.5 * (pos[ends[:, 0]] - pos[ends[:, 1]]).norm(dim=1)
    # No nearer than an end less the way from there.
    middles = middles.take((contact.dist[ends].abs().amax(dim=1) - half <= _CAP).nonzero().squeeze(1))
    start, end = pos[middles.vertices[:, 0]], pos[middles.vertices[:, 1]]
    match = _matched(0.5 * (start + end), middles.scene, obstacle)
    rows = (match.dist.abs() <= _CAP).nonzero().squeeze(1)
    middles = middles.take(rows)
    weights = pos.new_tensor([0.5, 0.5, 0.0]).expand(len(rows), 3)
    found = (values[rows] for values in (match.dist, match.point, match.next_point, match.next_normal, match.face))
    return PointContact(place, middles.vertices, weights, middles.scene, middles.share, *found)


def _match_skin(place: str, cloth: Cloth, pos: Tensor, obstacle: Obstacle, contact: Contact) -> PointContact:
    """Vertices of the body against the nearest points of the cloth's faces."""
    rows = _near(cloth, pos, obstacle)
    then, later = obstacle.pos[rows], obstacle.next_pos[rows]
    surface = Obstacle(pos, pos, pos, cloth.faces, cloth.vertex_scene, cloth.face_scene)
    match = _matched(then, obstacle.vertex_scene[rows], surface)
    incidence = build_incidence(obstacle.faces, len(obstacle.pos))
    normal, next_normal = (
        normals_of_fans(at, obstacle.faces, incidence.around, incidence.first, rows) for at in (obstacle.pos, obstacle.next_pos)
    )
    vertices, gap = cloth.faces[match.face], match.point - then
    across = (gap * normal).sum(dim=1)
    along = (gap - across.unsqueeze(1) * normal).norm(dim=1)
    seen = contact.valid[vertices].unsqueeze(2) * contact.normal[vertices]
    same_side = ((match.bary.unsqueeze(2) * seen).sum(dim=1) * normal).sum(dim=1) > _SAME_SIDE
    faces_it = (along <= across.abs()) | (match.dist.abs() <= _CLOSE)
    kept = ((match.dist.abs() <= _CAP) & same_side & faces_it).nonzero().squeeze(1)
    vertices, weights = vertices[kept], match.bary[kept]
    of_cloth = (weights * _cloth_areas(cloth)[vertices]).sum(dim=1)
    of_skin = vertex_masses(obstacle.pos, obstacle.faces, 1.0)[rows[kept]]
    # A floor's vertex stands for more than the cloth that meets it.
    share = (of_skin / of_cloth).clamp(max=1.0)
    one_of = incidence.around[incidence.first[rows]]
    found = (values[kept] for values in (across, then, later, next_normal, one_of))
    return PointContact(place, vertices, weights, obstacle.vertex_scene[rows[kept]], share, *found)


def _matched(at: Tensor, scene: Tensor, surface: Obstacle) -> Match | Contact:
    """The closest points of a surface to ``at`` (N, 3) at t, as functions of both."""
    if not any(pos.requires_grad for pos in (at, surface.pos, surface.next_pos)):
        return match_surface(at, scene, surface)
    still = replace(surface, pos=surface.pos.detach(), next_pos=surface.next_pos.detach(), prev_pos=surface.prev_pos.detach())
    return moving_contacts(find_contact(at.detach(), scene, still, _CAP), None, at, surface)[0]


def _near(cloth: Cloth, pos: Tensor, obstacle: Obstacle) -> Tensor:
    """Body vertices (n,) that the cloth of their scene may be within the cap of."""
    near = torch.zeros(len(obstacle.pos), dtype=torch.bool, device=pos.device)
    near[obstacle.faces.reshape(-1)] = True
    low, high = pos.new_full((cloth.num_scenes, 3), torch.inf), pos.new_full((cloth.num_scenes, 3), -torch.inf)
    scene = cloth.vertex_scene.unsqueeze(1).expand_as(pos)
    low, high = low.scatter_reduce(0, scene, pos, "amin"), high.scatter_reduce(0, scene, pos, "amax")
    inside = (obstacle.pos >= low[obstacle.vertex_scene] - _CAP) & (obstacle.pos <= high[obstacle.vertex_scene] + _CAP)
    return (near & inside.all(dim=1)).nonzero().squeeze(1)


def _joined(first: PointContact, second: PointContact) -> PointContact:
    names = [spec.name for spec in fields(first) if spec.name != "place"]
    return PointContact(first.place, *(torch.cat([getattr(first, name), getattr(second, name)]) for name in names))


#: ``curvature``: farther where the body bulges under long edges; ``constant``: the same everywhere.
REACHES = ("curvature", "constant")
#: How much of L² κ vertices are held off: an eighth for the edges; triangles chord error more, and their corners differ.
SAG_SHARE = 1.5 / 8.0
#: Squares of edges that have grown by up to this factor, 12% in length, change nothing.
COVERED = 1.25
#: They are held off by no more [m] than this beside the constant part.
MOST_SAG = 8e-3
#: And by no more [m] than this beside that where they are stretched.
MOST_STRETCHED = 8e-3


def chord_error(cloth: Cloth, contact: Contact, pos: Tensor) -> Tensor:
    """How much farther off the skin [m] (V,) vertices have to be for the triangles between them: min(1.5 L² κ/8, 8 mm).

    An edge of length L whose ends are at a bulge of curvature κ cuts L² κ/8 deep into it. L² is the mean square of the rest
    lengths of the edges at the vertex, κ the body's curvature where the vertex was matched (:mod:`hood.mesh.geometry`).
    Fades with the square of the edges: 3.8 mm for 35 mm on a limb 120 mm thick, 0.9 mm for 17 mm.

    An edge that is stretched sags farther. What its square has grown by, beyond the quarter that the half more in
    :data:`SAG_SHARE` covers (:data:`COVERED`), is added to L², of the edge at the vertex that has grown most; no
    more than :data:`MOST_STRETCHED`, since cloth that is held farther off is stretched the more. Where a step has shown that it
    takes more (:mod:`hood.contact.further`), that is added.

    Args:
        pos: (V, 3) m, of the cloth at t.
    """
    share = SAG_SHARE * contact.curvature
    at_rest = (share * cloth.edge_length_sq).clamp_max(MOST_SAG)
    at_rest = at_rest if contact.raised is None else at_rest + contact.raised
    growth = _known_growth(cloth, pos)
    return at_rest if growth is None else at_rest + (share * growth).clamp_max(MOST_STRETCHED)


#: Cloth and positions that growth was asked of last, and what it was: both sides of a fold ask in turn.
_LAST: list[tuple[weakref.ref[Cloth], weakref.ref[Tensor], int, Tensor | None]] = []


def _known_growth(cloth: Cloth, pos: Tensor) -> Tensor | None:
    if pos.requires_grad or pos.is_inference():
        return edge_growth(cloth, pos)
    for of, at, version, value in _LAST:
        if of() is cloth and at() is pos and version == pos._version:
            return value
    value = edge_growth(cloth, pos)
    _LAST[:] = [(weakref.ref(cloth), weakref.ref(pos), pos._version, value)]
    return value


def edge_growth(cloth: Cloth, pos: Tensor) -> Tensor | None:
    """What the square of an edge at a vertex has grown by beyond :data:`COVERED`, at most, (V,) [m²]; None where none has, on
    a CPU (elsewhere the host would wait for the answer)."""
    growth = cloth.edge_sq(pos) - COVERED * cloth.rest_edge_sq
    traced = type(growth) is not Tensor  # has no values to ask for
    if growth.device.type == "cpu" and not traced and not growth.requires_grad and not bool((growth > 0.0).any()):
        return None
    return cloth.largest_of_edges(growth.clamp_min(0.0))


def vertex_reach(form: str, least: float, cloth: Cloth, contact: Contact, pos: Tensor) -> Tensor:
    """Distance from the skin [m] (V,) at which contact sets in: ``least`` [m], and by ``curvature`` the :func:`chord_error` as
    well, of cloth that is at ``pos`` (V, 3) [m] at t."""
    return least + (chord_error(cloth, contact, pos) if form == "curvature" else torch.zeros_like(contact.dist))

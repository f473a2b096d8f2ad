"""The start state: a skinned garment, taken out of the body and brought near its rest lengths."""

from __future__ import annotations

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import Obstacle
from hood.contact.contact import Contact, find_contact
from hood.contact.sample_points import chord_error
from hood.limits import STRAIN_START
from hood.mesh.closest_point.vertices import nearest_centroids
from hood.mesh.geometry import face_normals

#: Edges may start this much longer or shorter than at rest; beyond it they are projected back.
_STRAIN_LIMIT = STRAIN_START.value
_SEARCH_EVERY = 10
#: A thorough start goes on while a free edge is stretched by more than the first, for at most so many iterations. Meanwhile
#: cloth may be compressed by as much as the second: it buckles later, and gives way.
_STRETCH_LIMIT, _COMPRESSION_LIMIT, _MOST_ITERATIONS = 0.08, 0.07, 960
#: Iterations between two looks at the edges, after each of which those stretched by more than ``_STUBBORN`` weigh more: by
#: half again for every 2% beyond, up to ``_HEAVIEST`` times.
_LOOK_EVERY, _STUBBORN, _HEAVIEST = 60, 0.06, 20.0
#: Contact is searched again once a vertex has moved so far [m] since, at most every few iterations.
_SEARCH_AFTER, _SEARCH_PAUSE = 2e-3, 5


def settle(
    cloth: Cloth,
    pos: Tensor,
    obstacle: Obstacle | None,
    clearance: float = 2e-3,
    iterations: int = 60,
    thorough: bool = False,
) -> Tensor:
    """Positions (V, 3) [m] near ``pos`` with bounded edge strain, at least ``clearance`` [m] outside the body, and
    where it bulges under long edges so far that these are outside as well
    (:func:`hood.contact.sample_points.chord_error`).

    Skinning stretches loose cloth between the limbs and pushes cuffs into the skin; the first frame would then start with
    forces far beyond the weight. Alternates averaged edge-length projections (position based dynamics, Müller et al. 2007)
    with pushing out along the body's normals; ends with the latter. Pinned vertices stay.

    Args:
        thorough: go on while an edge is stretched by more than 8%, see :func:`_unstretch`. A garment made in one pose and
            started in another, or one on a body that squats, needs it: a third of a second to two for 1k vertices.
    """
    pos = _project(cloth, pos, obstacle, clearance, iterations)
    return _unstretch(cloth, pos, obstacle, clearance) if thorough else pos


def leave_by_centroids(cloth: Cloth, pos: Tensor, obstacle: Obstacle, clearance: float) -> Tensor:
    """``pos`` (V, 3) [m] with every free vertex at least ``clearance`` [m] in front of the plane of the body's face at t whose
    centroid is nearest: how the released code begins. One round; what leaves one limb may enter another."""
    if len(obstacle.faces) == 0:
        return pos
    face, dist = nearest_centroids(pos, cloth.vertex_scene, obstacle.pos, obstacle.faces, obstacle.face_scene)
    corners = obstacle.faces[face]
    normal = face_normals(obstacle.pos, corners)
    depth = clearance - ((pos - obstacle.pos[corners].mean(dim=1)) * normal).sum(dim=1)
    return pos + (depth.clamp_min(0.0) * torch.isfinite(dist) * cloth.free).unsqueeze(1) * normal


def free_stretch(cloth: Cloth, pos: Tensor) -> Tensor:
    """Relative lengthening (E,) of the edges at ``pos`` (V, 3); zero where both ends are held: nothing can be done there."""
    start, end = cloth.edges.unbind(dim=1)
    return cloth.edge_strain(pos) * (cloth.free[start] | cloth.free[end])


def _project(cloth: Cloth, pos: Tensor, obstacle: Obstacle | None, clearance: float, iterations: int) -> Tensor:
    """Over-relaxed Jacobi projections: plain averaging needs about twice the iterations."""
    start, end = cloth.edges.unbind(dim=1)
    rest_length = cloth.rest_length
    free = cloth.free.to(pos.dtype)
    share = free[start] + free[end]
    valence = torch.zeros_like(free).index_add(0, start, share.sign()).index_add(0, end, share.sign()).clamp_min(1.0)
    contact = None
    for iteration in range(iterations):
        if obstacle is not None:
            if iteration % _SEARCH_EVERY == 0:
                contact = find_contact(pos, cloth.vertex_scene, obstacle)
            assert contact is not None
            pos = leave(cloth, pos, contact, clearance)
        if iteration == iterations - 1:
            break
        span = pos[end] - pos[start]
        length = span.norm(dim=1)
        target = torch.minimum(torch.maximum(length, rest_length * (1 - _STRAIN_LIMIT)), rest_length * (1 + _STRAIN_LIMIT))
        move = span * ((length - target) / length.clamp_min(1e-9) / share.clamp_min(1.0)).unsqueeze(1)
        total = torch.zeros_like(pos).index_add(0, start, move).index_add(0, end, -move)
        pos = pos + 1.5 * total / valence.unsqueeze(1) * free.unsqueeze(1)
    return push_out_of_body(cloth, pos, obstacle, clearance)


def _unstretch(cloth: Cloth, pos: Tensor, obstacle: Obstacle | None, clearance: float) -> Tensor:
    """The least stretched of the positions on the way to no free edge stretched by more than 8%.

    A trouser leg on a bent hip has to slide along the whole thigh: plain projections carry a length from edge to edge only
    and take thousands. Here they are the gradient of ½ Σ w (length − target)², descended with :class:`Momentum`. A few edges
    in a crease stay behind the others in a sum of squares; their weights w grow until they count.
    """
    start, end = cloth.edges.unbind(dim=1)
    rest_length = cloth.rest_length
    weight = torch.ones_like(rest_length)
    stretch = free_stretch(cloth, pos)
    best, least = pos, float(stretch.max()) if len(stretch) else 0.0
    search, course = LazySearch(cloth, obstacle), Momentum(pos)
    for iteration in range(1, _MOST_ITERATIONS + 1):
        if least <= _STRETCH_LIMIT:
            break
        contact = search(course.ahead)
        now = descend(cloth, course.ahead, weight, rest_length)
        course.go(now if contact is None else leave(cloth, now, contact, clearance))
        if iteration % _LOOK_EVERY == 0:
            outside = push_out_of_body(cloth, course.pos, obstacle, clearance)
            stretch = free_stretch(cloth, outside)
            if float(stretch.max()) < least:
                best, least = outside, float(stretch.max())
            weight = (weight * (1.0 + 25.0 * (stretch - _STUBBORN).clamp(0.0, 0.1))).clamp_max(_HEAVIEST)
    return best


def descend(cloth: Cloth, pos: Tensor, weight: Tensor, rest_length: Tensor) -> Tensor:
    """Free vertices moved by the weighted average of what would bring each of their edges within the limits."""
    start, end = cloth.edges.unbind(dim=1)
    span = pos[end] - pos[start]
    length = span.norm(dim=1)
    least, most = rest_length * (1 - _COMPRESSION_LIMIT), rest_length * (1 + _STRAIN_LIMIT)
    target = torch.minimum(torch.maximum(length, least), most)
    move = span * (weight * (length - target) / length.clamp_min(1e-9)).unsqueeze(1)
    total = torch.zeros_like(pos).index_add(0, start, move).index_add(0, end, -move)
    shares = torch.zeros_like(pos[:, 0]).index_add(0, start, weight).index_add(0, end, weight).clamp_min(1.0)
    return pos + total / shares.unsqueeze(1) * cloth.free.unsqueeze(1)


class Momentum:
    """A descent whose steps are carried on, and begin again where that leads uphill (O'Donoghue and Candès 2015)."""

    def __init__(self, pos: Tensor) -> None:
        self.pos = self.ahead = pos  # (V, 3) m: where the descent is, and from where it takes its next step
        self._pace = 1.0

    def go(self, now: Tensor) -> None:
        """Take note of where the step from ``ahead`` led to."""
        if float(((self.ahead - now) * (now - self.pos)).sum()) > 0.0:
            self._pace = 1.0
        pace = (1.0 + (1.0 + 4.0 * self._pace**2) ** 0.5) / 2.0
        self.ahead = now + (self._pace - 1.0) / pace * (now - self.pos)
        self.pos, self._pace = now, pace

    def stop(self, pos: Tensor) -> None:
        """Go on from ``pos``, from rest."""
        self.pos = self.ahead = pos
        self._pace = 1.0


class LazySearch:
    """Contact with a body that stands still, searched again only where the cloth has moved on."""

    def __init__(self, cloth: Cloth, obstacle: Obstacle | None) -> None:
        self._cloth, self._obstacle = cloth, obstacle
        self._contact: Contact | None = None
        self._at = cloth.rest_pos
        self._age = 0

    def __call__(self, pos: Tensor) -> Contact | None:
        self._age += 1
        if self._obstacle is None:
            return None
        moved = self._age >= _SEARCH_PAUSE and float((pos - self._at).abs().max()) > _SEARCH_AFTER
        if self._contact is None or moved:
            self._contact = find_contact(pos, self._cloth.vertex_scene, self._obstacle)
            self._at, self._age = pos, 0
        return self._contact


def leave(cloth: Cloth, pos: Tensor, contact: Contact, clearance: float) -> Tensor:
    """Free vertices nearer than ``clearance`` and the :func:`chord_error` to their tangent planes moved there."""
    depth = (clearance + chord_error(cloth, contact, pos) - ((pos - contact.point) * contact.normal).sum(1)).clamp_min(0.0)
    return pos + (depth * contact.valid * cloth.free).unsqueeze(1) * contact.normal


def push_out_of_body(cloth: Cloth, pos: Tensor, obstacle: Obstacle | None, clearance: float, rounds: int = 4) -> Tensor:
    """``pos`` (V, 3) with every free vertex at least ``clearance`` [m] and the :func:`chord_error` outside the body at t (up to
    ``rounds`` searches: leaving one limb may enter another)."""
    if obstacle is None:
        return pos
    free = cloth.free
    for _ in range(rounds):
        contact = find_contact(pos, cloth.vertex_scene, obstacle)
        # The margin covers the difference between the tangent plane and the true distance.
        depth = (clearance + chord_error(cloth, contact, pos) - contact.dist) * (contact.valid & free)
        if not bool((depth > 0).any()):
            break
        pos = pos + (depth.clamp_min(0.0) + 2e-4 * (depth > 0)).unsqueeze(1) * contact.normal
    return pos

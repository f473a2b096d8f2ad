"""Coulomb friction between cloth and body, as a lagged potential."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor

from hood.contact.contact import Contact
from hood.contact.sample_points import PointContact, vertex_reach
from hood.energies.contact import checked_contact, contacts_of, lagged_contact, weighted, with_lagged_centroids, with_places
from hood.energies.laws import lagged_contact_force, mollified_norm
from hood.energies.problem import StepProblem, dot_rows, sum_per_scene
from hood.energies.term import Energy, Form, Passes, Role
from hood.mesh.closest_point.vertices import nearest_centroids
from hood.mesh.geometry import face_normals

#: What the published code adds to sin² α.
_LEAST_SINE_SQ = 1e-4
#: Slip [m] below which the solver takes the kink of that code's friction for round.
_LEAST_SLIP = 1e-6


def scaled_by_body_friction(problem: StepProblem, face: Tensor, force: Tensor) -> Tensor:
    """Forces (N,) [N] times how much the body's faces (N,) that they act on grip; themselves where all grip alike."""
    grip = None if problem.step.obstacle is None else problem.step.obstacle.friction_scale
    return force if grip is None else force * grip.to(force)[face.clamp_min(0)]


@dataclass(frozen=True)
class Grip:
    """A friction term on N vertices, force f at most along the tangential slip; rows without any are zero."""

    force: Tensor  # (N,) N, the coefficient included
    normal: Tensor  # (N, 3)
    anchor: Tensor  # (N, 3) m, where the vertex would be if it stuck
    limit: Tensor  # (N,) m, slip below which it counts as sticking

    def slip(self, pos: Tensor) -> Tensor:
        """Tangential slip (N, 3) [m] of ``pos`` (N, 3)."""
        slip = torch.where((self.force > 0)[:, None], pos - self.anchor, 0.0)
        return slip - dot_rows(slip, self.normal)[:, None] * self.normal

    def take(self, rows: Tensor) -> Grip:
        """Those of some rows, int64."""
        return Grip(*(values.index_select(0, rows) for values in (self.force, self.normal, self.anchor, self.limit)))


class LaggedFriction(Energy):
    """Friction energy [J], the sum over vertices of μ_f φ N f(‖u_T‖); subclasses say what the normal force N is.

    u_T is the tangential slip from t to t+1 relative to the matched body point, N is taken at t (lagged, so that
    the friction is a potential). f is :func:`hood.energies.laws.mollified_norm` with e = ``slip_speed`` · dt, equal
    to ‖u_T‖ above. The force is at most μ_f φ N and reaches it at ``slip_speed``; below, contacts creep.

    φ → ``cloth.friction`` (V,), what the fabric makes of the coefficient, times ``obstacle.friction_scale`` (G,) of the body's
    face.

    Args:
        coefficient: μ_f.
        slip_speed: ε_v [m/s], speed below which friction counts as static.
    """

    role = Role.FRICTION

    def __init__(self, coefficient: float, slip_speed: float) -> None:
        if coefficient < 0 or slip_speed <= 0:
            raise ValueError(
                f"friction: coefficient is {coefficient}, slip_speed {slip_speed}; give coefficient >= 0 and slip_speed > 0"
            )
        self.coefficient = coefficient
        self.slip_speed = slip_speed

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with its contact searched for, once per step, if there is friction."""
        return problem.with_contact() if self.coefficient > 0 else problem

    def applies(self, problem: StepProblem) -> bool:
        return self.coefficient > 0 and problem.searched_contact is not None

    def normal_force(self, problem: StepProblem, contact: Contact) -> Tensor:
        """Lagged normal forces N [N], shape (V,)."""
        raise NotImplementedError

    def greatest(self, problem: StepProblem, contact: Contact) -> Tensor:
        """Greatest forces of friction [N], μ_f φ N, shape (V,)."""
        return (
            self.coefficient
            * problem.cloth.friction
            * scaled_by_body_friction(problem, contact.face, self.normal_force(problem, contact))
        )

    def contacts(self, problem: StepProblem) -> tuple[Contact, ...]:
        """The contacts of the vertices that the term acts at; none without a body."""
        return contacts_of(problem, "nearest")

    def carrier(self, contact: Contact) -> tuple[Tensor, Tensor]:
        """What the slip is measured against: the way (V, 3) [m] of the matched body points, and the normals (V, 3) there."""
        return contact.next_point - contact.point, contact.next_normal

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        energy, limit = next_pos.new_zeros(problem.num_scenes), self.slip_speed * problem.vertex_dt.squeeze(1)
        for contact in self.contacts(problem):
            force = self.greatest(problem, contact)
            carried, normal = self.carrier(contact)
            moved = next_pos - problem.state.pos - carried
            energy = energy + problem.sum_vertices(_slipping(force, moved, normal, limit))
        return energy

    def grip(self, problem: StepProblem, contact: Contact) -> Grip:
        """The forces and what the slip is measured against, of one of :meth:`contacts`."""
        force = self.greatest(problem, contact)
        # Rows without a match may hold infinite or undefined numbers.
        sliding = (force > 0)[:, None]
        carried, normal = self.carrier(contact)
        anchor = problem.state.pos + torch.where(sliding, carried, 0.0)
        limit = self.slip_speed * problem.vertex_dt.squeeze(1)
        return Grip(force, torch.where(sliding, normal, 0.0), anchor, limit)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> list[Grip]:
        """One of each contact."""
        return [self.grip(problem, contact) for contact in self.contacts(problem)]


class Friction(LaggedFriction):
    """Friction by the contact's own force: N = 3 w max(ε - d_t, 0)², that of the collision term at t, but no more than what
    presses the vertex onto the skin during the step.

    The penalty has no bound: a vertex 6 mm deep, where a limb has passed it or the nearest skin has changed, would be held with
    thousands of times its weight, although a few weights take it out. What presses it is

        P = m/dt² max(ε - d̂, 0) + max(-f·n, 0),

    the force that stops its own mass at the edge of the zone, with d̂ the distance at t+1 of where it would fly under its
    weight, and what the forces f of the cloth around it (:attr:`hood.energies.problem.StepProblem.internal_force`) add along
    the normal n. Cloth that lies still, or is stretched over the skin, is pressed with exactly N.

    At points inside edges and faces N has the factor of the collision there, the area share, and so has P, of the weighted
    vertices.

    Args:
        weight, epsilon, contact, reach, sides: those of the collision term, which make w [J/m³] and ε [m].
    """

    kind: ClassVar[str] = "Friction"
    form = Form.GRIPS

    def __init__(
        self,
        coefficient: float = 0.5,
        slip_speed: float = 5e-3,
        weight: float = 5e5,
        epsilon: float = 2e-3,
        contact: str = "vertices",
        reach: str = "curvature",
        sides: str = "both",
    ) -> None:
        super().__init__(coefficient, slip_speed)
        self.weight = weight
        self.epsilon = epsilon
        self.contact, self.reach, self.sides = checked_contact("friction", contact, reach, sides)

    def with_weight(self, weight: float) -> Self:
        """The same term with another collision weight, for a ramp during training; subclasses see to what they derive."""
        return weighted(self, weight)

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with its contact searched for, once per step, if there is friction."""
        return with_places(problem, self.contact, self.sides) if self.coefficient > 0 else problem

    def contacts(self, problem: StepProblem) -> tuple[Contact, ...]:
        return contacts_of(problem, self.sides)

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        energy = super().__call__(problem, next_pos, acc)
        points = problem.points_at(self.contact)
        if points is None:
            return energy
        moved = points.at(next_pos - problem.state.pos) - (points.next_point - points.point)
        limit = self.slip_speed * problem.step.dt[points.scene]
        slipping = _slipping(self.greatest_at(problem, points), moved, points.next_normal, limit)
        return energy + sum_per_scene(slipping, points.scene, problem.num_scenes)

    def greatest_at(self, problem: StepProblem, points: PointContact) -> Tensor:
        """Greatest forces of friction [N] (N,) at the points, φ as the weighted vertices have it."""
        factor = 1.0 + (problem.cloth.friction - 1.0)[points.vertices].mul(points.weights).sum(dim=1)
        return self.coefficient * factor * scaled_by_body_friction(problem, points.face, self.point_force(problem, points))

    def point_force(self, problem: StepProblem, points: PointContact) -> Tensor:
        """Lagged normal forces [N] (N,) at the points."""
        force = lagged_contact_force(self.weight, self.epsilon - points.dist)
        pull = problem.searched_internal_force
        if pull is not None:
            carried = problem.cloth.mass[points.vertices].mul(points.weights).sum(dim=1)
            dt = problem.step.dt[points.scene]
            depth = self.epsilon - _along(points.at(ballistic_position(problem)) - points.next_point, points.next_normal)
            force = torch.minimum(force, _pressing(carried / dt**2, depth, points.at(pull), points.next_normal))
        return points.share * force

    def normal_force(self, problem: StepProblem, contact: Contact) -> Tensor:
        touching = contact.valid & (problem.cloth.mass > 0)
        reach = vertex_reach(self.reach, self.epsilon, problem.cloth, contact, problem.state.pos)
        force = lagged_contact_force(self.weight, torch.where(touching, reach - contact.dist, 0.0))
        pull = problem.searched_internal_force
        if pull is None:
            return force
        # where() before the arithmetic: rows without a match may hold infinite or undefined numbers.
        point, normal = (torch.where(touching[:, None], given, 0.0) for given in (contact.next_point, contact.next_normal))
        depth = reach - _along(ballistic_position(problem) - point, normal)
        inertia = problem.cloth.mass / problem.vertex_dt.squeeze(1) ** 2
        return torch.minimum(force, _pressing(inertia, depth, pull, normal))

    def needs_internal_force(self, problem: StepProblem) -> bool:
        return self.coefficient > 0 and problem.contact is not None

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> list[Grip]:
        """One of each contact, by the compiled pass where there is one."""
        contacts = self.contacts(problem)
        rows = [None if passes is None else passes(contact) for contact in contacts]
        return [
            self.grip(problem, contact) if row is None else _as_grip(*row.grips(self))
            for contact, row in zip(contacts, rows, strict=True)
        ]

    def closed_form_at(self, problem: StepProblem, points: PointContact) -> Grip | None:
        if self.contact != points.place:
            return None
        anchor = points.at(problem.state.pos) + points.next_point - points.point
        limit = self.slip_speed * problem.step.dt[points.scene]
        return Grip(self.greatest_at(problem, points), points.next_normal, anchor, limit)


class WeightFriction(LaggedFriction):
    """Friction by weight, as HOOD's published code means it: N = m ‖g‖ max(n·up, 0) within ``radius`` of the surface.

    n is the surface normal at t and up the direction against gravity, so the weight counts as far as the surface is
    horizontal, and not at all under an overhang. Cloth pressed on by tight fit or a moving limb gets no more
    friction than cloth that just lies there, and cloth hovering within the radius gets as much: the default
    follows the contact force. For comparisons with that code only.

    What that code computes is another thing, see :class:`CodedFriction`. Here the distance is a distance (signed, to the
    closest point of the surface: penetrating vertices count), up is the problem's, and the body moves from t to t+1 as it
    does for the collision.

    Args:
        radius: [m].
    """

    kind: ClassVar[str] = "WeightFriction"
    form = Form.GRIPS
    published = True

    def __init__(self, coefficient: float = 0.5, slip_speed: float = 5e-3, radius: float = 3e-3) -> None:
        super().__init__(coefficient, slip_speed)
        if radius <= 0:
            raise ValueError(f"friction: radius is {radius}; give radius > 0")
        self.radius = radius

    def with_weight(self, weight: float) -> Self:
        """The term itself: the weight of a collision term plays no role in it."""
        return self

    def normal_force(self, problem: StepProblem, contact: Contact) -> Tensor:
        near = contact.valid & (contact.dist <= self.radius)
        normal = torch.where(near.unsqueeze(1), contact.normal, 0.0)
        return problem.cloth.mass * (-(normal * problem.gravity.to(normal)).sum(dim=1)).clamp_min(0.0)


class CodedFriction(Energy):
    """Friction as HOOD's published code computes it, the sum over vertices of μ_f m ‖g‖ √(sin² α + 1e-4) ‖δ_T‖.

    δ is the way of the vertex from t to t+1 less that of a face of the body from t-1 to t: the face whose centroid at t-1 is
    nearest to x_t. δ_T = δ - (δ·n) n with n the mean of two unit normals, of that face at t-1 and of the face whose centroid at
    t is nearest to the predicted vertex; n is not made unit again. α is the angle between δ_T and the axis z. Vertices count
    whose *squared* distances to both centroids, of x_t at t-1 and of x_t+1 at t, are below ``radius``.

    Each differs from what was meant (:class:`WeightFriction`):

    - squared distances are compared with the radius itself, so that 3e-3 reaches 5.5 cm, nearly all of a shirt;
    - the weight depends on the direction of the slip, not on the slope of the surface, and z counts as up while gravity acts
      along y: slip along z is nearly free;
    - the body is one frame behind that of the collision;
    - it has no mollifier: the energy has a kink where nothing slips. Where cloth sticks a solver ends at the kink, with a force
      that is not balanced; it says how large (``relative_gradient``).

    The normals and faces of the predicted position are taken as they are at each evaluation; no gradient goes through them.

    Args:
        coefficient: μ_f.
        radius: [m²] in effect; the code takes it for metres.
    """

    kind: ClassVar[str] = "CodedFriction"
    role = Role.FRICTION
    form = Form.BLOCKS
    published = True

    def __init__(self, coefficient: float = 0.5, radius: float = 3e-3) -> None:
        if coefficient < 0 or radius <= 0:
            raise ValueError(f"friction: coefficient is {coefficient}, radius {radius}; give coefficient >= 0 and radius > 0")
        self.coefficient, self.radius = coefficient, radius

    def with_weight(self, weight: float) -> Self:
        """The term itself: the weight of a collision term plays no role in it."""
        return self

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with the body at t-1 searched, once per step, if there is friction."""
        return with_lagged_centroids(problem) if self.coefficient > 0 else problem

    def applies(self, problem: StepProblem) -> bool:
        return self.coefficient > 0 and problem.searched_contact is not None

    def greatest(self, problem: StepProblem, next_pos: Tensor) -> Tensor:
        """μ_f φ m ‖g‖ [N] (V,) of the vertices that count at ``next_pos`` (V, 3), 0 of others."""
        return self._reached(problem, next_pos)[0]

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        force, slip, _ = self.slipping(problem, next_pos)
        size_sq = _across(slip)
        moving = size_sq > 0
        return problem.sum_vertices(force * torch.where(moving, torch.where(moving, size_sq, 1.0).sqrt(), 0.0))

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> CodedSlip:
        return CodedSlip(self, problem)

    def slipping(self, problem: StepProblem, next_pos: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """:meth:`greatest` (V,), δ_T (V, 3) [m] and n (V, 3); all 0 where the first is."""
        contact, obstacle = lagged_contact(problem), problem.step.obstacle
        if obstacle is None or len(obstacle.faces) == 0:
            return next_pos.new_zeros(len(next_pos)), torch.zeros_like(next_pos), torch.zeros_like(next_pos)
        force, face = self._reached(problem, next_pos)
        before = face_normals(obstacle.prev_pos, obstacle.faces[contact.lagged_face])
        normal = 0.5 * (before + face_normals(obstacle.pos, obstacle.faces[face]))
        # where() before the arithmetic: rows without a match may hold infinite or undefined numbers.
        held = (force > 0)[:, None]
        normal = torch.where(held, normal, 0.0).to(next_pos.dtype)
        slip = torch.where(held, next_pos - problem.state.pos - contact.lagged_motion, 0.0)
        return force, slip - dot_rows(slip, normal)[:, None] * normal, normal

    def _reached(self, problem: StepProblem, next_pos: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`greatest`, and the faces (V,) of the body at t whose centroids are nearest to ``next_pos``."""
        contact, obstacle, scene = lagged_contact(problem), problem.step.obstacle, problem.cloth.vertex_scene
        assert obstacle is not None
        face, dist = nearest_centroids(next_pos.detach(), scene, obstacle.pos, obstacle.faces, obstacle.face_scene)
        near = contact.lagged_facing & (contact.lagged_dist**2 < self.radius) & (dist**2 < self.radius)
        weight = problem.cloth.mass * problem.gravity.norm().to(problem.cloth.mass) * problem.cloth.friction
        force = self.coefficient * scaled_by_body_friction(problem, contact.lagged_face, weight)
        return torch.where(near, force, 0.0), face


@dataclass(frozen=True)
class CodedSlip:
    """:class:`CodedFriction` in one step, for the solver. Near its kink the curvature is that of a slip of a micrometre."""

    term: CodedFriction
    problem: StepProblem

    def energy(self, pos: Tensor) -> Tensor:
        """Energy [J] (B,) at ``pos`` (V, 3)."""
        return self.term(self.problem, pos, pos)

    def derivatives(self, pos: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [N] (V, 3), and F PᵀAP / √s [N/m] (V, 3, 3), which bounds the second derivative of F √s with s = δᵀPᵀAPδ."""
        force, slip, normal = self.term.slipping(self.problem, pos)
        weights = slip.new_tensor([1.0, 1.0, 0.0]) + _LEAST_SINE_SQ  # A
        projected = torch.eye(3).to(slip) - normal.unsqueeze(2) * normal.unsqueeze(1)  # P, symmetric
        size = _across(slip).sqrt()
        gradient = torch.bmm(projected, (weights * slip).unsqueeze(2)).squeeze(2)
        gradient = (force / torch.where(size > 0, size, 1.0))[:, None] * gradient
        matrix = torch.bmm(projected, weights[:, None] * projected)
        return gradient, (force / size.clamp_min(_LEAST_SLIP))[:, None, None] * matrix


def _across(slip: Tensor) -> Tensor:
    """(sin² α + 1e-4) ‖δ_T‖² [m²] (V,): the part of slips (V, 3) across z, squared, and a little of all."""
    return slip[:, 0] ** 2 + slip[:, 1] ** 2 + _LEAST_SINE_SQ * dot_rows(slip, slip)


def _as_grip(normal: Tensor, anchor: Tensor, force: Tensor, limit: Tensor) -> Grip:
    return Grip(force, normal, anchor, limit)


def ballistic_position(problem: StepProblem) -> Tensor:
    """Where (V, 3) [m] vertices would be at t + 1 with nothing but their weight."""
    dt = problem.vertex_dt
    return problem.state.pos + dt * (problem.state.vel + dt * problem.gravity.to(dt))


def _pressing(inertia: Tensor, depth: Tensor, pull: Tensor, normal: Tensor) -> Tensor:
    """P [N] (N,) of masses over dt² ``inertia`` [N/m] that would fly ``depth`` [m] deep, and of the ``internal_force`` (N, 3)
    [N]."""
    return inertia * depth.clamp_min(0.0) - _along(pull, normal).clamp_max(0.0)


def _along(vectors: Tensor, normal: Tensor) -> Tensor:
    return (vectors * normal).sum(dim=1)


def _slipping(force: Tensor, moved: Tensor, normal: Tensor, limit: Tensor) -> Tensor:
    """F f(‖u_T‖) [J] (N,) with F = ``force`` (N,), u_T the tangential part of ``moved`` (N, 3) and e = ``limit`` (N,)."""
    slip = torch.where(force.unsqueeze(1) > 0, moved, 0.0)
    slip = slip - (slip * normal).sum(dim=1, keepdim=True) * normal
    return force * mollified_norm((slip * slip).sum(dim=1), limit)

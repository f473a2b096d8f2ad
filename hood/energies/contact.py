"""Cubic penalty that keeps the cloth outside the body."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self, TypeVar, cast

import torch
from torch import Tensor

from hood.contact.contact import CentroidContact, Contact, LaggedContact, find_centroid_contact, find_lagged_contact
from hood.contact.sample_points import PLACES, REACHES, PointContact, vertex_reach
from hood.energies.laws import contact_depth, contact_energy, contact_force
from hood.energies.problem import StepProblem, dot_rows, sum_per_scene
from hood.energies.term import Energy, Form, Passes, Role

#: Which skin a vertex between two parts of the body is kept off: of the nearest alone, or of both.
SIDES = ("both", "nearest")
Weighted = TypeVar("Weighted")


def checked_contact(term: str, contact: str, reach: str, sides: str) -> tuple[str, str, str]:
    """``contact``, ``reach`` and ``sides`` of a term: of :data:`hood.contact.sample_points.PLACES`,
    :data:`hood.contact.sample_points.REACHES` and :data:`SIDES`.

    Raises:
        ValueError: they are not.
    """
    for key, value, choices in (("contact", contact, PLACES), ("reach", reach, REACHES), ("sides", sides, SIDES)):
        if value not in choices:
            raise ValueError(f"{term}: {key} is {value!r}; choose {', '.join(choices)}")
    return contact, reach, sides


def weighted(term: Weighted, weight: float) -> Weighted:
    """A copy of a term, whatever its class, with another ``weight``.

    Raises:
        ValueError: it is negative.
    """
    if weight < 0:
        raise ValueError(f"{type(term).__name__}: weight is {weight}; give weight >= 0")
    found: Any = copy(term)
    found.weight = weight
    return cast("Weighted", found)


class _Planes(NamedTuple):
    """One plane per vertex at t+1, on whose outer side it should be; rows not ``touching`` are zero."""

    touching: Tensor  # (V,) bool
    point: Tensor  # (V, 3) m
    normal: Tensor  # (V, 3) outward unit normal


@dataclass(frozen=True)
class Walls:
    """A collision term as N planes; rows without one are zero and feel nothing."""

    weight: float | Tensor  # J/m³, one for all or (N,)
    point: Tensor  # (N, 3) m
    normal: Tensor  # (N, 3)
    reach: Tensor  # (N,) m, distance at which the penalty sets in

    def depth(self, pos: Tensor) -> Tensor:
        """Depth ε - d (N,) [m] of ``pos`` (N, 3) in the contact zone, negative outside."""
        return self.reach - dot_rows(pos - self.point, self.normal)

    def pressure(self, pos: Tensor) -> Tensor:
        """Force (N,) [N] along the normals at ``pos`` (N, 3)."""
        return contact_force(self.weight, self.depth(pos))

    def take(self, rows: Tensor) -> Walls:
        """Those of some rows, int64."""
        weight = self.weight.index_select(0, rows) if isinstance(self.weight, Tensor) and self.weight.ndim else self.weight
        return Walls(weight, *(values.index_select(0, rows) for values in (self.point, self.normal, self.reach)))


class Collision(Energy):
    """Collision energy [J], the sum over vertices of w max(ε - d, 0)³ (HOOD paper, section 3.3).

    d is the signed distance to the tangent plane, on the body at t+1, of the surface point that was closest
    at t: the search happens once per step (:class:`hood.contact.contact.Contact`), which makes the energy one
    smooth function of the positions. A vertex at depth p = ε - d feels the force 3 w p² along the normal.
    Vertices without a match within the search's cap, and isolated ones, feel nothing.

    At vertices ε is ``epsilon`` and by ``reach=curvature`` the depth as well to which the skin would bulge through the flat
    triangles between them (:func:`hood.contact.sample_points.chord_error`). Like the correspondence it is found at t and
    constant in the step.

    In folds of the body, as in the bend of an elbow, a vertex lies between two parts of the skin. By ``sides=both`` it is kept
    off the one that faces the nearest as well, by the same energy (:func:`hood.contact.contact.find_second_contact`).

    With ``contact`` at more places than the vertices the same energy acts at points x_p = Σ w_i x_i of edges and faces, with w
    times the area share of the point (:class:`hood.contact.sample_points.PointContact`). Per area of cloth all points together
    press as hard as all vertices do: whatever the meshes, contact gets twice as stiff where both touch, and where an edge sags
    between vertices that do not, it is as stiff as theirs would be. Points lie where the skin bulges most: their ε is
    ``epsilon`` in any case.

    Args:
        weight: w [J/m³].
        epsilon: least distance [m] at which the penalty sets in.
        contact: ``vertices``, ``edges`` or ``strict``, see :data:`hood.contact.sample_points.PLACES`.
        reach: ``curvature`` or ``constant``, see :data:`hood.contact.sample_points.REACHES`.
        sides: ``both`` or ``nearest``, see :data:`SIDES`.
    """

    kind: ClassVar[str] = "Collision"
    role = Role.CONTACT
    form = Form.PLANES

    def __init__(
        self,
        weight: float = 5e5,
        epsilon: float = 2e-3,
        contact: str = "vertices",
        reach: str = "curvature",
        sides: str = "both",
    ) -> None:
        if weight < 0 or epsilon <= 0:
            raise ValueError(f"collision: weight is {weight}, epsilon {epsilon}; give weight >= 0 and epsilon > 0")
        self.weight = weight
        self.epsilon = epsilon
        self.contact, self.reach, self.sides = checked_contact("collision", contact, reach, sides)

    def with_weight(self, weight: float) -> Self:
        """The same term with another weight, for a ramp during training; subclasses see to what they derive from it."""
        return weighted(self, weight)

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with its contact searched for, once per step."""
        return with_places(problem, self.contact, self.sides)

    def applies(self, problem: StepProblem) -> bool:
        return problem.searched_contact is not None

    def contacts(self, problem: StepProblem) -> tuple[Contact, ...]:
        """The contacts of the vertices that the term acts at; none without a body."""
        return contacts_of(problem, self.sides)

    def planes(self, problem: StepProblem, contact: Contact) -> _Planes:
        """The planes that d is measured from, of one of :meth:`contacts`."""
        return _planes(problem, contact.valid, contact.next_point, contact.next_normal)

    def reaches(self, problem: StepProblem, contact: Contact) -> Tensor:
        """Distances ε [m] (V,) from the planes at which the penalty sets in, of one of :meth:`contacts`."""
        return vertex_reach(self.reach, self.epsilon, problem.cloth, contact, problem.state.pos)

    def depth(self, problem: StepProblem, contact: Contact, next_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Depth ε - d [m] (V,), negative outside, and normals (V, 3), of one of :meth:`contacts`; both 0 without a match."""
        planes = self.planes(problem, contact)
        dist = ((next_pos - planes.point) * planes.normal).sum(dim=1)
        return torch.where(planes.touching, self.reaches(problem, contact) - dist, 0.0), planes.normal

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        energy = next_pos.new_zeros(problem.num_scenes)
        for contact in self.contacts(problem):
            depth, _ = self.depth(problem, contact, next_pos)
            energy = energy + problem.sum_vertices(contact_energy(self.weight, depth))
        points = problem.points_at(self.contact)
        if points is None:
            return energy
        dist = ((points.at(next_pos) - points.next_point) * points.next_normal).sum(dim=1)
        pressed = contact_energy(self.weight * points.share, self.epsilon - dist)
        return energy + sum_per_scene(pressed, points.scene, problem.num_scenes)

    def walls(self, problem: StepProblem, contact: Contact) -> Walls:
        """The planes and where the penalty sets in, of one of :meth:`contacts`."""
        planes = self.planes(problem, contact)
        reach = torch.where(planes.touching, self.reaches(problem, contact), 0.0)
        return Walls(self.weight, planes.point, planes.normal, reach)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> list[Walls]:
        """One of each contact."""
        contacts = self.contacts(problem)
        rows = [None if passes is None else passes(contact) for contact in contacts]
        return [
            self.walls(problem, contact) if row is None else Walls(self.weight, *row.planes(self))
            for contact, row in zip(contacts, rows, strict=True)
        ]

    def closed_form_at(self, problem: StepProblem, points: PointContact) -> Walls | None:
        if self.contact != points.place:
            return None
        reach = torch.full_like(points.dist, self.epsilon)
        return Walls(self.weight * points.share, points.next_point, points.next_normal, reach)

    def out_of_contact(self, problem: StepProblem, pos: Tensor) -> Tensor:
        """Just inside the contact distance, where the penalty carries the weight: outside it has no curvature."""
        if problem.contact is None or not self.weight > 0:
            return pos
        carried = contact_depth(self.weight, problem.cloth.mass * problem.gravity.to(problem.vertex_dt).norm())
        depth, normal = self.depth(problem, problem.contact, pos)
        return pos + (depth - carried).clamp_min(0.0)[:, None] * normal


class CentroidCollision(Collision):
    """Collision with the planes of HOOD's published code: those of the face whose *centroid* was nearest at t.

    d = (x - c)·n with centroid c and face normal n at t+1, found for every vertex however far the body is
    (:class:`hood.contact.contact.CentroidContact`). A facet's plane jumps from face to face, the nearest centroid need
    not belong to the nearest face, and a plane found far away cuts through cloth beside the body: the default
    uses the closest point of the surface within a cap. For comparisons with that code only.

    Args:
        lagged: the body one frame behind, as the code of the ``cvpr`` weights has it: the face nearest at t - 1, its plane at
            t. That of the ``postcvpr`` weights has the face nearest at t and its plane at t + 1.
    """

    kind: ClassVar[str] = "CentroidCollision"
    form = Form.PLANES
    published = True

    def __init__(self, weight: float = 5e5, epsilon: float = 2e-3, lagged: bool = False) -> None:
        super().__init__(weight, epsilon, reach="constant", sides="nearest")
        self.lagged = lagged

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with the centroid search done, once per step."""
        return with_lagged_centroids(problem) if self.lagged else with_centroids(problem)

    def planes(self, problem: StepProblem, contact: Contact) -> _Planes:
        """The planes that d is measured from; the problem must have been prepared."""
        if self.lagged:
            contact = lagged_contact(problem)
            return _planes(problem, contact.lagged_facing, contact.lagged_centroid, contact.lagged_normal)
        if not isinstance(contact, CentroidContact):
            raise ValueError("collision with centroids: not searched for yet; pass the problem through Potential.prepare once")
        return _planes(problem, contact.facing, contact.next_centroid, contact.next_face_normal)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> list[Walls]:
        """One of each contact; the compiled pass knows no centroids."""
        return super().closed_form(problem)


def with_places(problem: StepProblem, contact: str, sides: str) -> StepProblem:
    """The problem with contact searched for at the places ``contact`` and on ``sides``; itself where that has been done."""
    problem = problem.with_points(contact)
    return problem.with_fold() if sides == "both" else problem


def contacts_of(problem: StepProblem, sides: str) -> tuple[Contact, ...]:
    """The contacts of vertices on ``sides``; none without a body."""
    if sides == "both":
        return problem.contacts
    return () if problem.contact is None else (problem.contact,)


def with_centroids(problem: StepProblem) -> StepProblem:
    """The problem with the nearest face centroids of the body at t searched for; itself where that is done, or without a
    body."""
    problem = problem.with_contact()
    if problem.contact is None or isinstance(problem.contact, CentroidContact):
        return problem
    obstacle = problem.step.obstacle
    if obstacle is None:
        raise ValueError("collision with centroids: the step has contact data but no obstacle; give StepInput.obstacle")
    contact = find_centroid_contact(problem.contact, problem.state.pos, problem.cloth.vertex_scene, obstacle)
    return replace(problem, contact=contact)


def with_lagged_centroids(problem: StepProblem) -> StepProblem:
    """The same, and those of the body at t - 1."""
    problem = with_centroids(problem)
    contact, obstacle = problem.contact, problem.step.obstacle
    if not isinstance(contact, CentroidContact) or isinstance(contact, LaggedContact):
        return problem
    assert obstacle is not None
    return replace(problem, contact=find_lagged_contact(contact, problem.state.pos, problem.cloth.vertex_scene, obstacle))


def lagged_contact(problem: StepProblem) -> LaggedContact:
    """The contact of a problem that :func:`with_lagged_centroids` has made.

    Raises:
        ValueError: nobody searched the body at t - 1.
    """
    if not isinstance(problem.contact, LaggedContact):
        raise ValueError("contact one frame back: not searched for yet; pass the problem through Potential.prepare once")
    return problem.contact


def _planes(problem: StepProblem, valid: Tensor, point: Tensor, normal: Tensor) -> _Planes:
    touching = valid & (problem.cloth.mass > 0)
    # where() before the arithmetic: rows without a match may hold infinite or undefined numbers.
    row = touching.unsqueeze(1)
    return _Planes(touching, torch.where(row, point, 0.0), torch.where(row, normal, 0.0))

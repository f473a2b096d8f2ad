"""First and second derivatives of the energies that act on single vertices, with everything constant in a step gathered."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from hood.contact.contact import Contact
from hood.energies.contact import Walls
from hood.energies.friction import Grip
from hood.energies.laws import contact_curvature, contact_energy, contact_force, mollified_norm, slip_curvature, slip_slope
from hood.energies.potential import Potential, Term
from hood.energies.problem import StepProblem, dot_rows
from hood.energies.term import MATRIX_FORMS, VERTEX_FORMS, Form, having
from hood.energies.wind import Drag
from hood.solver.derivatives import compiled_vertices
from hood.solver.derivatives.compiled_vertices import ContactPass, VertexPass, contact_pass
from hood.tensors.batch import forget
from hood.tensors.dense import safe_root


@dataclass(frozen=True)
class VertexModel:
    """Second-order model of the energies on N vertices."""

    gradient: Tensor  # (N, 3) N
    matrix: Tensor  # (N, 3, 3) N/m, positive semi-definite
    indefinite_part: Tensor | None  # (N, 3, 3) N/m, exact matrix minus ``matrix``, negative semi-definite; None for zero


@dataclass(frozen=True)
class VertexForces:
    """Inertia, gravity, contact and friction of N vertices."""

    inertia: Tensor  # (N, 1) kg, 0 where there is no such term
    stiffness: Tensor  # (N,) N/m, of inertia
    weight: Tensor  # (N, 3) N
    walls: tuple[Walls, ...]
    grips: tuple[Grip, ...]
    drags: tuple[Drag, ...] = ()  # at points inside faces alone

    @cached_property
    def compiled(self) -> VertexPass:
        """What the compiled pass reads of them, gathered once."""
        return VertexPass(self)

    def take(self, rows: Tensor) -> VertexForces:
        """Those of some vertices."""
        walls, grips = tuple(wall.take(rows) for wall in self.walls), tuple(grip.take(rows) for grip in self.grips)
        drags = tuple(drag.take(rows) for drag in self.drags)
        return VertexForces(self.inertia[rows], self.stiffness[rows], self.weight[rows], walls, grips, drags)

    def without_walls(self) -> VertexForces:
        """The same without contact."""
        return VertexForces(self.inertia, self.stiffness, self.weight, (), self.grips, self.drags)

    def energies(self, pos: Tensor, acc: Tensor, dt: Tensor) -> list[Tensor]:
        """Energies [J] (N,) of the terms at positions and accelerations (N, 3); time step ``dt`` (N, 1)."""
        moved = dt**2 * acc
        return [0.5 * self.stiffness * dot_rows(moved, moved), -dot_rows(self.weight, pos), *self.contact_energies(pos)]

    def contact_energies(self, pos: Tensor) -> list[Tensor]:
        """Those of contact, friction and drag alone."""
        parts = [contact_energy(wall.weight, wall.depth(pos)) for wall in self.walls]
        for grip in self.grips:
            slip = grip.slip(pos)
            parts.append(grip.force * mollified_norm(dot_rows(slip, slip), grip.limit))
        return parts + [drag.energy(pos) for drag in self.drags]

    def gradient(self, pos: Tensor, acc: Tensor) -> Tensor:
        """Gradient [N] (N, 3) at positions and accelerations (N, 3)."""
        gradient = self.inertia * acc - self.weight
        for wall in self.walls:
            gradient = gradient - wall.pressure(pos)[:, None] * wall.normal
        for grip in self.grips:
            slip, _, slope = _slope(grip, pos)
            gradient = gradient + slope[:, None] * slip
        for drag in self.drags:
            gradient = gradient + drag.derivatives(pos)[0]
        return gradient

    def model(self, pos: Tensor, acc: Tensor) -> VertexModel:
        """Derivatives at positions and accelerations (N, 3).

        Friction is majorised: its matrix is the slope f'/y across *and* along the slip, so that a step does not overshoot
        the kink at rest; the curvature f'' along it is smaller, which is the indefinite part.
        """
        gradient = self.inertia * acc - self.weight
        matrix = torch.diag_embed(self.stiffness.unsqueeze(1).expand(-1, 3))
        indefinite_part = None
        for wall in self.walls:
            depth = wall.depth(pos)
            gradient = gradient - contact_force(wall.weight, depth)[:, None] * wall.normal
            matrix += _outer(contact_curvature(wall.weight, depth)[:, None] * wall.normal, wall.normal)
        for grip in self.grips:
            force, block, less = _friction(grip, pos)
            gradient, matrix = gradient + force, matrix.add_(block)
            indefinite_part = less if indefinite_part is None else indefinite_part + less
        for drag in self.drags:
            force, block = drag.derivatives(pos)
            gradient, matrix = gradient + force, matrix + block
        return VertexModel(gradient, matrix, indefinite_part)


def vertex_forces(potential: Potential, problem: StepProblem, compiled: bool = False) -> VertexForces:
    """The potential's terms of :data:`hood.energies.term.VERTEX_FORMS`; ``compiled`` may leave torch."""
    inertia: Tensor | None = None
    weight: Tensor | None = None
    walls: list[Walls] = []
    grips: list[Grip] = []
    passes: dict[int, ContactPass | None] = {}

    def pass_of(contact: Contact) -> ContactPass | None:
        if id(contact) not in passes:
            passes[id(contact)] = contact_pass(problem, contact)
        return passes[id(contact)]

    for term in having(potential.active(problem), *VERTEX_FORMS).values():
        found = term.closed_form(problem, pass_of if compiled else None)
        if term.form is Form.MASS:
            inertia = found if inertia is None else inertia + found
        elif term.form is Form.WEIGHT:
            weight = found if weight is None else weight + found
        elif term.form is Form.PLANES:
            walls += found
        else:
            grips += found
    inertia = torch.zeros_like(problem.cloth.mass) if inertia is None else inertia
    weight = torch.zeros_like(problem.state.pos) if weight is None else weight
    return VertexForces(inertia[:, None], inertia / problem.vertex_dt.squeeze(1) ** 2, weight, tuple(walls), tuple(grips))


def _slope(grip: Grip, pos: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Slip (N, 3) [m], its size (N,) and the force along it in units of it (N,) [N/m]."""
    slip = grip.slip(pos)
    size = safe_root(dot_rows(slip, slip))
    return slip, size, grip.force * slip_slope(size, grip.limit)


def _friction(grip: Grip, pos: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient, matrix and indefinite part."""
    normal, (slip, size, slope) = grip.normal, _slope(grip, pos)
    along = grip.force * slip_curvature(size, grip.limit)
    heading = slip / torch.where(size > 0, size, 1.0)[:, None]
    matrix = torch.diag_embed(slope.unsqueeze(1).expand(-1, 3)) - _outer(slope[:, None] * normal, normal)
    return slope[:, None] * slip, matrix, _outer((along - slope)[:, None] * heading, heading)


class KnownForces(NamedTuple):
    """Forces of a step, and the terms that they are of."""

    problem: weakref.ref[StepProblem]
    versions: tuple[int, ...] | None
    terms: dict[str, Term]
    forces: VertexForces


#: Of the last steps that were asked about, as long as these live: by the solver, and by those who measure.
_KNOWN: dict[int, KnownForces] = {}


@torch.no_grad()
def known_forces(potential: Potential, problem: StepProblem) -> VertexForces:
    """What :func:`vertex_forces` gathers, once for a step and the same terms."""
    key, versions, terms = id(problem), problem.versions(), having(potential.terms, *VERTEX_FORMS)
    last = _KNOWN.get(key)
    if last is None or last.problem() is not problem or last.versions != versions or not _same(last.terms, terms):
        found = vertex_forces(potential, problem, compiled=True)
        last = _KNOWN[key] = KnownForces(weakref.ref(problem, forget(_KNOWN, key)), versions, terms, found)
    return last.forces


def _same(terms: Mapping[str, Term], others: Mapping[str, Term]) -> bool:
    return list(terms) == list(others) and all(a is b for a, b in zip(terms.values(), others.values(), strict=True))


def part_names(potential: Potential, problem: StepProblem) -> list[str] | None:
    """Names of the potential's terms in the order of :meth:`VertexForces.energies`, "" for none; None where several are added
    up into one."""
    terms = potential.active(problem)
    inertia, gravity = ([*having(terms, form)] for form in (Form.MASS, Form.WEIGHT))
    if max(len(inertia), len(gravity)) > 1:
        return None
    names = [(inertia or [""])[0], (gravity or [""])[0]]
    for form in (Form.PLANES, Form.GRIPS):
        for name, term in having(terms, form).items():
            names += [name] * len(term.contacts(problem))
    return names


@torch.no_grad()
def energies_and_gradient(
    potential: Potential, problem: StepProblem, next_pos: Tensor, acc: Tensor | None = None
) -> tuple[Tensor, dict[str, Tensor]]:
    """What :meth:`hood.energies.potential.Potential.gradient` computes; terms of single vertices in closed form.

    Contact that also acts inside edges and faces is left to autograd.
    """
    acc = problem.acceleration(next_pos) if acc is None else acc
    single, rest = split(potential)
    energies, gradient = _single(single, problem, next_pos, acc, slope=True)
    assert gradient is not None
    if rest.active(problem):
        slope, found = rest.gradient(problem, next_pos, acc)
        gradient, energies = gradient + slope, energies | found
    return gradient, {name: energies[name] for name in potential.terms if name in energies}


@torch.no_grad()
def total_energy(potential: Potential, problem: StepProblem, next_pos: Tensor) -> Tensor:
    """What :meth:`hood.energies.potential.Potential.total` computes, (B,) J; terms of single vertices in closed form."""
    single, rest = split(potential)
    energies = list(_single(single, problem, next_pos, problem.acceleration(next_pos), slope=False)[0].values())
    if rest.active(problem):
        energies.append(rest.total(problem, next_pos))
    return sum(energies, start=next_pos.new_zeros(problem.num_scenes))


def split(potential: Potential) -> tuple[Potential, Potential]:
    """The terms that act on single vertices alone, and the others."""
    single = {
        name: term
        for name, term in having(potential.terms, *VERTEX_FORMS).items()
        if getattr(term, "contact", "vertices") == "vertices"
    }
    return potential.only(single), potential.only({n: term for n, term in potential.terms.items() if n not in single})


def force_of(potential: Potential, problem: StepProblem, pos: Tensor) -> Tensor:
    """∂Φ/∂x [N] (V, 3) at ``pos`` (V, 3), as a function that autograd follows."""
    at = pos if pos.requires_grad else pos.detach().requires_grad_()
    single, rest = split(potential)
    total = torch.zeros_like(pos)
    if single.terms:
        total = _on_vertices(vertex_forces(single, problem), at, problem.acceleration(at))
    if rest.active(problem):
        (slope,) = torch.autograd.grad(rest.total(problem, at).sum(), at, create_graph=True)
        total = total + slope
    return total


def _on_vertices(forces: VertexForces, pos: Tensor, acc: Tensor) -> Tensor:
    total = replace(forces, grips=()).gradient(pos, acc)
    for grip in forces.grips:
        slip = grip.slip(pos)
        square = dot_rows(slip, slip)
        slips = square > 0  # the root has no slope at 0
        size = torch.where(slips, torch.where(slips, square, 1.0).sqrt(), 0.0)
        total = total + (grip.force * slip_slope(size, grip.limit)).unsqueeze(1) * slip
    return total


def _single(
    potential: Potential, problem: StepProblem, pos: Tensor, acc: Tensor, slope: bool
) -> tuple[dict[str, Tensor], Tensor | None]:
    """Energies [J] (B,) by term of those that act on single vertices, and their gradient [N] (V, 3) where asked for."""
    forces, names = known_forces(potential, problem), part_names(potential, problem)
    if names is None:
        alone = (potential.only({name: term}) for name, term in potential.active(problem).items())
        energies = {name: value for part in alone for name, value in _single(part, problem, pos, acc, slope=False)[0].items()}
        return energies, forces.gradient(pos, acc) if slope else None
    found = None
    if compiled_vertices.applies(pos):
        found = forces.compiled.evaluate(pos, acc, problem.cloth.vertex_scene, problem.step.dt, slope)
    if found is None:
        sums = [problem.sum_vertices(part) for part in forces.energies(pos, acc, problem.vertex_dt)]
        gradient = forces.gradient(pos, acc) if slope else None
    else:
        sums, gradient = list(found[0].to(pos.dtype)), None if found[1] is None else found[1].to(pos.dtype)
    energies = {}
    for name, part in zip(names, sums, strict=True):
        if name:  # on both sides of folds
            energies[name] = energies[name] + part if name in energies else part
    return energies, gradient


def terms_without_form(potential: Potential, problem: StepProblem) -> Potential | None:
    """The terms that have no closed form here and play a role in the problem; None without any."""
    active = potential.active(problem)
    known = having(active, *MATRIX_FORMS)
    if not having(active, Form.MEMBRANE):  # the two share a closed form
        known = {name: term for name, term in known.items() if term.form is not Form.MEMBRANE_DAMPING}
    others = {name: term for name, term in active.items() if name not in known}
    return potential.only(others) if others else None


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a[:, :, None] * b[:, None, :]

"""How the force of a step changes with everything that it depends on, and the linear system of its adjoint.

Of membrane, bending about the rest shape, inertia, weight, and contact and friction of vertices with a body that is constant,
the derivatives are written out, in C++ (``hood/native/elements.cpp``). Those of other terms, and of all terms where there is no
compiler, are found by autograd, which differentiates their energies twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.contact.contact import moving_contacts
from hood.contact.sample_points import edge_growth
from hood.energies import compiled_elements
from hood.energies.bending import bending_weight
from hood.energies.laws import slip_slope
from hood.energies.membrane import weave_roots
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem, dot_rows
from hood.energies.self_contact import has_layers
from hood.energies.term import Form, Role, Term, having, kind_of, role_of
from hood.native.build import BuildError
from hood.solver.compiled import newton
from hood.solver.compiled.system import CompiledSystem
from hood.solver.derivatives.compiled_vertices import FollowedBody
from hood.solver.derivatives.vertices import VertexForces, split, vertex_forces
from hood.solver.system.iterate import fixed_positions
from hood.solver.system.linear import beside, by_blocks, conjugate_gradients, diagonal_inverse, product
from hood.solver.system.plan import SolverPlan, plan_for, quadratic_model

#: Systems with the Hessian, in float32, are solved to the first number, those with the solver's matrix, which stands in for it,
#: to the second.
_EXACT, _NEAR, _MOST_ITERATIONS = 1e-5, 1e-3, 4000

#: A tensor that autograd follows, and how something changes with it.
Slope = tuple[Tensor, Tensor]


def meets(taken: StepProblem, pos: Tensor) -> bool:
    """Whether any cloth is near cloth where a step begins or at its end ``pos`` (V, 3): else layers have no derivatives."""
    near = (
        len(scene.near_at_start(taken.state.pos).corners) or len(scene.layers.contacts(scene.of(pos)).corners)
        for scene in taken.layers
    )
    return any(near)


def slopes_along(potential: Potential, problem: StepProblem, taken: StepProblem, pos: Tensor, way: Tensor) -> Iterator[Slope]:
    """How the force of a step at its minimum ``pos`` (V, 3), along ``way`` (V, 3) [m], changes with the tensors of ``problem``,
    its pins' targets included.

    Args:
        taken: the same problem with numbers alone and with its contacts, of one cloth at all steps: tables are kept by it.
        way: zero at vertices that are not free.
    """
    cloth, state, free = problem.cloth, problem.state, taken.cloth.free.unsqueeze(1)
    fixed, along = fixed_positions(problem), torch.zeros_like(pos)
    kinds, rest = _written_out(potential, taken)
    yield from _of_elements(kinds, cloth, taken.cloth, pos, way, along)
    if fixed.requires_grad:
        yield fixed, torch.where(free, 0.0, along)
    dt, active = taken.vertex_dt, rest.active(taken)
    points = {} if problem.step.dt.requires_grad else having(active, Form.MASS, Form.WEIGHT)
    for term in points.values():
        found = term.closed_form(problem)
        if term.form is Form.WEIGHT:
            yield found, -way
        else:
            pull = found.detach().unsqueeze(1) * way
            yield found, dot_rows(way, taken.acceleration(pos))
            yield state.pos, -pull / dt**2
            yield state.vel, -pull / dt
    on_body = _followed(rest, problem, taken)
    if on_body:
        yield from _of_body(potential, on_body, problem, taken, pos, way)
    others = {name: term for name, term in active.items() if name not in on_body and name not in points}
    if others:
        moving = any(_reads_contact(term, taken) for term in others.values())
        problem = with_contacts(potential, problem, taken) if moving else _with_constant_contacts(problem, taken)
        value = (way * force_of(potential.only(others), problem, torch.where(free, pos, fixed))).sum()
        yield value, torch.ones_like(value)


def _written_out(potential: Potential, taken: StepProblem) -> tuple[list[str], Potential]:
    """The kinds of energies of elements whose derivatives are written out, and the other terms."""
    if not compiled_elements.applies(taken.state.pos):
        return [], potential
    own = {name: term for name, term in potential.terms.items() if kind_of(term) in ("Stretching", "Bending")}
    kinds = [kind_of(term) for term in own.values() if term.applies(taken)]
    return kinds, potential.only({name: term for name, term in potential.terms.items() if name not in own})


def _of_elements(kinds: list[str], cloth: Cloth, known: Cloth, pos: Tensor, way: Tensor, along: Tensor) -> Iterator[Slope]:
    """Those of elements by the numbers of the cloth; the product of their Hessian with ``way`` is added to ``along``."""
    given = compiled_elements.as_double(pos), compiled_elements.as_double(way), along.numpy()
    for kind in kinds:
        if kind == "Bending":
            by = torch.from_numpy(compiled_elements.along_bending(known, *given))
            yield cloth.rest_angle, by[1]
            yield bending_weight(cloth.bending_stiffness, cloth.hinge_rest_length**2, cloth.hinge_area), by[0]
            continue
        by = torch.from_numpy(compiled_elements.along_membrane(known, *given))
        yield cloth.rest_area * cloth.thickness, by[0]
        yield cloth.rest_inverse, by[5:].t().reshape(-1, 2, 2)
        roots = weave_roots(cloth)
        if roots is None:
            yield cloth.lame_mu, by[1]
            yield cloth.lame_lambda, by[2]
        else:
            yield roots, by[1:5]


def _followed(potential: Potential, problem: StepProblem, taken: StepProblem) -> dict[str, Any]:
    """The terms of contact and friction that C++ follows: at vertices, on a body and in time steps that are constant."""
    obstacle = problem.step.obstacle
    body = () if obstacle is None else (getattr(obstacle, spec.name) for spec in fields(obstacle))
    constants = [problem.step.dt, *body]
    moves = any(isinstance(one, Tensor) and one.requires_grad for one in constants)
    if obstacle is None or moves or not compiled_elements.applies(taken.state.pos) or not len(obstacle.faces):
        return {}
    found = {}
    for name, term in having(potential.active(taken), Role.CONTACT, Role.FRICTION).items():
        numbers = (value for key, value in vars(term).items() if key != "coefficient")
        known = kind_of(term) in ("Collision", "Friction") and term.sides == "both" and term.contact == "vertices"
        if known and not any(isinstance(value, Tensor) for value in numbers):
            found[name] = term
    return found


def _of_body(
    potential: Potential,
    terms: dict[str, Any],
    problem: StepProblem,
    taken: StepProblem,
    pos: Tensor,
    way: Tensor,
) -> Iterator[Slope]:
    cloth, state, dt = problem.cloth, problem.state, taken.vertex_dt
    known = edge_growth(taken.cloth, taken.state.pos)
    body, total = FollowedBody(taken, pos, known), torch.zeros(len(pos), 16, dtype=pos.dtype)
    for term in terms.values():
        by = body.along(term, way)
        total += by
        if isinstance(getattr(term, "coefficient", None), Tensor):
            yield term.coefficient, by[:, 13].sum() / term.coefficient.detach()
    yield state.pos, total[:, :3]
    yield state.vel, total[:, 3:6]
    yield problem.gravity, (dt * total[:, 3:6]).sum(dim=0)
    yield cloth.mass, total[:, 9]
    yield cloth.friction, total[:, 10]
    yield cloth.edge_length_sq, total[:, 11]
    if known is not None and (state.pos.requires_grad or cloth.rest_edge_sq.requires_grad):
        growth = edge_growth(cloth, state.pos)
        assert growth is not None
        yield growth, total[:, 12]
    internal = potential.asked_internal(replace(taken, internal_force=None))
    if internal is None:
        return
    # The forces of the cloth around are against the slope of the energies at t.
    against, along = -total[:, 6:9], torch.zeros_like(pos)
    kinds, rest = _written_out(internal, taken)
    yield from _of_elements(kinds, cloth, taken.cloth, taken.state.pos, against, along)
    yield state.pos, along
    if rest.active(taken):
        problem = _with_constant_contacts(problem, taken)
        value = (against * force_of(rest, problem, _apart_from(state.pos))).sum()
        yield value, torch.ones_like(value)


def _reads_contact(term: Term, taken: StepProblem) -> bool:
    asks = getattr(term, "needs_internal_force", None)
    return role_of(term) in (Role.CONTACT, Role.FRICTION, Role.SELF_FRICTION) or (asks is not None and asks(taken))


def _with_constant_contacts(problem: StepProblem, taken: StepProblem) -> StepProblem:
    names = ("contact", "second_contact", "layers", "internal_force")
    return replace(problem, **{name: getattr(taken, name) for name in names})


def with_contacts(potential: Potential, problem: StepProblem, taken: StepProblem) -> StepProblem:
    """The problem with the contacts that its step was taken with, following body and cloth."""
    obstacle, problem = problem.step.obstacle, replace(problem, layers=taken.layers)
    if obstacle is not None and taken.contact is not None:
        contact, second = moving_contacts(taken.contact, taken.second_contact, problem.state.pos, obstacle)
        problem = replace(problem, contact=contact, second_contact=second)
    internal = potential.asked_internal(problem)
    if internal is None:
        return problem
    return replace(problem, internal_force=-force_of(internal, problem, _apart_from(problem.state.pos)))


def _apart_from(pos: Tensor) -> Tensor:
    """Positions at t to differentiate by, apart from those that the energies themselves know."""
    return pos.clone() if pos.requires_grad else pos.detach().requires_grad_()


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


class Hessian:
    """x (V, 3) → H x of a step at its minimum ``pos`` (V, 3), at free vertices, zero elsewhere; of numbers alone."""

    def __init__(self, potential: Potential, taken: StepProblem, pos: Tensor) -> None:
        self._taken, self._free = taken, taken.cloth.free.unsqueeze(1)
        self._own, rest = _written_out(potential, taken)
        single, rest = split(rest)
        acc = taken.acceleration(pos)
        with torch.no_grad():
            model = vertex_forces(single, taken, compiled=True).model(pos, acc)
            self._blocks = model.matrix if model.indefinite_part is None else model.matrix + model.indefinite_part
        self._pos, self._rest, self._at = compiled_elements.as_double(pos), None, pos.detach()
        if rest.active(taken):
            with torch.enable_grad():
                self._at = pos.detach().requires_grad_()
                (self._rest,) = torch.autograd.grad(rest.total(taken, self._at).sum(), self._at, create_graph=True)

    def __call__(self, x: Tensor) -> Tensor:
        direction, total = compiled_elements.as_double(x), torch.bmm(self._blocks, x.unsqueeze(2)).squeeze(2)
        for kind in self._own:
            along = compiled_elements.along_membrane if kind == "Stretching" else compiled_elements.along_bending
            along(self._taken.cloth, self._pos, direction, total.numpy())
        if self._rest is not None and self._rest.requires_grad:
            total = total + torch.autograd.grad(self._rest, self._at, x, retain_graph=True)[0]
        return torch.where(self._free, total, 0.0)


class Preconditioner:
    """r (V, 3) → nearly H⁻¹ r at free vertices, with the Hessian H of a step at its minimum ``pos`` (V, 3), zero elsewhere."""

    def __init__(self, potential: Potential, taken: StepProblem, pos: Tensor) -> None:
        self._problem, self._plan = taken, plan_for(taken)
        if has_layers(potential):  # cloth near cloth lies as it does at the minimum
            self._problem = taken.with_ways_from(pos)
        self._exact = True
        self._system = _compiled(potential, self._problem, self._plan, pos)
        if self._system is None:
            self._by_torch(potential, pos)

    def __call__(self, r: Tensor) -> Tensor:
        if self._system is None:
            return self._in_torch(r)
        right = compiled_elements.as_double(r)
        while True:
            found = np.zeros_like(right)
            engines, tolerance = self._system.engines, _EXACT if self._exact else _NEAR
            definite = all([engine.solve(right, tolerance, _MOST_ITERATIONS, found) for engine in engines])
            if definite or not self._exact:
                return torch.from_numpy(found)
            self._exact = False
            for engine in engines:
                engine.matrix(0.0)

    def _by_torch(self, potential: Potential, pos: Tensor) -> None:
        with torch.no_grad():
            model = quadratic_model(potential, self._problem, self._plan, pos, self._problem.acceleration(pos))
        pattern = self._plan.pattern
        parts = model.triples + model.indefinite_part, model.triples
        self._products = [beside(product(pattern, triples), model.layers) for triples in parts]
        self._inverse = by_blocks(diagonal_inverse(pattern, model.triples))

    def _in_torch(self, r: Tensor) -> Tensor:
        plan, count = self._plan, self._problem.num_scenes
        tolerance = torch.full((count,), _NEAR, dtype=r.dtype)
        for apply in self._products:
            given = r[plan.vertices], plan.scene, count, tolerance, _MOST_ITERATIONS
            found, _, indefinite = conjugate_gradients(apply, self._inverse, *given)
            if not bool(indefinite.any()):
                break
        return torch.zeros_like(r).index_copy(0, plan.vertices, found)


def _compiled(potential: Potential, problem: StepProblem, plan: SolverPlan, pos: Tensor) -> CompiledSystem | None:
    """The compiled solver with the Hessian at ``pos`` (V, 3); None where it does not take the problem or was not compiled."""
    if not newton.applies(potential, problem):
        return None
    try:
        system = CompiledSystem(potential, problem, plan, _MOST_ITERATIONS)
    except BuildError:
        return None
    system.begin(pos)
    system.model()
    for engine in system.engines:
        engine.exact()
    return system

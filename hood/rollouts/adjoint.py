"""How the force of a step changes with everything that it depends on, and the linear system of its adjoint.

Of membrane, bending about the rest shape, inertia, weight, and contact and friction of vertices with a body that is constant,
the derivatives are written out, in C++ (``hood/native/elements.cpp``). Those of other terms, and of all terms where there is no
compiler, are found by autograd, which differentiates their energies twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.contact.contact import CentroidContact, moving_contacts
from hood.contact.sample_points import edge_growth, find_point_contact
from hood.energies import compiled_elements
from hood.energies.bending import bending_weight
from hood.energies.membrane import weave_roots
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem, dot_rows
from hood.energies.self_contact import has_layers
from hood.energies.term import Form, Role, Term, having, kind_of, role_of
from hood.native.build import BuildError
from hood.solver.compiled import newton
from hood.solver.compiled.system import CompiledSystem
from hood.solver.derivatives.compiled_vertices import FollowedBody
from hood.solver.derivatives.vertices import force_of, split, vertex_forces
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import fixed_positions
from hood.solver.system.linear import beside, by_blocks, conjugate_gradients, diagonal_inverse, product
from hood.solver.system.plan import SolverPlan, plan_for, quadratic_model
from hood.tensors.batch import given_in, without_gradient

#: Systems with the Hessian, in float32, are solved to the first number, those with the solver's matrix, which stands in for it,
#: to the second.
_EXACT, _NEAR, _MOST_ITERATIONS = 1e-5, 1e-3, 4000
#: The adjoint system is solved to this share of its right-hand side, in at most so many products with the Hessian, from as many
#: vectors as are kept at a time.
_TOLERANCE, _MOST_PRODUCTS, _MOST_KEPT = 1e-9, 300, 60
#: Negative curvature below this share of the greatest is none.
_ROUNDING = 1e-10

#: Names of what a step finds itself, and of constants that act through what is found in a step or known of a term beforehand.
_FOUND = ("contact", "second_contact", "point_contacts", "internal_force", "layers", "sides")
_CONSTANT = {"LayerBarrier": ("reach",), "Wind": ("gusts", "gust_time")}

#: A tensor that autograd follows, and how something changes with it.
Slope = tuple[Tensor, Tensor]


def check_given(problem: StepProblem, potential: Potential) -> None:
    """Raise ValueError where a step would drop what depends on a tensor with a gradient."""
    name = next((name for name in _FOUND if given_in(getattr(problem, name))), None)
    if name is not None:
        raise ValueError(
            f"differentiable step: {name} of the problem has a tensor with a gradient, but every step finds it itself; give "
            "the body's positions as step.obstacle"
        )
    kinds = {kind_of(term) for term in potential.terms.values()}
    for key, term in potential.terms.items():
        constant = _CONSTANT.get(kind_of(term), ())
        if "LayerFriction" in kinds and kind_of(term) == "LayerBarrier":  # which lags the force of the other
            constant = (*constant, "pressure")
        wrong = next((one for one in constant if given_in(getattr(term, one, None))), None)
        if wrong is not None:
            raise ValueError(f"differentiable step: {key}.{wrong} has no derivative; give a number")
    springs = problem.step.pin_stiffness
    if springs is not None and "SoftPins" not in kinds and (springs.requires_grad or bool(springs.any())):
        raise ValueError(
            "differentiable step: the step has soft pins, but the potential has no term for them; give "
            "hood.energies.potential.with_soft_pins(potential)"
        )


def check_taken(problem: StepProblem, potential: Potential, taken: StepProblem, pos: Tensor) -> None:
    """Raise ValueError where a step that was ``taken`` to ``pos`` (V, 3) would drop what depends on a tensor with a gradient;
    ``potential`` and ``taken`` have numbers alone."""
    hidden = _depends_on_others(potential, taken, pos)
    if hidden is not None:
        raise ValueError(
            f"differentiable step: the term {hidden} depends on a tensor with a gradient that is none of its attributes; "
            "make it one (a list, a dict or a module of tensors is as good)"
        )
    obstacle = problem.step.obstacle
    body = [] if obstacle is None else [obstacle.pos, obstacle.next_pos, obstacle.prev_pos]
    if isinstance(taken.contact, CentroidContact) and given_in(body):
        raise ValueError(
            "differentiable step: a term of the published code finds contact by centroids, which has no derivative by the "
            "body; give hood.default_potential(), or a body without gradients"
        )


def _depends_on_others(potential: Potential, taken: StepProblem, pos: Tensor) -> str | None:
    """The name of an own term that depends on a tensor that requires a gradient, apart from the positions: as one that was made
    around it. None where there is no such term; ``potential`` and ``taken`` have numbers alone."""
    own = {name: term for name, term in potential.active(taken).items() if not type(term).__module__.startswith("hood.")}
    at = pos.detach().requires_grad_()
    for name, term in own.items():
        with torch.enable_grad():
            nodes = [term(taken, at, taken.acceleration(at)).grad_fn]
        seen = set(nodes)
        while nodes:
            node = nodes.pop()
            if node is None:
                continue
            if getattr(node, "variable", at) is not at:
                return name
            new = {further for further, _ in node.next_functions} - seen
            seen |= new
            nodes += new
    return None


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
    names = ("contact", "second_contact", "point_contacts", "layers", "sides", "internal_force")
    return replace(problem, **{name: getattr(taken, name) for name in names})


def with_contacts(potential: Potential, problem: StepProblem, taken: StepProblem) -> StepProblem:
    """The problem with the contacts that its step was taken with, following body and cloth."""
    obstacle, problem = problem.step.obstacle, replace(problem, layers=taken.layers, sides=taken.sides)
    if obstacle is not None and taken.contact is not None:
        contact, second = moving_contacts(taken.contact, taken.second_contact, problem.state.pos, obstacle)
        given = problem.cloth, problem.state.pos, obstacle, taken.contact
        points = tuple(find_point_contact(known.place, *given) for known in taken.point_contacts)
        problem = replace(problem, contact=contact, second_contact=second, point_contacts=points)
    internal = potential.asked_internal(problem)
    if internal is None:
        return problem
    return replace(problem, internal_force=-force_of(internal, problem, _apart_from(problem.state.pos)))


def following(potential: Potential, problem: StepProblem) -> tuple[StepProblem, StepProblem]:
    """``problem`` with what the terms of ``potential`` ask of it: as numbers alone, and with contacts that follow its state."""
    taken = potential.prepare(without_gradient(problem))
    return taken, with_contacts(potential, replace(problem, step=taken.step), taken)


def step_gap(
    potential: Potential, taken: StepProblem, followed: StepProblem, pos: Tensor, settings: NewtonSettings | None = None
) -> Tensor:
    """Φ(``pos``) − Φ(x*) [J] of every scene (B,) at positions (V, 3) at t + 1, with the minimum x* next to them.

    It is differentiable by the positions and the state, with no adjoint system: by the envelope theorem the derivative of a
    minimum's value by the state is that at the place x*. Its derivative is zero at the minimum, by the state as well.

    Args:
        taken: and ``followed``: :func:`following`.
        settings: of the search for x*.
    """
    best, _ = minimize(potential, taken, pos.detach(), settings)
    return potential.total(followed, pos) - potential.total(followed, best)


def _apart_from(pos: Tensor) -> Tensor:
    """Positions at t to differentiate by, apart from those that the energies themselves know."""
    return pos.clone() if pos.requires_grad else pos.detach().requires_grad_()


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


class Solution(NamedTuple):
    """λ of H λ = rhs, whether it is that to 1e-7, and whether a direction was seen along which H has negative curvature."""

    value: Tensor  # (V, 3)
    met: bool
    indefinite: bool


def solve_symmetric(apply: Callable[[Tensor], Tensor], precondition: Callable[[Tensor], Tensor], rhs: Tensor) -> Solution:
    """Solution of a system with a symmetric matrix that need not be definite, ``rhs`` (V, 3), by generalised minimal residuals.

    The preconditioner may differ from time to time (Saad, "A flexible inner-outer preconditioned GMRES algorithm", 1993).
    Whether the matrix is definite is asked on the space of all preconditioned directions (by its inertia there).
    """
    limit, right = _TOLERANCE * rhs.norm(), rhs.reshape(-1)
    if not bool(torch.isfinite(limit)):
        return Solution(torch.full_like(rhs, torch.nan), False, False)
    x, r, left, indefinite = torch.zeros_like(right), right, _MOST_PRODUCTS, False
    while r.norm() > limit and left > 0:
        size, rows = float(r.norm()), min(_MOST_KEPT, left)
        basis, ways = r.new_empty(rows + 1, len(r)), r.new_empty(rows, len(r))
        column = np.zeros((rows + 1, rows))
        basis[0], start = r / size, np.eye(1, rows + 1)[0] * size
        for k in range(rows):
            left -= 1
            ways[k] = precondition(basis[k].view_as(rhs)).reshape(-1)
            q = apply(ways[k].view_as(rhs)).reshape(-1)
            for _ in range(2):  # orthogonal to rounding
                share = basis[: k + 1] @ q
                q = q - share @ basis[: k + 1]
                column[: k + 1, k] += share.cpu().numpy()
            column[k + 1, k] = length = float(q.norm())
            basis[k + 1] = q / length if length > 0 else q
            known = column[: k + 2, : k + 1]
            if not np.isfinite(known).all():
                return Solution(torch.full_like(rhs, torch.nan), False, indefinite)
            y = np.linalg.lstsq(known, start[: k + 2])[0]
            missing = start[: k + 2] - known @ y
            if not np.linalg.norm(missing) > limit or not length > 0:
                break
        x = x + torch.from_numpy(y).to(r) @ ways[: k + 1]
        r = torch.from_numpy(missing).to(r) @ basis[: k + 2]
        curvature = (ways[: k + 1] @ basis[: k + 2].t()).cpu().numpy() @ known
        least, *_, most = np.linalg.eigvalsh(curvature + curvature.T)[[0, -1]]
        indefinite |= bool(least < -_ROUNDING * abs(most))
    return Solution(x.view_as(rhs), bool(r.norm() <= 1e2 * limit), indefinite)


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

"""The force of a step as a function that autograd follows, and the linear system of its adjoint, in closed form where there is one.

Of membrane, bending about the rest shape and everything that acts on single vertices the force is written out, so that autograd
differentiates it once where it would have to differentiate an energy twice; what it costs is a pass of C++ over the elements
(``hood/native/elements.cpp``). The energies of other terms are differentiated twice.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hood.energies import compiled_elements
from hood.energies.bending import Bending, bending_weight
from hood.energies.laws import slip_slope
from hood.energies.membrane import Stretching, weave_roots
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem, dot_rows
from hood.energies.self_contact import has_layers, without_layers
from hood.native.build import BuildError
from hood.solver.compiled import newton
from hood.solver.compiled.system import CompiledSystem
from hood.solver.derivatives.vertices import VertexForces, split, vertex_forces
from hood.solver.system.linear import beside, by_blocks, conjugate_gradients, diagonal_inverse, product
from hood.solver.system.plan import SolverPlan, plan_for, quadratic_model

#: Systems with the Hessian, in float32, are solved to the first number, those with the solver's matrix, which stands in for it, to
#: the second.
_EXACT, _NEAR, _MOST_ITERATIONS = 1e-5, 1e-3, 4000


def force(potential: Potential, problem: StepProblem, pos: Tensor, taken: StepProblem) -> Tensor:
    """∂Φ/∂x [N] (V, 3) at ``pos`` (V, 3), as a function of it and of what ``problem`` has that autograd follows.

    Args:
        taken: the same problem with numbers alone, of one cloth at all steps: tables are kept by it.
    """
    total = torch.zeros_like(pos)
    own, rest = _written_out(potential, problem)
    for kind in own:
        total = total + (_membrane if kind is Stretching else _bending)(problem, pos, taken)
    single, rest = split(rest)
    if single.terms:
        total = total + _on_vertices(vertex_forces(single, problem), pos, problem.acceleration(pos))
    if rest.active(problem):
        (slope,) = torch.autograd.grad(rest.total(problem, pos).sum(), pos, create_graph=True)
        total = total + slope
    return total


def _written_out(potential: Potential, problem: StepProblem) -> tuple[list[type], Potential]:
    """The kinds of energies of elements that the compiled pass knows by heart, and the other terms."""
    if not compiled_elements.applies(problem.state.pos.detach()):
        return [], potential
    own = {name: term for name, term in potential.terms.items() if type(term) in (Stretching, Bending)}
    kinds = [type(term) for term in own.values() if term.applies(problem)]
    return kinds, potential.only({name: term for name, term in potential.terms.items() if name not in own})


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
            along = compiled_elements.along_membrane if kind is Stretching else compiled_elements.along_bending
            along(self._taken.cloth, self._pos, direction, total.numpy())
        if self._rest is not None and self._rest.requires_grad:
            total = total + torch.autograd.grad(self._rest, self._at, x, retain_graph=True)[0]
        return torch.where(self._free, total, 0.0)


def _on_vertices(forces: VertexForces, pos: Tensor, acc: Tensor) -> Tensor:
    total = replace(forces, grips=()).gradient(pos, acc)
    for grip in forces.grips:
        slip = grip.slip(pos)
        square = dot_rows(slip, slip)
        slips = square > 0  # the root has no slope at 0
        size = torch.where(slips, torch.where(slips, square, 1.0).sqrt(), 0.0)
        total = total + (grip.force * slip_slope(size, grip.limit)).unsqueeze(1) * slip
    return total


def _membrane(problem: StepProblem, pos: Tensor, taken: StepProblem) -> Tensor:
    cloth = problem.cloth
    roots = weave_roots(cloth)
    law = torch.stack([cloth.lame_mu, cloth.lame_lambda]) if roots is None else roots
    return _Membrane.apply(taken, pos, cloth.rest_area * cloth.thickness, law, cloth.rest_inverse)


def _bending(problem: StepProblem, pos: Tensor, taken: StepProblem) -> Tensor:
    cloth = problem.cloth
    weight = bending_weight(cloth.bending_stiffness, cloth.hinge_rest_length**2, cloth.hinge_area)
    return _Bending.apply(taken, pos, weight, cloth.rest_angle)


def _gradient(ctx: Any, kind: type, taken: StepProblem, pos: Tensor) -> Tensor:
    ctx.cloth, ctx.pos = taken.cloth, compiled_elements.as_double(pos)
    gradient = np.zeros(tuple(pos.shape))
    compiled_elements.element_energies(Potential({"own": kind()}), taken, ctx.pos, gradient)
    return torch.from_numpy(gradient)


class _Membrane(torch.autograd.Function):
    """Gradient of the membrane's energy by positions, volumes (F,), moduli (2, F) or roots of the weave (4, F), rest edges."""

    @staticmethod
    def forward(ctx: Any, taken: StepProblem, pos: Tensor, volume: Tensor, law: Tensor, inverse: Tensor) -> Tensor:
        ctx.rows = len(law)
        return _gradient(ctx, Stretching, taken, pos)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, direction: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        along = np.zeros_like(ctx.pos)
        by = torch.from_numpy(
            compiled_elements.along_membrane(ctx.cloth, ctx.pos, compiled_elements.as_double(direction), along)
        )
        return None, torch.from_numpy(along), by[0], by[1 : 1 + ctx.rows], by[5:].t().reshape(-1, 2, 2)


class _Bending(torch.autograd.Function):
    """Gradient of the energy of bending by positions, weights (H,) and rest angles (H,)."""

    @staticmethod
    def forward(ctx: Any, taken: StepProblem, pos: Tensor, weight: Tensor, rest_angle: Tensor) -> Tensor:
        return _gradient(ctx, Bending, taken, pos)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, direction: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        along = np.zeros_like(ctx.pos)
        by = torch.from_numpy(
            compiled_elements.along_bending(ctx.cloth, ctx.pos, compiled_elements.as_double(direction), along)
        )
        return None, torch.from_numpy(along), by[0], by[1]


class Preconditioner:
    """r (V, 3) → nearly H⁻¹ r at free vertices, with the Hessian H of a step at its minimum ``pos`` (V, 3), zero elsewhere."""

    def __init__(self, potential: Potential, taken: StepProblem, pos: Tensor) -> None:
        self._problem, self._plan = taken, plan_for(taken)
        if has_layers(potential):
            near = any(len(scene.layers.contacts(scene.of(pos)).corners) for scene in taken.layers)
            potential, self._problem = (potential, taken.with_ways_from(pos)) if near else (without_layers(potential), taken)
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
    """The compiled solver with the Hessian at ``pos`` (V, 3); None where it does not take the problem, or there is no compiler."""
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

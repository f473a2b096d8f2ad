"""Implicit Euler steps that torch differentiates: derivatives of a minimum by the implicit function theorem.

At the minimum x of the incremental potential Φ(x, p) no free vertex feels a force, ∂Φ/∂x = 0, whatever the parameters p are:
fabric, rest shape, state at t, body, targets of pins, gravity, constants of the energies. So

    dx/dp = −H⁻¹ ∂²Φ/∂x∂p,  H = ∂²Φ/∂x²,

and a loss L(x) is differentiated by one linear system: H λ = ∂L/∂x, ∂L/∂p = −λ · ∂²Φ/∂x∂p. H is the Hessian itself; both are
made by :mod:`hood.rollouts.adjoint`, written out in C++ for the default energies on a constant body. Layers that touch,
attachments, air, damping, a body that is differentiated and own energies go through autograd, which is slower.

The minimum is the solver's, bit for bit. What is kept of a step are its state and its contacts; everything else is computed
again backwards. Which points of the body are nearest, and which side of a fold counts, is constant in the derivative, as it is
in the step; where they are, and the lagged forces of friction, are not.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hood.cloth.cloth import Cloth
from hood.cloth.state import State, StepInput
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import without_layers
from hood.rollouts.adjoint import Hessian, Preconditioner, meets, slopes_along
from hood.scene.jumps import find_jumps
from hood.scene.scene import Scene
from hood.solver.system.iterate import fixed_positions
from hood.steppers.newton import NewtonStepper, as_taken
from hood.tensors.batch import made_of, to_device

_T = TypeVar("_T")

#: The adjoint system is solved to this share of its right-hand side, in at most so many products with the Hessian.
_TOLERANCE, _MOST_PRODUCTS = 1e-9, 200


#: Is shown the potential, the problem of a step with the contact that it was taken with, and its minimum (V, 3) m.
Watch = Callable[[Potential, StepProblem, Tensor], None]


def differentiable_step(stepper: NewtonStepper, problem: StepProblem, watch: Watch | None = None) -> State:
    """The state at t + 1: the solver's, differentiable by every tensor of ``problem`` that requires a gradient.

    Those are the fields of its cloth (:func:`hood.cloth.cloth.with_values` makes them of a fabric and a rest shape), positions
    and velocities at t, ``gravity``, targets of pins, the body's positions, and constants of the potential's terms that are
    tensors, such as ``Friction(coefficient)``. Of a step that was not taken to its minimum, the derivative is that of
    the minimum nearby.

    Raises:
        ValueError: a tensor is not float64, contact is at edges or faces, or cloth keeps held vertices from their targets.

    Examples:
        >>> import numpy as np, torch, hood
        >>> from hood.cloth.cloth import build_cloth, with_values
        >>> from hood.cloth.state import State, StepInput
        >>> from hood.energies.problem import StepProblem
        >>> from hood.steppers.newton import NewtonStepper
        >>> pos, faces = np.array([[0, 0, 0], [0.1, 0, 0], [0, -0.1, 0], [0.1, -0.1, 0]]), np.array([[0, 2, 1], [1, 2, 3]])
        >>> held = np.array([True, True, False, False])
        >>> mu = torch.tensor(2e4, dtype=torch.float64, requires_grad=True)
        >>> cloth = with_values(build_cloth(pos, faces, hood.Material(), held, dtype=torch.float64), lame_mu=mu)
        >>> still, origin = (torch.zeros(rows, 3, dtype=torch.float64) for rows in (4, 1))
        >>> state = State(torch.as_tensor(pos), still, origin)
        >>> step = StepInput(torch.full((1,), 1 / 30, dtype=torch.float64))
        >>> after = differentiable_step(NewtonStepper(hood.default_potential()), StepProblem(cloth, state, step))
        >>> after.pos[3, 1].backward()
        >>> bool(mu.grad > 0)  # harder cloth hangs higher
        True
    """
    given = _given(problem, stepper.potential)
    wrong = next((tensor for tensor in given if tensor.dtype != torch.float64), None)
    if wrong is not None or problem.state.pos.dtype != torch.float64:
        found = problem.state.pos.dtype if wrong is None else wrong.dtype
        raise ValueError(f"differentiable step: a tensor is {found}; give cloth, state and parameters in torch.float64")
    solved = _Solved(stepper, problem, given)
    if watch is not None:
        watch(solved._plain, solved.taken, solved.pos)
    pos = _Minimum.apply(solved, *given)
    change = (pos - problem.state.pos) / problem.vertex_dt
    # The velocity is the solver's, its derivative that of the difference.
    return State(pos, solved.vel + (change - change.detach()), problem.state.origin)


def differentiable_states(
    stepper: NewtonStepper,
    scene: Scene,
    state: State,
    num_steps: int,
    cloth: Cloth | None = None,
    gravity: Tensor | None = None,
    watch: Watch | None = None,
) -> Iterator[State]:
    """States of the frames after ``state``, which is that of frame 0, each differentiable by all that came before; see
    :func:`differentiable_step`. The origin of their frame stays where that of ``state`` is.

    Args:
        cloth: default the scene's; :func:`hood.cloth.cloth.with_values` of that with a fabric to differentiate by.
        gravity: (3,) m/s²; default the stepper's.
        watch: is shown every step when it has been taken.

    Raises:
        ValueError: an event cuts the cloth in these frames, or the body jumps.
    """
    cloth, state = _in_double(scene.cloth if cloth is None else cloth), _in_double(state)
    gravity = (stepper.gravity if gravity is None else gravity).double()
    jumps = find_jumps(scene.motion, 1.0 / scene.dt)
    for frame in range(num_steps):
        if scene.cloth_of_step(frame, 0) is not scene.cloth:
            raise ValueError(f"differentiable: an event cuts the cloth in frame {frame}; leave it out, or ask for fewer frames")
        if frame in jumps:
            raise ValueError(f"differentiable: the body jumps in frame {frame}; ask for fewer frames")
        step = scene.step_input(frame, state)
        step = StepInput(*(_in_double(getattr(step, spec.name)) for spec in fields(step)))
        state = differentiable_step(stepper, StepProblem(cloth, state, step, gravity=gravity), watch)
        yield state


def _in_double(item: Any) -> Any:
    if item is None:
        return None
    return item.double() if isinstance(item, Tensor) else to_device(item, dtype=torch.float64)


class _Solved:
    """A step that was taken, and its adjoint."""

    def __init__(self, stepper: NewtonStepper, problem: StepProblem, given: tuple[Tensor, ...]) -> None:
        self.problem, self.potential, self.ids = problem, stepper.potential, [id(one) for one in given]
        plain = {key: tensor.detach() for key, tensor in zip(self.ids, given, strict=True)}
        self._plain = _with_tensors(stepper.potential, plain, number=True)
        fixed = replace(_swapped(problem, plain), cloth=_detached(problem.cloth, plain))
        own = NewtonStepper(self._plain, stepper.settings)
        with torch.no_grad():
            fixed = own.search(fixed)
            prediction = own.predict(fixed, None)
            self.taken = as_taken(fixed, prediction)
            self.pos, self.vel = prediction.next_pos, own.next_velocity(fixed, prediction)
        self._apart = not meets(self.taken, self.pos)
        if self._apart:  # what is known of layers is large
            self._plain, self.taken = without_layers(self._plain), replace(self.taken, layers=())
        self._check()

    def _check(self) -> None:
        if self.taken.point_contacts:
            raise ValueError("differentiable step: contact acts at edges or faces; give terms with contact='vertices'")
        step = self.problem.step
        if step.pin_target is not None and self.taken.step.pin_target is not None:
            held = self.problem.cloth.pinned
            if not torch.equal(step.pin_target[held], self.taken.step.pin_target[held]):
                raise ValueError(
                    "differentiable step: cloth is in the way of held vertices, which do not reach their targets in the step; "
                    "give targets nearer by, or shorter steps"
                )

    @torch.enable_grad()
    def pull_back(self, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Derivatives of a loss by what was given, of that ``grad`` (V, 3) by the positions."""
        originals = _given(self.problem, self.potential)
        leaves = [tensor.detach().requires_grad_() for tensor in originals]
        table = dict(zip(self.ids, leaves, strict=True))
        potential = _with_tensors(without_layers(self.potential) if self._apart else self.potential, table)
        problem, free = _swapped(self.problem, table), self.taken.cloth.free.unsqueeze(1)
        adjoint = self._solve(torch.where(free, grad, 0.0))
        slopes = [(of, -by) for of, by in slopes_along(potential, problem, self.taken, self.pos, adjoint) if of.requires_grad]
        fixed = fixed_positions(problem)
        if fixed.requires_grad:
            slopes.append((fixed, torch.where(free, 0.0, grad)))
        if not slopes:
            return tuple(None for _ in leaves)
        of, by = zip(*slopes, strict=True)
        return torch.autograd.grad(of, leaves, by, allow_unused=True)

    def _solve(self, rhs: Tensor) -> Tensor:
        """λ (V, 3) with H λ = ``rhs`` (V, 3) on free vertices, by conjugate gradients with nearly the same matrix as
        preconditioner."""
        with torch.no_grad():
            at = self._plain, self.taken, self.pos
            found, met = _flexible(Hessian(*at), Preconditioner(*at), rhs)
        if not met:
            warnings.warn(
                "differentiable step: the adjoint system was not solved to 1e-7: the step has not ended at a minimum, or a "
                "contact sets in there; its derivative is less exact",
                stacklevel=2,
            )
        return found


class _Minimum(torch.autograd.Function):
    """Positions of a step that was taken, as a function of what was given."""

    @staticmethod
    def forward(ctx: Any, solved: _Solved, *given: Tensor) -> Tensor:
        ctx.solved = solved
        return solved.pos.clone()

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return (None, *ctx.solved.pull_back(grad))


def _flexible(apply: Callable[[Tensor], Tensor], precondition: Callable[[Tensor], Tensor], rhs: Tensor) -> tuple[Tensor, bool]:
    """Solution of a symmetric system by conjugate gradients whose preconditioner may differ from time to time (Notay, "Flexible
    conjugate gradients", 2000), and whether it was met."""
    x, r = torch.zeros_like(rhs), rhs.clone()
    limit = _TOLERANCE * rhs.norm()
    if not bool(torch.isfinite(limit)):
        return torch.full_like(rhs, torch.nan), False
    p = q = None
    for _ in range(_MOST_PRODUCTS):
        if not r.norm() > limit:
            return x, True
        z = precondition(r)
        if p is not None and q is not None:
            z = z - (z * q).sum() / (p * q).sum() * p
        p, q = z, apply(z)
        curvature = (p * q).sum()
        if not curvature > 0:
            return x, False
        length = (p * r).sum() / curvature
        x, r = x + length * p, r - length * q
    return x, not bool(r.norm() > 1e2 * limit)


def _detached(cloth: Cloth, plain: Mapping[int, Tensor]) -> Cloth:
    """The cloth without gradients: one and the same object whenever asked, which solvers remember their tables by."""
    made = made_of(cloth)
    if "detached" not in made:
        made["detached"] = _swapped(cloth, plain)
    found = made["detached"]
    assert isinstance(found, Cloth)
    return found


def _given(problem: StepProblem, potential: Potential) -> tuple[Tensor, ...]:
    """Tensors that require a gradient, each once."""
    found: dict[int, Tensor] = {}
    _collect(problem, found)
    for term in potential.terms.values():
        for value in vars(term).values():
            _collect(value, found)
    return tuple(found.values())


def _collect(item: object, found: dict[int, Tensor]) -> None:
    if isinstance(item, Tensor):
        if item.requires_grad:
            found[id(item)] = item
    elif is_dataclass(item):
        for spec in fields(item):
            _collect(getattr(item, spec.name), found)


def _swapped(item: _T, table: Mapping[int, Tensor]) -> _T:
    """``item`` with its tensors replaced by those of the table, by what they are; itself where none is."""
    if isinstance(item, Tensor):
        return table.get(id(item), item)  # type: ignore[return-value]
    if not is_dataclass(item) or isinstance(item, type):
        return item
    there = {spec.name: getattr(item, spec.name) for spec in fields(item)}
    changed = {name: new for name, old in there.items() if (new := _swapped(old, table)) is not old}
    return replace(item, **changed) if changed else item


def _with_tensors(potential: Potential, table: Mapping[int, Tensor], number: bool = False) -> Potential:
    """The potential with constants of its terms replaced by those of the table, as numbers where asked."""
    terms = dict(potential.terms)
    for name, term in terms.items():
        new = {key: table[id(value)] for key, value in vars(term).items() if id(value) in table}
        if new:
            terms[name] = copy(term)
            vars(terms[name]).update({key: float(value) if number and value.ndim == 0 else value for key, value in new.items()})
    return potential.only(terms)

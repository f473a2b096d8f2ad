"""Implicit Euler steps that torch differentiates: derivatives of a minimum by the implicit function theorem.

At the minimum x of the incremental potential Φ(x, p) no free vertex feels a force, ∂Φ/∂x = 0, whatever the parameters p are:
fabric, rest shape, state at t, body, targets of pins, gravity, constants of the energies. So

    dx/dp = −H⁻¹ ∂²Φ/∂x∂p,  H = ∂²Φ/∂x²,

and a loss L(x) is differentiated by one linear system: H λ = ∂L/∂x, ∂L/∂p = −λ · ∂²Φ/∂x∂p. H is the Hessian itself; both are
made by :mod:`hood.rollouts.adjoint`, written out in C++ for the default energies on a constant body. Layers that touch, contact
at edges and faces, attachments, air, damping, a body that is differentiated and own energies go through autograd, which is
slower. That holds wherever no free vertex feels a force and H is not singular, also where H is indefinite: where a loosely
solved step ends at no minimum, as in a fold that buckles. :func:`indefinite_at` tells.

The minimum is the solver's, bit for bit. What is kept of a step are its state and its contacts; everything else is computed
again backwards. Which points of the body are nearest, and which side of a fold counts, is constant in the derivative, as it is
in the step; where they are, and the lagged forces of friction, are not.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from copy import copy
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hood.cloth.state import State, StepInput
from hood.energies.problem import StepProblem
from hood.energies.self_contact import without_layers
from hood.rollouts.adjoint import (
    Hessian,
    Preconditioner,
    check_given,
    check_taken,
    meets,
    slopes_along,
    solve_symmetric,
    with_contacts,
)
from hood.scene.jumps import Jump, carried, find_jumps
from hood.scene.scene import RELAXING_DT, Scene, recentre
from hood.solver.system.iterate import fixed_positions
from hood.steppers.network import NetworkStepper
from hood.steppers.newton import NewtonStepper, as_taken
from hood.steppers.refined import prepare_stepper
from hood.tensors.batch import given_in, made_of, swapped, to_device, without_gradient
from hood.tensors.dense import inputs_followed

if TYPE_CHECKING:
    from hood.cloth.cloth import Cloth
    from hood.energies.potential import Potential

#: Is shown the potential, the problem of a step with the contact that it was taken with, and its minimum (V, 3) m.
Watch = Callable[["Potential", StepProblem, Tensor], None]


def differentiable_step(
    stepper: NewtonStepper | NetworkStepper, problem: StepProblem, watch: Watch | None = None, prepared: Any = None
) -> State:
    """The state at t + 1: the stepper's, differentiable by every tensor of ``problem`` that requires a gradient.

    Those are the fields of its cloth (:func:`hood.cloth.cloth.with_values` makes them of a fabric and a rest shape), positions
    and velocities at t, ``gravity``, targets and springs of pins, attachments, the body's positions, the time step, and
    attributes of the potential's terms that are tensors, such as ``Friction(coefficient)``, or lists, dicts or modules of some.
    Of a step that was not taken to its minimum, the derivative is that of the minimum nearby.

    Of a network the derivative is its own, by autograd, in the precision of its weights: of contact, features, everything that
    it is told of the potential, and integration. The step is computed again for it. Which points are nearest is constant, and
    so are the weights; what the network is not told of has none.

    Args:
        watch: is shown a solver's step.
        prepared: of a network, what it prepared for the cloth.

    Raises:
        ValueError: a tensor is not float64, a tensor with a gradient would be dropped, or cloth keeps held vertices from their
            targets.

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
    if isinstance(stepper, NetworkStepper):
        given = _given(problem, stepper.potential)
        predicted = _Predicted(stepper, problem, prepared, given)
        pos, vel = _Prediction.apply(predicted, *given)
        return State(pos, vel, problem.state.origin)
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
    stepper: NewtonStepper | NetworkStepper,
    scene: Scene,
    state: State,
    num_steps: int,
    cloth: Cloth | None = None,
    gravity: Tensor | None = None,
    watch: Watch | None = None,
    window: int | None = None,
    relaxing: bool = False,
    potential: Potential | None = None,
) -> Iterator[State]:
    """States of the frames after ``state``, which is that of frame 0, each differentiable by all that came before; see
    :func:`differentiable_step`. The origin of their frame stays where that of ``state`` is.

    Args:
        stepper: a network computes in the precision of its weights, a solver in float64.
        cloth: default the scene's; :func:`hood.cloth.cloth.with_values` of that with a fabric to differentiate by.
        gravity: (3,) m/s²; default the stepper's.
        watch: is shown every step of a solver when it has been taken.
        window: the state at every so many frames is a constant to the frames after it; None: at none.
        relaxing: whether the first step is the relaxing one of a network that restarts from it.
        potential: that a network looks at; None: the one that it looks at when a step is taken.

    Raises:
        ValueError: the size of a flat pattern changes, and its rest shape is differentiated.
    """
    dtype = precision_of(stepper)
    scene = replace(scene, cloth=_in(scene.cloth if cloth is None else cloth, dtype))
    state, origin = _in(state, dtype), state.origin
    prepared = prepare(stepper, scene)
    for frame in range(num_steps):
        if window is not None and frame and frame % window == 0:
            state = State(state.pos.detach(), state.vel.detach(), state.origin)
        first = relaxing and frame == 0
        state = step_of_scene(stepper, scene, state, frame, gravity, None, prepared, watch, first, potential)
        yield in_frame_of(origin, state)


def step_of_scene(
    stepper: NewtonStepper | NetworkStepper,
    scene: Scene,
    state: State,
    frame: int,
    gravity: Tensor | None = None,
    targets: Tensor | None = None,
    prepared: Any = None,
    watch: Watch | None = None,
    relaxing: bool = False,
    potential: Potential | None = None,
) -> State:
    """The step ``frame`` → ``frame + 1`` of a scene whose cloth may be differentiated, with what happens to the cloth in it:
    what is held and let go, sizes that change, fasteners, and a body that jumps, with which the state is carried along.

    Args:
        targets: (V, 3) m in the frame of ``state``, where held vertices go; default where the scene has them.
        prepared: what :func:`prepare` gives.
        potential: that a network looks at in this step alone; None: the one that it looks at anyway.
    """
    cloth, dtype, origin = scene.cloth, precision_of(stepper), state.origin
    state = recentre(state, cloth.vertex_scene) if dtype == torch.float32 else state
    if scene.sizes.changing and cloth.flat is not None and (cloth.flat.requires_grad or cloth.rest_pos.requires_grad):
        raise ValueError(
            "differentiable: the size changes in this rollout, which has no derivative by the rest shape of a flat pattern; "
            "leave size_end out, or rest_pos and flat"
        )
    there = state
    if frame in _jumps_of(scene):
        there, step = carried(scene, frame, state)
    else:
        step = scene.step_input(frame, state)
    if relaxing:
        step = replace(step, dt=torch.full_like(step.dt, RELAXING_DT))
    if targets is not None:
        if step.pin_target is None:
            raise ValueError("step: targets are given, but no vertex is held in this step; give pins=… to hood.simulate")
        step = replace(step, pin_target=targets + (origin - there.origin).to(targets))
    step = StepInput(*(_in(getattr(step, spec.name), dtype) for spec in fields(step)))
    gravity = (stepper.gravity if gravity is None else gravity).to(dtype)
    problem = StepProblem(scene.cloth_of_step(frame, 0), there, step, gravity=gravity)
    shown = _looking_at(stepper, potential) if isinstance(stepper, NetworkStepper) and potential is not None else nullcontext()
    with shown:
        taken = differentiable_step(stepper, problem, watch, prepared)
    return in_frame_of(origin, taken)


def in_frame_of(origin: Tensor, state: State) -> State:
    """The state relative to another ``origin`` (1, 3) [m]; itself where that is its own."""
    shift = state.origin - origin
    return State(state.pos + shift.to(state.pos), state.vel, origin) if bool(shift.any()) else state


def precision_of(stepper: NewtonStepper | NetworkStepper) -> torch.dtype:
    """What steps are computed in: of a network, that of its weights."""
    return next(stepper.parameters()).dtype if isinstance(stepper, NetworkStepper) else torch.float64


def prepare(stepper: NewtonStepper | NetworkStepper, scene: Scene) -> Any:
    """What a network computes once per cloth, kept as long as that lives; None of a solver."""
    if not isinstance(stepper, NetworkStepper):
        return None
    made = made_of(scene.cloth.faces)
    if made.get("prepared", (None,))[0] is not stepper:
        made["prepared"] = stepper, prepare_stepper(stepper, replace(scene, cloth=without_gradient(scene.cloth)))
    return made["prepared"][1]


def _jumps_of(scene: Scene) -> dict[int, Jump]:
    made = made_of(scene.motion)
    if "jumps" not in made:
        made["jumps"] = find_jumps(scene.motion, 1.0 / scene.dt)
    found: dict[int, Jump] = made["jumps"]
    return found


def _in(item: Any, dtype: torch.dtype) -> Any:
    if item is None:
        return None
    if isinstance(item, Tensor):
        return item.to(dtype) if item.is_floating_point() else item
    return to_device(item, dtype=dtype)


class Unchanged:
    """Tensors of which the derivatives are taken later, where they must be what they were."""

    def __init__(self, given: Iterable[Tensor]) -> None:
        self._given = [(one, one._version) for one in given]

    def check(self) -> None:
        """Raise RuntimeError where one was changed in place."""
        if any(one._version != version for one, version in self._given):
            raise RuntimeError(
                "differentiable: a tensor was changed in place since the step was taken; ask for gradients before "
                "optimizer.step(), and take the steps again after it"
            )


class _Predicted:
    """A step that a network has taken, and its derivatives: the network's own, of the same step taken again in torch."""

    def __init__(self, stepper: NetworkStepper, problem: StepProblem, prepared: Any, given: tuple[Tensor, ...]) -> None:
        self._stepper, self._problem, self._prepared = stepper, problem, prepared
        self._ids, self._potential, self._unchanged = [id(one) for one in given], stepper.potential, Unchanged(given)
        plain = {key: tensor.detach() for key, tensor in zip(self._ids, given, strict=True)}
        fixed = replace(swapped(problem, plain), cloth=_detached(problem.cloth, plain))
        with torch.no_grad(), _looking_at(stepper, _with_tensors(self._potential, plain, number=True)):
            self._taken = stepper.search(fixed)
            prediction = stepper.predict(self._taken, prepared)
            self.ends = prediction.next_pos, stepper.next_velocity(self._taken, prediction)

    def pull_back(self, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Derivatives of a loss by what was given, of those by positions and velocities (V, 3) at the end."""
        self._unchanged.check()
        leaves = [tensor.detach().requires_grad_() for tensor in _given(self._problem, self._potential)]
        table = dict(zip(self._ids, leaves, strict=True))
        potential, problem = _with_tensors(self._potential, table), swapped(self._problem, table)
        with inputs_followed(), _looking_at(self._stepper, potential):
            seen = potential if self._stepper.looks_at_potential else potential.only({})
            problem = with_contacts(seen, problem, self._taken)
            prediction = self._stepper.predict(problem, self._prepared)
            ends = prediction.next_pos, self._stepper.next_velocity(problem, prediction)
            reached = [(end, grad) for end, grad in zip(ends, grads, strict=True) if end.requires_grad]
            if not reached:
                return tuple(None for _ in leaves)
            of, by = zip(*reached, strict=True)
            return torch.autograd.grad(of, leaves, by, allow_unused=True)


class _Prediction(torch.autograd.Function):
    """Positions and velocities of a step that was predicted, as functions of what was given."""

    @staticmethod
    def forward(ctx: Any, predicted: _Predicted, *given: Tensor) -> tuple[Tensor, ...]:
        ctx.predicted = predicted
        return tuple(end.clone() for end in predicted.ends)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return (None, *ctx.predicted.pull_back(*grads))


@contextmanager
def _looking_at(stepper: NetworkStepper, potential: Potential) -> Iterator[None]:
    before = stepper.potential
    stepper.use_potential(potential)
    try:
        yield
    finally:
        stepper.use_potential(before)


class _Solved:
    """A step that was taken, and its adjoint."""

    #: Whether its Hessian was seen to have negative curvature, when it was differentiated.
    indefinite = False

    def __init__(self, stepper: NewtonStepper, problem: StepProblem, given: tuple[Tensor, ...]) -> None:
        self.problem, self.potential, self._given, self._unchanged = problem, stepper.potential, given, Unchanged(given)
        check_given(problem, stepper.potential)
        plain = {id(tensor): tensor.detach() for tensor in given}
        self._plain = _with_tensors(stepper.potential, plain, number=True)
        fixed = replace(swapped(problem, plain), cloth=_detached(problem.cloth, plain))
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
        check_taken(self.problem, self._plain, self.taken, self.pos)
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
        self._unchanged.check()
        leaves = [tensor.detach().requires_grad_() for tensor in self._given]
        table = {id(tensor): leaf for tensor, leaf in zip(self._given, leaves, strict=True)}
        potential = _with_tensors(without_layers(self.potential) if self._apart else self.potential, table)
        problem, free = swapped(self.problem, table), self.taken.cloth.free.unsqueeze(1)
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
        """λ (V, 3) with H λ = ``rhs`` (V, 3) on free vertices."""
        with torch.no_grad():
            at = self._plain, self.taken, self.pos
            found = solve_symmetric(Hessian(*at), Preconditioner(*at), rhs)
        self.indefinite |= found.indefinite
        if not found.met:
            time, dt = self.taken.step.time, self.taken.step.dt
            which = "" if time is None else f" to frame {round(float(time[0] / dt[0]))}"
            warnings.warn(
                f"differentiable step: the adjoint system of the step{which} was not solved to 1e-7, as where a contact sets "
                "in or the Hessian is singular; its derivative is less exact",
                stacklevel=2,
            )
        return found.value


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


def indefinite_at(state: State) -> bool:
    """Whether the Hessian of the step to a ``state`` was seen to have negative curvature when it was differentiated: the solver
    stopped at no minimum, as where a fold buckles."""
    node: Any = state.pos.grad_fn
    while node is not None and not hasattr(node, "solved"):  # as where its origin has moved
        node = node.next_functions[0][0] if node.next_functions else None
    return node is not None and node.solved.indefinite


def _detached(cloth: Cloth, plain: Mapping[int, Tensor]) -> Cloth:
    """The cloth without gradients: one and the same object whenever asked, which solvers remember their tables by."""
    made = made_of(cloth)
    if "detached" not in made:
        made["detached"] = swapped(cloth, plain)
    found: Cloth = made["detached"]
    return found


def _given(problem: StepProblem, potential: Potential) -> tuple[Tensor, ...]:
    """Tensors that require a gradient, each once."""
    return given_in([problem, [vars(term) for term in potential.terms.values()]])


def _with_tensors(potential: Potential, table: Mapping[int, Tensor], number: bool = False) -> Potential:
    """The potential with constants of its terms replaced by those of the table; where asked, terms that have a compiled form
    get numbers in place of tensors of one."""
    terms = dict(potential.terms)
    for name, term in terms.items():
        new = {key: swapped(value, table) for key, value in vars(term).items()}
        if number and (type(term).__module__.startswith("hood.") or getattr(term, "form", None) is not None):
            new |= {key: float(value) for key, value in new.items() if isinstance(value, Tensor) and value.ndim == 0}
        if any(new[key] is not value for key, value in vars(term).items()):
            terms[name] = copy(term)
            vars(terms[name]).update(new)
    return potential.only(terms)

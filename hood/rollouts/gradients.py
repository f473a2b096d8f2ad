"""Gradients of a loss of a rollout, with an estimate of what they are off by and the steps where derivatives jump.

A derivative is that of the minimum, and a step stops near it. The rollout is taken a second time, its steps solved a hundred
times further: how much the gradients differ is what the first ones are off by, to first order. That holds for the state that a
step hands on, for the loss and for contacts that set in between the two, of which a linear estimate would know nothing. It
costs as much as the gradients themselves.

A network's step ends where it ends: its derivative is exact, to rounding, and how far it is from that of the minimum nobody
knows. Nothing is estimated there.

What takes the steps of a simulation in such rollouts, and one step of it for loops of your own.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor, nn

from hood.cloth.cloth import Cloth, with_values
from hood.cloth.state import State
from hood.energies.self_contact import for_networks
from hood.rollouts.differentiable import Unchanged, differentiable_states, indefinite_at, precision_of, prepare, step_of_scene
from hood.solver.step_figures import StepFigures
from hood.steppers.network import NetworkStepper
from hood.steppers.newton import NewtonStepper, Stepper
from hood.steppers.protocol import Relaxing
from hood.steppers.refined import RefinedStepper
from hood.steppers.static_shapes.simulator import network_of
from hood.steppers.stopping import TargetResidual
from hood.tensors.batch import made_of, to_device

if TYPE_CHECKING:
    from hood.energies.potential import Potential
    from hood.energies.problem import StepProblem
    from hood.scene.scene import Scene
    from hood.solver.newton import NewtonSettings

#: The second rollout goes to this share of the unbalanced force that the first one reached, and no further than the next.
_FURTHER, _FURTHEST = 1e-2, 1e-11
#: Times the difference: covers what the second rollout is off by itself, as where it meets a kink. The least whole number that
#: covered 35 cases of benchmarks/gradient_errors.py, other cases than those it is tested by.
SAFETY = 2.0
#: The adjoint systems are solved to about this share.
_ROUNDING = 1e-8
#: Gradients that are off by more than this share are warned about.
_WARNED = 0.01


@dataclass(frozen=True)
class FollowedStep:
    """A step of a rollout whose gradients were taken.

    Args:
        rg: unbalanced force where it ended, as a share of the weight.
        flipped: vertices that are in contact in one of the two rollouts alone: a kink of the derivative is near.
        rematched: vertices whose nearest place on the body is on another face in the other rollout.
        held_off: vertices that were held farther off the body than contact alone does, a choice that has no derivative.
        indefinite: whether negative curvature was seen where it ended: the solver stopped at no minimum, as where a fold
            buckles, and the derivative is that of the place without force there.
    """

    rg: float
    flipped: int
    rematched: int
    held_off: int
    indefinite: bool = False


@dataclass(frozen=True)
class Gradients:
    """What :meth:`DifferentiableFrames.gradients` gives.

    Args:
        loss: its value.
        by: gradients, by the names of what was given.
        error: what each is off by at most, as a share of it (of its norm): an estimate, see :mod:`hood.rollouts.gradients`.
            Empty of networks.
        steps: those from frame 0 to 1, 1 to 2, …; none of networks.
    """

    loss: float
    by: dict[str, Tensor]
    error: dict[str, float]
    steps: tuple[FollowedStep, ...]

    @property
    def jumps(self) -> list[int]:
        """Steps in or near which the derivative jumps: contacts set in or change their place, or cloth is held off."""
        return [index for index, step in enumerate(self.steps) if step.flipped or step.rematched or step.held_off]

    @property
    def indefinite(self) -> list[int]:
        """Steps whose Hessian was indefinite: they ended at no minimum."""
        return [index for index, step in enumerate(self.steps) if step.indefinite]


@dataclass(frozen=True)
class _Ended:
    """How a step ended: its rg, vertices in contact (V,), their faces (V,), how many are held farther off, and whether its
    Hessian was indefinite."""

    rg: float
    touching: Tensor
    face: Tensor | None
    held_off: int
    indefinite: bool = False


class DifferentiableFrames(Iterator[State]):
    """States of the frames 1, 2, … once, as :func:`hood.rollouts.differentiable.differentiable_states` has them.

    Args:
        given: tensors that gradients are taken by, by name; those that require none are left out.
        window: gradients go back through at most so many steps: the state at every so many frames is a constant to the frames
            after it. None: through all.
        relaxing: whether the first step is the relaxing one of a network that restarts from it.
        potential: of which a network is shown what it may look at.

    Raises:
        ValueError: ``window`` is less than 1.
    """

    def __init__(
        self,
        stepper: NewtonStepper | NetworkStepper,
        scene: Scene,
        start: State,
        num_steps: int,
        cloth: Cloth,
        gravity: Tensor | None,
        given: Mapping[str, Tensor],
        window: int | None = None,
        relaxing: bool = False,
        potential: Potential | None = None,
    ) -> None:
        if window is not None and window < 1:
            raise ValueError(f"differentiable: window is {window}; give at least 1 step, or None for all")
        self._window, self._relaxing, self._potential = window, relaxing, potential
        self._stepper, self._scene, self._start, self._num_steps = stepper, scene, start, num_steps
        self._cloth, self._gravity = cloth, gravity
        self._given = {name: value for name, value in given.items() if value.requires_grad}
        self._states, self._begun, self._unchanged = self._taken(stepper, []), False, Unchanged(self._given.values())

    def __next__(self) -> State:
        state = next(self._states)
        if not self._begun:
            self._begun = True
            self._tell_unseen(state)
        return state

    def _tell_unseen(self, first: State) -> None:
        """Warn of what a network is not told of: gradients by that are zero."""
        if not isinstance(self._stepper, NetworkStepper) or not self._given or not torch.is_grad_enabled():
            return
        ends, unseen = first.pos.sum() + first.vel.sum(), list(self._given)
        if ends.requires_grad:
            found = torch.autograd.grad(ends, list(self._given.values()), retain_graph=True, allow_unused=True)
            unseen = [name for name, grad in zip(self._given, found, strict=True) if grad is None]
        if unseen:
            warnings.warn(
                f"differentiable: the network is not told of {', '.join(unseen)}: gradients by that are zero; give "
                "hood.simulate(stepper='newton'), whose steps depend on it",
                stacklevel=3,
            )

    def gradients(self, loss: Callable[[list[State]], Tensor]) -> Gradients:
        """Gradients of a loss of all states by everything that was given and requires one, and what they are off by.

        Args:
            loss: of the states of the frames 1, 2, …; one number. It is called twice.

        Raises:
            ValueError: nothing that was given requires a gradient, or the loss depends on none of it.

        Examples:
            >>> import hood, torch
            >>> mu = torch.tensor(23600.0, dtype=torch.float64, requires_grad=True)
            >>> simulation = hood.simulate("tank", "plie", num_frames=3, stepper="newton", solver={"target_rg": 1e-6})
            >>> found = hood.differentiable(simulation, lame_mu=mu).gradients(lambda states: states[-1].pos[:, 1].mean())
            >>> bool(found.by["lame_mu"] > 0), found.error["lame_mu"] < 1e-3
            (True, True)
        """
        if not self._given:
            raise ValueError("gradients: nothing that was given requires a gradient; give tensors with requires_grad=True")
        self._unchanged.check()
        if isinstance(self._stepper, NetworkStepper):
            value, found = self._followed(loss, self._stepper, [])
            return Gradients(float(value), found, {}, ())
        near: list[_Ended] = []
        far: list[_Ended] = []
        value, found = self._followed(loss, self._stepper, near)
        reached = max((step.rg for step in near), default=0.0)
        target = max(_FURTHER * reached, _FURTHEST)
        settings = replace(self._stepper.settings, target_rg=target, max_iterations=500, budget_ms=None)
        _, better = self._followed(loss, _solver(self._stepper.potential, settings, self._stepper.gravity), far)
        error = {name: _share(found[name], better[name]) for name in found}
        steps = tuple(
            FollowedStep(
                one.rg,
                int((one.touching != other.touching).sum()),
                0 if one.face is None or other.face is None else int(((one.face != other.face) & one.touching).sum()),
                one.held_off,
                one.indefinite,
            )
            for one, other in zip(near, far, strict=True)
        )
        worst = max(error, key=error.__getitem__)
        if error[worst] > _WARNED:
            warnings.warn(
                f"gradients: that by {worst} is off by about {100 * error[worst]:.2g}%, as steps ended at an unbalanced force "
                f"of up to {reached:.2g} of the weight; give a smaller solver.target_rg",
                stacklevel=2,
            )
        return Gradients(float(value), found, error, steps)

    def _followed(
        self, loss: Callable[[list[State]], Tensor], stepper: NewtonStepper | NetworkStepper, ended: list[_Ended]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        states = [*self._taken(stepper, ended)]
        if states and not self._begun:
            self._begun = True
            self._tell_unseen(states[0])
        value = loss(states)
        if not value.requires_grad:
            raise ValueError(f"gradients: the loss does not depend on {' or '.join(self._given)}; use the states' pos or vel")
        tensors = list(self._given.values())
        # What is given may be the result of something, which both rollouts go back to.
        parts = torch.autograd.grad(value, tensors, allow_unused=True, retain_graph=True)
        ended[:] = [replace(one, indefinite=indefinite_at(state)) for one, state in zip(ended, states, strict=False)]
        found = [torch.zeros_like(one) if part is None else part for one, part in zip(tensors, parts, strict=True)]
        return value.detach(), dict(zip(self._given, found, strict=True))

    def _taken(self, stepper: NewtonStepper | NetworkStepper, ended: list[_Ended]) -> Iterator[State]:
        def watch(potential: Potential, problem: StepProblem, pos: Tensor) -> None:
            ended.append(_ended(potential, problem, pos))

        where = self._scene, self._start, self._num_steps, self._cloth, self._gravity
        shown = None if self._potential is None else for_networks(self._potential)
        return differentiable_states(stepper, *where, watch, self._window, self._relaxing, shown)


def _ended(potential: Potential, problem: StepProblem, pos: Tensor) -> _Ended:
    acc = problem.acceleration(pos)
    there = pos.detach().requires_grad_()
    with torch.enable_grad():
        contact = [
            term(problem, there, acc).sum()
            for term in potential.terms.values()
            if hasattr(term, "reach") and term.applies(problem)
        ]
        force = torch.zeros_like(pos)
        if contact:
            (force,) = torch.autograd.grad(torch.stack(contact).sum(), there)
    touching = (force != 0).any(dim=1)
    known = problem.contact
    held = 0 if known is None or known.raised is None else int((known.raised > 0).sum())
    rg = StepFigures(potential, problem, pos, acc).relative_gradient
    return _Ended(rg, touching, None if known is None else known.face, held)


def _share(found: Tensor, better: Tensor) -> float:
    size, apart = float(better.norm()), float((found - better).norm())
    return SAFETY * apart / size + _ROUNDING if size > 0 else 0.0 if apart == 0 else float("inf")


class Simulated(Protocol):
    """What a :class:`hood.Simulation` says of itself."""

    scene: Scene
    stepper: Stepper
    potential: Potential

    @property
    def relaxes(self) -> bool:
        """Whether a network that restarts from a relaxing step begins with one."""


def followed_stepper(
    simulation: Simulated, potential: Potential | None = None, given: Mapping[str, Any] | None = None
) -> NewtonStepper | NetworkStepper:
    """What takes the steps of a simulation where they are differentiated.

    A refinement to an unbalanced force ends near the minimum, wherever it begins: the solver takes its steps, as far. A network
    in fixed shapes computes in plain ones, and with tensors of float64 among those ``given`` in float64.

    Raises:
        ValueError: the steps end nowhere that is known, or an own stepper takes them.
    """
    stepper = simulation.stepper
    if isinstance(stepper, RefinedStepper):
        goal = stepper.goal
        if not isinstance(goal, TargetResidual):
            raise ValueError(
                f"differentiable: steps are refined by {type(goal).__name__}, which ends them somewhere on the way to a "
                "minimum; give hood.simulate(refine='0.01rg'), stepper='newton', or refine=0 for the network alone"
            )
        settings = replace(stepper.settings, target_rg=goal.target, max_iterations=goal.most)
        return _solver(potential or stepper.potential, settings, stepper.gravity)
    if isinstance(stepper, NewtonStepper):
        return stepper if potential is None else _solver(potential, stepper.settings, stepper.gravity)
    network = network_of(stepper)
    if network is None:
        raise ValueError(
            f"differentiable: steps are taken by {type(stepper).__name__}, whose derivatives are not known; give "
            "hood.simulate(stepper='newton') or stepper='network'"
        )
    values = (given or {}).values()
    if any(isinstance(value, Tensor) and value.dtype == torch.float64 for value in values):
        network = _in_double(network)
    return network


def step(
    simulation: Simulated,
    state: State,
    frame: int,
    *,
    targets: Tensor | None = None,
    gravity: Tensor | None = None,
    potential: Potential | None = None,
    rest_pos: Tensor | None = None,
    flat: Tensor | None = None,
    **fabric: Tensor | float,
) -> State:
    """One step of a simulation, ``frame`` → ``frame + 1``, differentiable by all that is given: for loops of your own.

    Under ``torch.no_grad`` it is a plain step. The frames of :func:`hood.differentiable` are these steps one after the other.

    Args:
        simulation: by ``stepper="newton"`` or ``"network"``, or a refinement to an unbalanced force.
        state: at ``frame``; that of frame 0 is ``simulation.start()``.
        frame: 0 is the first of the motion.
        targets: (V, 3) m in the world, where held vertices are at the end; default where the simulation has them.
        gravity, potential, rest_pos, flat, fabric: as of :func:`hood.differentiable`.

    Returns:
        The state at ``frame + 1``, relative to the same origin.

    Raises:
        ValueError: the motion has no such step, steps whose derivatives are not known, or a value that does not fit.

    Examples:
        >>> import hood, torch
        >>> mu = torch.tensor(23600.0, dtype=torch.float64, requires_grad=True)
        >>> simulation = hood.simulate("tank", "plie", num_frames=3, stepper="newton")
        >>> state = simulation.start()
        >>> for frame in range(2):
        ...     state = hood.step(simulation, state, frame, lame_mu=mu)
        >>> state.pos[:, 1].mean().backward()
        >>> bool(mu.grad > 0)  # harder cloth hangs higher
        True
    """
    scene, last = simulation.scene, simulation.scene.num_frames - 1
    if not 0 <= frame < last:
        raise ValueError(f"step: frame is {frame}; this motion has steps from the frames 0 to {last - 1}")
    if state.pos.shape != scene.cloth.rest_pos.shape:
        raise ValueError(
            f"step: state.pos has the shape {tuple(state.pos.shape)}; this cloth has {scene.cloth.num_vertices} vertices, give "
            "simulation.start() or what a step returns"
        )
    given = {"pos": state.pos, "vel": state.vel, "targets": targets, "gravity": gravity, "rest_pos": rest_pos, "flat": flat}
    shown = potential or simulation.potential
    stepper = followed_stepper(simulation, potential, given | fabric | constants_of(shown))
    dtype = precision_of(stepper)
    cloth = to_device(scene.cloth, dtype=dtype)
    if rest_pos is not None or flat is not None or fabric:
        cloth = with_values(cloth, rest_pos, flat, **fabric)
    scene = replace(scene, cloth=cloth)
    state = State(state.pos.to(dtype), state.vel.to(dtype), state.origin)
    local = None if targets is None else (targets - state.origin.to(targets.device)).to(dtype)
    relaxing = restarts(simulation, stepper) and frame == 0
    prepared = prepare(stepper, scene)
    return step_of_scene(
        stepper, scene, state, frame, gravity, local, prepared, relaxing=relaxing, potential=for_networks(shown)
    )


def restarts(simulation: Simulated, stepper: NewtonStepper | NetworkStepper) -> bool:
    """Whether the first step of a simulation, by what :func:`followed_stepper` gives, is a relaxing one."""
    return simulation.relaxes and stepper.relaxing is Relaxing.RESTART


def constants_of(potential: Potential | None) -> dict[str, Any]:
    """Constants of the terms of a potential, by names such as ``friction.coefficient``, or of what is in lists, dicts, modules
    of terms of one's own, ``stiffening.layers.0.weight``."""
    terms = {} if potential is None else potential.terms
    parts = {key: term if isinstance(term, nn.Module) else vars(term) for key, term in terms.items()}
    return dict(_named("", parts))


def _named(name: str, item: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(item, nn.Module):
        own = {key: value for key, value in vars(item).items() if not key.startswith("_")}
        item = {**dict(item.named_parameters()), **dict(item.named_buffers()), **own}
    if isinstance(item, list | tuple):
        item = dict(enumerate(item))
    if not isinstance(item, dict):
        yield name, item
        return
    for key, value in item.items():
        yield from _named(f"{name}.{key}" if name else str(key), value)


def _solver(potential: Potential, settings: NewtonSettings, gravity: Tensor) -> NewtonStepper:
    solver = NewtonStepper(potential, settings)
    solver.gravity = gravity
    return solver


def _in_double(network: NetworkStepper) -> NetworkStepper:
    """The network with weights of float64; kept as long as it lives and its weights and statistics stay what they are."""
    made, known = made_of(network), [*network.parameters(), *network.buffers()]
    versions = [(id(one), one._version) for one in known]
    if made.get("double", (None,))[0] != versions:
        copy = network.clone().double().eval()
        copy.network.use_kernels("torch")
        copy.network.use_precision("fp32")
        made["double"] = versions, copy, known  # what is kept alive has its id alone
    found: NetworkStepper = made["double"][1]
    found.gravity = network.gravity.double()
    return found

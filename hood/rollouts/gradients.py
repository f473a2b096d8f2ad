"""Gradients of a loss of a rollout, with an estimate of what they are off by and the steps where derivatives jump.

A derivative is that of the minimum, and a step stops near it. The rollout is taken a second time, its steps solved a hundred
times further: how much the gradients differ is what the first ones are off by, to first order. That holds for the state that a
step hands on, for the loss and for contacts that set in between the two, of which a linear estimate would know nothing. It
costs as much as the gradients themselves.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import State
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.rollouts.differentiable import differentiable_states
from hood.scene.scene import Scene
from hood.solver.step_figures import StepFigures
from hood.steppers.newton import NewtonStepper

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
    """

    rg: float
    flipped: int
    rematched: int
    held_off: int


@dataclass(frozen=True)
class Gradients:
    """What :meth:`DifferentiableFrames.gradients` gives.

    Args:
        loss: its value.
        by: gradients, by the names of what was given.
        error: what each is off by at most, as a share of it (of its norm): an estimate, see :mod:`hood.rollouts.gradients`.
        steps: those from frame 0 to 1, 1 to 2, …
    """

    loss: float
    by: dict[str, Tensor]
    error: dict[str, float]
    steps: tuple[FollowedStep, ...]

    @property
    def jumps(self) -> list[int]:
        """Steps in or near which the derivative jumps: contacts set in or change their place, or cloth is held off."""
        return [index for index, step in enumerate(self.steps) if step.flipped or step.rematched or step.held_off]


@dataclass(frozen=True)
class _Ended:
    """How a step ended: its rg, vertices in contact (V,), their faces (V,), and how many are held farther off."""

    rg: float
    touching: Tensor
    face: Tensor | None
    held_off: int


class DifferentiableFrames(Iterator[State]):
    """States of the frames 1, 2, … once, as :func:`hood.rollouts.differentiable.differentiable_states` has them.

    Args:
        given: tensors that gradients are taken by, by name; those that require none are left out.
    """

    def __init__(
        self,
        stepper: NewtonStepper,
        scene: Scene,
        start: State,
        num_steps: int,
        cloth: Cloth,
        gravity: Tensor | None,
        given: Mapping[str, Tensor],
    ) -> None:
        self._stepper, self._scene, self._start, self._num_steps = stepper, scene, start, num_steps
        self._cloth, self._gravity = cloth, gravity
        self._given = {name: value for name, value in given.items() if value.requires_grad}
        self._states = self._taken(stepper, [])

    def __next__(self) -> State:
        return next(self._states)

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
        near: list[_Ended] = []
        far: list[_Ended] = []
        value, found = self._followed(loss, self._stepper, near)
        reached = max((step.rg for step in near), default=0.0)
        target = max(_FURTHER * reached, _FURTHEST)
        settings = replace(self._stepper.settings, target_rg=target, max_iterations=500, budget_ms=None)
        _, better = self._followed(loss, NewtonStepper(self._stepper.potential, settings), far)
        error = {name: _share(found[name], better[name]) for name in found}
        steps = tuple(
            FollowedStep(
                one.rg,
                int((one.touching != other.touching).sum()),
                0 if one.face is None or other.face is None else int(((one.face != other.face) & one.touching).sum()),
                one.held_off,
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
        self, loss: Callable[[list[State]], Tensor], stepper: NewtonStepper, ended: list[_Ended]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        value = loss([*self._taken(stepper, ended)])
        if not value.requires_grad:
            raise ValueError(f"gradients: the loss does not depend on {' or '.join(self._given)}; use the states' pos or vel")
        tensors = list(self._given.values())
        # What is given may be the result of something, which both rollouts go back to.
        parts = torch.autograd.grad(value, tensors, allow_unused=True, retain_graph=True)
        found = [torch.zeros_like(one) if part is None else part for one, part in zip(tensors, parts, strict=True)]
        return value.detach(), dict(zip(self._given, found, strict=True))

    def _taken(self, stepper: NewtonStepper, ended: list[_Ended]) -> Iterator[State]:
        def watch(potential: Potential, problem: StepProblem, pos: Tensor) -> None:
            ended.append(_ended(potential, problem, pos))

        return differentiable_states(stepper, self._scene, self._start, self._num_steps, self._cloth, self._gravity, watch)


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

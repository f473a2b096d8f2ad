"""A state of the unknowns during a minimisation, in the form that keeps its precision."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem, inertial_guess
from hood.energies.self_contact import without_layers
from hood.energies.term import Role, having
from hood.mesh.cloth_proximity import EASED
from hood.solver.derivatives.self_contact import approached, eased, layers_of, limits
from hood.solver.derivatives.step_terms import StepTerms
from hood.tensors.batch import made_of, to_device


@dataclass(frozen=True)
class Iterate:
    """Candidate next positions and what they are worth."""

    pos: Tensor  # (V, 3) m
    acc: Tensor  # (V, 3) m/s²
    phi: Tensor  # (B,) J
    noise: Tensor  # (B,) J, rounding of phi


@dataclass(frozen=True)
class Progress:
    """Where a minimisation stood before an iteration."""

    seconds: float
    phi: Tensor  # (B,) J
    relative_gradient: Tensor  # (B,); NaN where nobody asked for it


#: Asked before every iteration, with where the minimisation stands and the positions (V, 3) there: whether to go on.
Proceed = Callable[[Progress, Tensor], bool]


class Unknowns:
    """The unknown next positions of a step, as accelerations: in float32 positions would not resolve inertia."""

    def __init__(self, potential: Potential, problem: StepProblem) -> None:
        self.potential, self.problem, self.terms = potential, problem, StepTerms(potential, problem)
        self.scene = problem.cloth.vertex_scene
        self.free = problem.cloth.free.unsqueeze(1)
        self.dt_sq = problem.vertex_dt**2
        self._base = inertial_guess(problem.state, problem.step, self.scene)
        self._fixed = fixed_positions(problem)
        self._fixed_acc = (self._fixed - self._base) / self.dt_sq
        self.layers = layers_of(potential, problem)

    def begin(self, start: Tensor | None) -> Iterate:
        """The iterate at positions (V, 3), or at the default of :func:`first_iterate`; near it, where cloth would cross cloth
        on the way there."""
        if not self.layers:
            return first_iterate(self) if start is None else self.at(start)
        target = self._guess_apart() if start is None else self.place((start - self._base) / self.dt_sq)
        there = approached(self.layers, target)
        return self.at(there)

    def _guess_apart(self) -> Tensor:
        """The guess that would be best if layers did not touch."""
        return first_iterate(Unknowns(without_layers(self.potential), self.problem)).pos

    def free_share(self, now: Iterate, acc: Tensor) -> Tensor | None:
        """Shares (B,) of the straight ways from ``now`` to ``acc`` (V, 3) on which no cloth meets cloth; None: all of them."""
        if not self.layers:
            return None
        share = limits(self.layers, now.pos, self.place(acc))
        return None if bool((share >= 1.0).all()) else share

    def around(self, now: Iterate, acc: Tensor, share: Tensor) -> tuple[Iterate, Tensor] | None:
        """The iterate near accelerations (V, 3) by ways that are bent around cloth, and the scenes (B,) bool that need it, of
        which only a small ``share`` (B,) of the straight ways is free; None without any."""
        blocked = share < EASED
        if not bool(blocked.any()):
            return None
        return self.at(eased(self.layers, now.pos, self.place(acc))), blocked

    def at(self, pos: Tensor) -> Iterate:
        """The iterate at positions (V, 3), of which free vertices are read."""
        return self.evaluate((pos - self._base) / self.dt_sq)

    def place(self, acc: Tensor) -> Tensor:
        """Positions (V, 3) reached with ``acc`` (V, 3)."""
        return torch.where(self.free, self._base + self.dt_sq * acc, self._fixed)

    def place_free(self, rows: Tensor, acc: Tensor) -> Tensor:
        """The same for some free vertices (n,), from their accelerations (n, 3)."""
        return self._base[rows] + self.dt_sq[rows] * acc

    def evaluate(self, acc: Tensor) -> Iterate:
        """The iterate with accelerations (V, 3), of which free vertices are read."""
        acc = torch.where(self.free, acc, self._fixed_acc)
        pos = self.place(acc)
        with torch.no_grad():
            energies = self.terms.energies(pos, acc)
        zero = pos.new_zeros(self.problem.num_scenes)
        size = sum((energy.abs() for energy in energies), start=zero)
        return Iterate(pos, acc, sum(energies, start=zero), 8.0 * torch.finfo(pos.dtype).eps * size)

    def select(self, moved: Tensor, there: Iterate, here: Iterate) -> Iterate:
        """``there`` in the scenes ``moved`` (B,) bool, ``here`` in the others."""
        by_vertex = moved[self.scene].unsqueeze(1)
        return Iterate(
            torch.where(by_vertex, there.pos, here.pos),
            torch.where(by_vertex, there.acc, here.acc),
            torch.where(moved, there.phi, here.phi),
            torch.where(moved, there.noise, here.noise),
        )


def first_iterate(unknowns: Unknowns) -> Iterate:
    """The start: :func:`projected_guess` with or without gravity, whichever has the lower potential in a scene.

    Cloth in the air falls freely; what hangs or lies is held by forces that cancel its weight, and goes on as it moves.
    """
    falling, held = (unknowns.at(projected_guess(unknowns.potential, unknowns.problem, falls)) for falls in (True, False))
    return unknowns.select(held.phi < falling.phi, held, falling)


def projected_guess(potential: Potential, problem: StepProblem, falls: bool = True) -> Tensor:
    """Free flight x_t + dt v_t, with dt² g if it ``falls``, then out of the body along the matched normals: (V, 3).

    Vertices are left just inside the contact distance, where the penalty carries their weight: outside it the penalty
    has no curvature and the first iteration would overshoot.
    """
    cloth, dt = problem.cloth, problem.vertex_dt
    gravity = problem.gravity.to(dt)
    guess = inertial_guess(problem.state, problem.step, cloth.vertex_scene) + (dt**2 * gravity if falls else 0.0)
    for term in list(having(potential.terms, Role.CONTACT).values())[:1]:
        guess = term.out_of_contact(problem, guess)
    return torch.where(cloth.free.unsqueeze(1), guess, fixed_positions(problem))


def fixed_positions(problem: StepProblem) -> Tensor:
    """Where vertices go that the solver does not move: pins to their targets, massless ones stay. (V, 3)."""
    target = problem.step.pin_target
    if target is None:
        return problem.state.pos
    return torch.where(problem.cloth.pinned.unsqueeze(1), target, problem.state.pos)


def in_double(problem: StepProblem) -> StepProblem:
    """The same problem in float64; of the body only the contact is read then."""
    if problem.state.pos.dtype == torch.float64:
        return problem
    return _in_precision(problem, _double_cloth(problem.cloth))


def in_single(problem: StepProblem, cloth: Cloth) -> StepProblem:
    """The same problem in float32, with its ``cloth`` in float32: what is known of a cloth is found by the object."""
    single = _in_precision(problem, cloth)
    obstacle = problem.step.obstacle
    if obstacle is None:
        return single
    return replace(single, step=replace(single.step, obstacle=to_device(obstacle, dtype=torch.float32)))


def _in_precision(problem: StepProblem, cloth: Cloth) -> StepProblem:
    """The problem in the precision of ``cloth``, but for the obstacle."""
    step, real = problem.step, cloth.rest_pos.dtype
    return StepProblem(
        cloth,
        to_device(problem.state, dtype=real),
        replace(
            step,
            dt=step.dt.to(real),
            pin_target=None if step.pin_target is None else step.pin_target.to(real),
            pin_stiffness=None if step.pin_stiffness is None else step.pin_stiffness.to(real),
        ),
        None if problem.contact is None else to_device(problem.contact, dtype=real),
        problem.gravity.to(real),
        tuple(to_device(points, dtype=real) for points in problem.point_contacts),
        None if problem.internal_force is None else problem.internal_force.to(real),
        problem.layers,
        None if problem.sides is None else to_device(problem.sides, dtype=real),
        None if problem.second_contact is None else problem.second_contact.to(real),
    )


def _double_cloth(cloth: Cloth) -> Cloth:
    """The same cloth in float64, kept as long as the cloth lives."""
    made = made_of(cloth)
    if "double" not in made:
        made["double"] = to_device(cloth, dtype=torch.float64)
    double: Cloth = made["double"]
    return double


def rounded(problem: StepProblem, pos: Tensor) -> Tensor:
    """``pos`` (V, 3) in the problem's type, fixed vertices exactly where it says."""
    return torch.where(problem.cloth.free.unsqueeze(1), pos.to(problem.state.pos.dtype), fixed_positions(problem))

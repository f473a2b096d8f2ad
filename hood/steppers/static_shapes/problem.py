"""Problems of steps of fixed shapes: as lists of tensors, with the search for contact as part of the step."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar

import torch
from torch import Tensor

from hood.cloth.state import Attachments, Obstacle, State
from hood.contact.contact import SecondContact, find_contact, find_fixed_contact, find_static_second_contact
from hood.contact.further import find_second_side
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem, free_flight
from hood.energies.term import Energy, prepared
from hood.mesh.closest_point.search import Incidence, build_incidence

_Item = TypeVar("_Item")
_OBSTACLE = tuple(field.name for field in fields(Obstacle))


class Constants:
    """What a step of fixed shapes reads of a problem when it is made, and never again."""

    def __init__(self, problem: StepProblem, potential: Potential | None) -> None:
        attachments = problem.step.attachments
        self._cloth, self._gravity, self._potential = problem.cloth, problem.gravity, potential
        self._attachments = None if attachments is None else _values(attachments)

    def hold(self, problem: StepProblem, potential: Potential | None) -> bool:
        """Whether they are the same in another problem; gravity counts where a potential does."""
        if problem.cloth is not self._cloth or potential is not self._potential:
            return False
        if potential is not None and problem.gravity is not self._gravity:
            if not torch.equal(problem.gravity, self._gravity):
                return False
        return _same_attachments(self._attachments, problem.step.attachments)


def settled_potential(potential: Potential, problem: StepProblem) -> Potential:
    """The terms of ``potential`` that play a role in ``problem`` and in all problems like it.

    Raises:
        ValueError: a term searches for more than contact with the body's surface, or has gusts.
    """
    with_contact = problem.with_fold()
    for name, term in potential.terms.items():
        if isinstance(term, Energy) and term.varies_in_time():
            raise ValueError(
                f"losses.terms.{name} has gusts, which are another in every step and place; steps of fixed shapes have no form "
                f"of that: use step=plain, or losses.terms.{name}.gusts=0"
            )
        if prepared(term, with_contact) is not with_contact:
            raise ValueError(
                f"losses.terms.{name} is a {type(term).__name__}, which searches for more than contact with the body's "
                "surface; steps of fixed shapes have no form of that: use step=plain"
            )
    return potential.settled(with_contact)


def step_inputs(problem: StepProblem, surface: bool = False) -> list[Tensor]:
    """What may differ from step to step, in the order that steps of fixed shapes take it.

    Args:
        surface: with what a search for contact with the body's surface needs to know of it.
    """
    step, obstacle = problem.step, problem.step.obstacle
    values = [problem.state.pos, problem.state.vel, step.dt, step.pin_target]
    if obstacle is not None:
        values += [getattr(obstacle, name) for name in _OBSTACLE]
        values += build_incidence(obstacle.faces, len(obstacle.pos)) if surface else []
    return [value for value in values if value is not None]


def problem_from(like: StepProblem, inputs: Sequence[Tensor]) -> tuple[StepProblem, Incidence | None]:
    """A problem like ``like`` with the ``inputs`` of another, and its body's connectivity if they hold that."""
    pos, vel, dt, *rest = inputs
    values, obstacle = iter(rest), like.step.obstacle
    pins = None if like.step.pin_target is None else next(values)
    if obstacle is not None:
        present = {name: next(values) for name in _OBSTACLE if getattr(obstacle, name) is not None}
        obstacle = altered(obstacle, **present)
    tables = list(values)
    step = altered(like.step, dt=dt, pin_target=pins, obstacle=obstacle)
    problem = altered(
        like, state=State(pos, vel, like.state.origin), step=step, contact=None, internal_force=None, second_contact=None
    )
    return problem, Incidence(*tables) if tables else None


def with_fixed_contact(
    problem: StepProblem, incidence: Incidence | None, places: int, folds: bool = False, dense: bool = False
) -> tuple[StepProblem, Tensor]:
    """The problem with its contact with the body's surface, without any where the connectivity is missing, and the number (1,)
    of faces that need a place.

    Args:
        places: for faces that every cloth vertex is tested against.
        folds: on the other side of folds as well, for all vertices whatever is found.
        dense: in torch on a CPU too, as on any other device.
    """
    obstacle, pos, cloth = problem.step.obstacle, problem.state.pos, problem.cloth
    if obstacle is None or incidence is None:
        return altered(problem, contact=None), cloth.faces.new_zeros(1)
    if pos.device.type == "cpu" and not dense:
        contact, num_faces = find_contact(pos, cloth.vertex_scene, obstacle), cloth.faces.new_zeros(1)
        fold = find_second_side(pos, cloth.vertex_scene, obstacle, contact, free_flight(problem)) if folds else None
        if fold is not None and fold.contact is None:
            fold = SecondContact(altered(contact, valid=torch.zeros_like(contact.valid)))
    else:
        surface = obstacle, incidence, cloth.num_scenes, places
        contact, num_faces = find_fixed_contact(pos, cloth.vertex_scene, *surface)
        fold = find_static_second_contact(pos, cloth.vertex_scene, contact, *surface) if folds else None
    return altered(problem, contact=contact, second_contact=fold), num_faces


def step_shape(problem: StepProblem, surface: bool = False) -> tuple[Any, ...]:
    """Equal for problems whose inputs fit the same step."""
    step, obstacle = problem.step, problem.step.obstacle
    present = tuple(obstacle is not None and getattr(obstacle, name) is not None for name in _OBSTACLE)
    sizes = tuple((tuple(value.shape), value.dtype, value.device) for value in step_inputs(problem, surface))
    return (step.pin_target is not None, present, sizes)


def altered(item: _Item, **values: Any) -> _Item:
    """A copy with other fields; unlike ``dataclasses.replace`` it checks nothing, since a check would wait for the device."""
    altered = copy.copy(item)
    for name, value in values.items():
        object.__setattr__(altered, name, value)
    return altered


def _values(attachments: Attachments) -> list[Tensor | None]:
    given = [getattr(attachments, field.name) for field in fields(attachments)]
    return [None if value is None else value.clone() for value in given]


def _same_attachments(known: list[Tensor | None] | None, now: Attachments | None) -> bool:
    if known is None or now is None:
        return known is None and now is None
    pairs = zip(known, _values(now), strict=True)
    return all(b is None if a is None else b is not None and torch.equal(a, b) for a, b in pairs)

"""Dihedral bending energy."""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from hood.energies.problem import StepProblem, sum_per_scene
from hood.energies.term import Energy, Form, Passes, Role
from hood.mesh.geometry import dihedral_angles


class HingeForm(NamedTuple):
    """What of the angles of hinges an energy is: ½ weight (θ - θ₀)², or one that differs in this."""

    by_length: bool = False  # about flat, with the length of the edge now in place of that at rest
    damping: float | None = None  # s, retardation time of an energy about the angles at t; None: elastic


class Bending(Energy):
    """Discrete-shell bending energy [J], the sum over hinges of ½ k l₀² / (4 (A₁ + A₂)) (θ - θ₀)².

    Rest length l₀ and rest angle θ₀ make the rest shape, curved or flat, a state of zero energy; HOOD's
    published code does otherwise, see :class:`CurrentLengthBending`. The difference of angles is taken to (-π, π].
    The energy does not depend on the winding of the faces. Hinges with a degenerate face at present have θ = 0
    and no force.

    k → ``cloth.bending_stiffness`` [J] (H,), l₀ → ``cloth.hinge_rest_length`` [m], A₁ + A₂ → ``cloth.hinge_area`` [m²],
    θ₀ → ``cloth.rest_angle`` [rad].
    """

    kind: ClassVar[str] = "Bending"
    role = Role.ELASTIC
    form = Form.HINGES

    def applies(self, problem: StepProblem) -> bool:
        return problem.cloth.hinges.shape[0] > 0

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        cloth = problem.cloth
        bend = dihedral_angles(next_pos, cloth.hinges) - cloth.rest_angle
        bend = bend - 2.0 * math.pi * torch.round(bend.detach() / (2.0 * math.pi))
        energy = 0.5 * bending_weight(cloth.bending_stiffness, cloth.hinge_rest_length**2, cloth.hinge_area) * bend * bend
        return sum_per_scene(energy, cloth.hinge_scene, cloth.num_scenes)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> HingeForm:
        return HingeForm()


class CurrentLengthBending(Energy):
    """Bending as in HOOD's published code [J], the sum over hinges of ½ k l² / (4 (A₁ + A₂)) θ².

    l is the *current* length of the hinge's edge and the rest angle is 0 whatever the rest shape, so that curved
    garments open when left alone and a stretched edge bends harder, both unphysical: for comparisons with that
    code only. The areas are those at rest: current ones would make the energy infinite where a face collapses.
    Equal to :class:`Bending` where the rest shape is flat and the edges have their rest length. Hinges with a
    degenerate face have no force.

    k → ``cloth.bending_stiffness`` [J] (H,), A₁ + A₂ → ``cloth.hinge_area`` [m²].
    """

    kind: ClassVar[str] = "CurrentLengthBending"
    role = Role.ELASTIC
    form = Form.HINGES

    def applies(self, problem: StepProblem) -> bool:
        return problem.cloth.hinges.shape[0] > 0

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        cloth = problem.cloth
        angle = dihedral_angles(next_pos, cloth.hinges)
        edge = next_pos[cloth.hinges[:, 1]] - next_pos[cloth.hinges[:, 0]]
        weight = bending_weight(cloth.bending_stiffness, (edge * edge).sum(dim=1), cloth.hinge_area)
        return sum_per_scene(0.5 * weight * angle * angle, cloth.hinge_scene, cloth.num_scenes)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> HingeForm:
        return HingeForm(by_length=True)


def bending_weight(stiffness: Tensor, length_sq: Tensor, hinge_area: Tensor) -> Tensor:
    """Second derivative of the energy by the angle [J], k l² / (4 (A₁ + A₂)), shape (H,); 0 without area."""
    positive = hinge_area > 0
    return torch.where(positive, stiffness * length_sq / (4.0 * torch.where(positive, hinge_area, 1.0)), 0.0)

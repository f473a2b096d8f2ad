"""Dihedral bending energy."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hood.losses.problem import StepProblem, sum_per_scene
from hood.mesh.geometry import dihedral_angles


class Bending:
    """Discrete-shell bending energy [J], the sum over hinges of ½ k l₀² / (4 (A₁ + A₂)) (θ - θ₀)².

    Rest length l₀ and rest angle θ₀ make the rest shape, curved or flat, a state of zero energy. (HOOD's
    published code uses the current edge length and θ₀ = 0.) The difference of angles is taken to (-π, π]. The
    energy does not depend on the winding of the faces. Hinges with a degenerate face at present have θ = 0
    and no force.

    k → ``cloth.bending_stiffness`` (H,), l₀ → ``cloth.rest_length`` [m], A₁ + A₂ → ``cloth.hinge_area`` [m²],
    θ₀ → ``cloth.rest_angle`` [rad].
    """

    def applies(self, problem: StepProblem) -> bool:
        return problem.cloth.hinges.shape[0] > 0

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        cloth = problem.cloth
        bend = dihedral_angles(next_pos, cloth.hinges) - cloth.rest_angle
        bend = bend - 2.0 * math.pi * torch.round(bend.detach() / (2.0 * math.pi))
        energy = 0.5 * bending_weight(cloth.bending_stiffness, cloth.rest_length, cloth.hinge_area) * bend * bend
        return sum_per_scene(energy, cloth.hinge_scene, cloth.num_scenes)


def bending_weight(stiffness: Tensor, rest_length: Tensor, hinge_area: Tensor) -> Tensor:
    """Second derivative of the energy by the angle [J], k l₀² / (4 (A₁ + A₂)), shape (H,); 0 without area."""
    positive = hinge_area > 0
    return torch.where(positive, stiffness * rest_length**2 / (4.0 * torch.where(positive, hinge_area, 1.0)), 0.0)

"""Damping of the fabric by its rate of strain and of bending."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from hood.energies.bending import HingeForm, bending_weight
from hood.energies.membrane import green_strain, membrane_density
from hood.energies.problem import StepProblem, sum_per_scene
from hood.energies.term import Energy, Form, Passes, Role
from hood.mesh.geometry import dihedral_angles


class StretchDamping(Energy):
    """Viscosity of the membrane as a dissipative potential of the step [J], Σ A h (η / dt) (μ tr ΔG² + ½ λ tr² ΔG).

    ΔG = G(x) - G(x_t) is the Green strain that the step adds: a Kelvin-Voigt solid, whose viscous stress is η times the rate
    of its elastic one (stiffness-proportional Rayleigh damping). A small vibration of ω [1/s] dies as exp(-η ω² t / 2).
    Rigid motion is not damped; no net force or torque. Cloth with warp and weft has the density of
    :mod:`hood.energies.membrane` in place of μ tr ΔG² + ½ λ tr² ΔG.

    Args:
        time: η [s], the retardation time of the fabric.
    """

    kind: ClassVar[str] = "StretchDamping"
    role = Role.DAMPING
    form = Form.MEMBRANE_DAMPING

    def __init__(self, time: float) -> None:
        self.time = _checked("stretch_damping", time)

    def applies(self, problem: StepProblem) -> bool:
        return self.time > 0

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        cloth = problem.cloth
        now, before = (green_strain(pos, cloth.faces, cloth.rest_inverse) for pos in (next_pos, problem.state.pos))
        g00, g01, g11 = (a - b for a, b in zip(now, before, strict=True))
        density = membrane_density(cloth, (g00, g01, g11))
        rate = self.time / problem.step.dt[cloth.face_scene]
        return sum_per_scene(rate * cloth.rest_area * cloth.thickness * density, cloth.face_scene, cloth.num_scenes)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> float:
        """Retardation time [s]."""
        return self.time


class BendDamping(Energy):
    """Viscosity of bending as a dissipative potential of the step [J], Σ ½ k l₀² / (4 (A₁ + A₂)) (η / dt) (θ - θ_t)².

    The same of :class:`hood.energies.bending.Bending` as :class:`StretchDamping` is of stretching; hinges with a
    degenerate face have θ = 0 as there.

    Args:
        time: η [s], the retardation time of the fabric.
    """

    kind: ClassVar[str] = "BendDamping"
    role = Role.DAMPING
    form = Form.HINGES

    def __init__(self, time: float) -> None:
        self.time = _checked("bend_damping", time)

    def applies(self, problem: StepProblem) -> bool:
        return self.time > 0 and problem.cloth.hinges.shape[0] > 0

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        cloth = problem.cloth
        bend = dihedral_angles(next_pos, cloth.hinges) - dihedral_angles(problem.state.pos, cloth.hinges)
        bend = bend - 2.0 * math.pi * torch.round(bend.detach() / (2.0 * math.pi))
        rate = self.time / problem.step.dt[cloth.hinge_scene]
        weight = bending_weight(cloth.bending_stiffness, cloth.hinge_rest_length**2, cloth.hinge_area)
        return sum_per_scene(0.5 * rate * weight * bend * bend, cloth.hinge_scene, cloth.num_scenes)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> HingeForm:
        return HingeForm(damping=self.time)


def stretch_damping(time: float = 0.0) -> StretchDamping | None:
    """The term of a config; None, which a potential leaves out, for a ``time`` of 0."""
    return StretchDamping(time) if time else None


def bend_damping(time: float = 0.0) -> BendDamping | None:
    """The same of bending."""
    return BendDamping(time) if time else None


def _checked(term: str, time: float) -> float:
    if not (math.isfinite(time) and time >= 0):
        raise ValueError(f"{term}: time is {time}; give seconds >= 0, 0 for none")
    return time

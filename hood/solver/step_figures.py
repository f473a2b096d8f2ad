"""What is measured of a step that was taken: energies, the force left over, and what they are compared with.

On a CPU everything goes through compiled passes and numpy: between two frames a small call of torch costs 30 µs, and there are
a hundred of them. :class:`hood.losses.potential.Potential` is the reference, and computes the energies on an accelerator and
without a compiler.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hood.losses import elements
from hood.losses.potential import Potential
from hood.losses.problem import STANDARD_GRAVITY, StepProblem
from hood.solver import forces, vertex_pass


class StepFigures:
    """Figures of one scene's step to ``next_pos``.

    Args:
        potential: what the step is measured by.
        problem: a prepared problem of one scene.
        next_pos: (V, 3) m.
        acc: (V, 3) m/s², what led there.
    """

    gradient: Tensor  # (V, 3) N, ∂Φ/∂x
    energies: dict[str, float]  # J, of the terms that the scene needs

    def __init__(self, potential: Potential, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> None:
        self._potential, self._problem = potential, problem
        self._compiled = elements.applies(next_pos) and vertex_pass.applies(next_pos)
        if self._compiled:
            gradient = np.zeros(tuple(next_pos.shape))
            found = self._compiled_energies(elements.as_double(next_pos), elements.as_double(acc), gradient)
            self.gradient = torch.from_numpy(gradient)
        else:
            self.gradient, parts = elements.energies_and_gradient(
                potential, problem, next_pos, acc, by=forces.energies_and_gradient
            )
            found = {name: float(value) for name, value in parts.items()}
        self.energies = {name: found[name] for name in potential.terms if name in found}

    @np.errstate(all="ignore")  # a step may be anywhere, or nowhere
    def metrics(self) -> dict[str, float]:
        """Energies [J], and for comparison the potential of the inertial guess x_t + dt v_t; gradient norm [N] (the paper's:
        mean over vertices of ‖∂Φ/∂x_v‖₂), rg (:func:`hood.losses.potential.relative_gradient`) and e0 [J]
        (:func:`hood.losses.potential.scale`)."""
        result = {f"energy_{name}": value for name, value in self.energies.items()}
        result["energy_total"] = sum(result.values())
        result["energy_inertial_guess"] = self._of_guess()
        size = np.sqrt(self._forces_sq)
        result["gradient_norm"] = float(size.mean()) if len(size) else 0.0
        result["relative_gradient"] = self.relative_gradient
        dt, mass = float(self._problem.step.dt[0]), elements.as_double(self._problem.cloth.mass)
        result["e0"] = 0.5 * float(mass.sum()) * (self._gravity * dt) ** 2
        return result

    @property
    @np.errstate(all="ignore")
    def relative_gradient(self) -> float:
        """rg alone: the force left over as a share of the weight."""
        moving = elements.as_double(self._problem.cloth.mass)[self._free]
        weight_sq = self._gravity**2 * float(moving @ moving)
        return float(np.sqrt(self._forces_sq.sum() / weight_sq)) if weight_sq > 0 else 0.0

    @property
    def _forces_sq(self) -> np.ndarray:
        """(N,) N², ‖∂Φ/∂x_v‖² of the free vertices."""
        slope = elements.as_double(self.gradient)
        return np.asarray(np.einsum("vi,vi->v", slope, slope)[self._free])

    @property
    def _free(self) -> np.ndarray:
        return np.asarray(self._problem.cloth.free.cpu().numpy())

    @property
    def _gravity(self) -> float:
        return float(np.linalg.norm(elements.as_double(self._problem.gravity))) or STANDARD_GRAVITY

    def _of_guess(self) -> float:
        """Φ [J] where the cloth would be without forces, pins where they go."""
        problem, dt = self._problem, float(self._problem.step.dt[0])
        state, target = problem.state, problem.step.pin_target
        guess = elements.as_double(state.pos) + dt * elements.as_double(state.vel)
        acc = np.zeros_like(guess)
        if target is not None:
            pinned = problem.cloth.pinned.cpu().numpy()
            goal = elements.as_double(target)[pinned]
            acc[pinned] = (goal - guess[pinned]) / dt**2
            guess[pinned] = goal
        if self._compiled:
            return sum(self._compiled_energies(guess, acc, None).values())
        pos = torch.from_numpy(guess).to(state.pos)
        return float(elements.total_energy(self._potential, problem, pos, by=forces.total_energy).sum())

    def _compiled_energies(self, pos: np.ndarray, acc: np.ndarray, gradient: np.ndarray | None) -> dict[str, float]:
        """Energies [J] by term, other terms than those of the passes by torch; their gradient is added to ``gradient``."""
        problem = self._problem
        found = elements.element_energies(self._potential, problem, pos, gradient)
        energies = {name: float(value[0]) for name, value in found.items()}
        others = elements.split(self._potential)[0]
        single, rest = forces.split(others)
        known = forces.known(single, problem)
        if known.names is not None:
            others, step = rest, problem.step
            parts = known.forces.compiled.add(pos, acc, problem.cloth.vertex_scene, step.dt, gradient)
            energies |= {name: value for name, value in zip(known.names, parts[:, 0].tolist(), strict=True) if name}
        if not others.active(problem):
            return energies
        place, given = (torch.from_numpy(values).to(problem.state.pos) for values in (pos, acc))
        if gradient is None:
            return energies | {name: float(value) for name, value in others.energies(problem, place, given).items()}
        slope, parts_of_rest = others.gradient(problem, place, given)
        gradient += elements.as_double(slope)
        return energies | {name: float(value) for name, value in parts_of_rest.items()}

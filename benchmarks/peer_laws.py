"""The energies of Newton's VBD and Style3D, coded apart from Newton, and the error of a step under an energy of any kind."""

from __future__ import annotations

import numpy as np
import torch
from peer_scenes import Membrane, Moment, Setting, at_rest, hinge_stiffness, membrane, problem_at, resting_energy
from peer_style3d import panels
from scipy import optimize
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.energies.membrane import green_strain
from hood.energies.potential import Potential, scale
from hood.energies.problem import StepProblem, sum_per_scene
from hood.solver.step_figures import strain_metrics


class NeoHookean:
    """Energy [J] of VBD's membrane, the sum over faces of A (½ μ (tr FᵀF - 2) + ½ L (J - 1 - μ / L)²) with J the ratio of areas
    and L = λ + μ, as Newton 1.8 has it (after Smith et al., "Stable Neo-Hookean flesh simulation", 2018), less its value at
    rest. μ and λ are those of :func:`peer_scenes.membrane`."""

    def applies(self, problem: StepProblem) -> bool:
        return True

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        cloth = problem.cloth
        mu, lam = cloth.thickness * cloth.lame_mu, cloth.thickness * cloth.lame_lambda
        g00, g01, g11 = green_strain(next_pos, cloth.faces, cloth.rest_inverse)
        c00, c01, c11 = 2.0 * g00 + 1.0, 2.0 * g01, 2.0 * g11 + 1.0
        ratio = (c00 * c11 - c01 * c01).clamp_min(1e-20).sqrt()
        stiff = lam + mu
        density = 0.5 * mu * (c00 + c11 - 2.0) + 0.5 * stiff * ((ratio - 1.0 - mu / stiff) ** 2 - (mu / stiff) ** 2)
        return sum_per_scene(cloth.rest_area * density, cloth.face_scene, cloth.num_scenes)


class BaraffWitkin:
    """Energy [J] of Style3D's membrane of a ``law`` on a ``cloth``, see ``peer_style3d.py``: the sum over faces of
    A (½ E h ((|F_u| - 1)² + (|F_v| - 1)²) + ½ h μ cos² of the angle of F_u and F_v).

    Style3D's force of the shear leaves out what is of second order, so Style3D ends near its minimum and not at it.
    """

    def __init__(self, cloth: Cloth, law: Membrane) -> None:
        corners = panels(cloth.rest_pos.double().numpy(), cloth.faces.numpy())
        self._inverse = torch.as_tensor(np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)))
        self._law = law

    def applies(self, problem: StepProblem) -> bool:
        return True

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        cloth = problem.cloth
        x = next_pos[cloth.faces]
        axes = (x[:, 1:] - x[:, :1]).transpose(1, 2) @ self._inverse.to(x)
        length = torch.linalg.vector_norm(axes, dim=1)
        cosine = (axes[:, :, 0] * axes[:, :, 1]).sum(dim=1) / length.prod(dim=1)
        density = 0.5 * self._law.young * ((length - 1.0) ** 2).sum(dim=1) + 0.5 * self._law.mu * cosine**2
        return sum_per_scene(cloth.rest_area * density, cloth.face_scene, cloth.num_scenes)


class FlatBending:
    """Energy [J] of Style3D's bending, the sum over hinges of ½ K |w·x|² / l₀² with w the cotangents of Bergou et al., "A
    quadratic bending model for inextensible surfaces" (2006), and K of :func:`peer_scenes.hinge_stiffness`. Flat at rest."""

    def __init__(self, cloth: Cloth) -> None:
        rest, hinges = cloth.rest_pos.double().numpy(), cloth.hinges.numpy()
        first, second, third, fourth = (rest[hinges[:, number]] for number in range(4))
        length = np.linalg.norm(second - first, axis=1)
        at_first = _cotangent(first, second, third), _cotangent(first, second, fourth)
        at_second = _cotangent(second, first, third), _cotangent(second, first, fourth)
        weights = np.stack([sum(at_second), sum(at_first), -at_first[0] - at_second[0], -at_first[1] - at_second[1]], axis=1)
        self._weights = torch.as_tensor(weights / length[:, None])
        self._stiffness = torch.as_tensor(hinge_stiffness(cloth))

    def applies(self, problem: StepProblem) -> bool:
        return True

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (1,) of one scene at ``next_pos`` (V, 3)."""
        bent = (self._weights.to(next_pos).unsqueeze(2) * next_pos[problem.cloth.hinges]).sum(dim=1)
        return 0.5 * (self._stiffness.to(next_pos) * (bent * bent).sum(dim=1)).sum().reshape(1)


def _cotangent(at: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(H,) of the angles at corners (H, 3) between two others."""
    cross = np.linalg.norm(np.cross(one - at, other - at), axis=1)
    return ((one - at) * (other - at)).sum(axis=1) / cross


def own_rest(potential: Potential, problem: StepProblem, pos: np.ndarray) -> np.ndarray:
    """(V, 3) m where L-BFGS from ``pos`` (V, 3) leaves the energy of a ``potential`` of any terms without inertia."""
    free = (~problem.cloth.pinned).numpy()

    def at(moved: np.ndarray) -> Tensor:
        there = pos.copy()
        there[free] += moved.reshape(-1, 3)
        return torch.as_tensor(there)

    def value(moved: np.ndarray) -> tuple[float, np.ndarray]:
        gradient, energies = potential.gradient(problem, at(moved))
        return 1e3 * float(sum(energies.values())), 1e3 * gradient.numpy()[free].reshape(-1)

    zero = np.zeros(3 * int(free.sum()))
    options = {"maxiter": 1000, "maxfun": 2000, "ftol": 1e-13, "maxcor": 20}
    return at(optimize.minimize(value, zero, jac=True, method="L-BFGS-B", options=options).x).numpy()


def own_gamma(potential: Potential, problem: StepProblem, origin: np.ndarray, next_pos: np.ndarray) -> float:
    """γ of ``next_pos`` (V, 3) for a ``potential`` of any terms, above the minimum that L-BFGS finds from there.

    hood's solver is not asked: its matrices are of its own energies. Without contact only, which is searched for by hood.
    """
    cloth, start = problem.cloth, next_pos - origin
    free = (~cloth.pinned).numpy()
    # Light vertices go farther for the same energy.
    size = (cloth.mass.mean() / cloth.mass).sqrt().numpy()[free, None]

    def at(moved: np.ndarray) -> Tensor:
        pos = start.copy()
        pos[free] += size * moved.reshape(-1, 3)
        return torch.as_tensor(pos)

    def value(moved: np.ndarray) -> tuple[float, np.ndarray]:
        gradient, energies = potential.gradient(problem, at(moved))
        return float(sum(energies.values())) / e0, (size * gradient.numpy()[free]).reshape(-1) / e0

    e0 = float(scale(problem))
    zero = np.zeros(3 * int(free.sum()))
    found = optimize.minimize(
        value, zero, jac=True, method="L-BFGS-B", options={"maxiter": 3000, "maxfun": 4000, "ftol": 1e-13}
    )
    return value(zero)[0] - float(found.fun)


def own_potentials(setting: Setting, potential: Potential) -> dict[str, Potential]:
    """The potential with the elastic energies of Newton's solvers in place of hood's, by the solver."""
    law, cloth = membrane(setting.fabric), setting.cloth
    style3d = {"stretching": BaraffWitkin(cloth, law), "bending": FlatBending(cloth)}
    return {"vbd": potential.with_terms(stretching=NeoHookean()), "style3d": potential.with_terms(**style3d)}


def rests(setting: Setting, potential: Potential) -> None:
    """Where a sheet rests by hood's energy, and by those of others from there."""
    hung = at_rest(setting, potential, setting.start.pos)
    problem, origin = problem_at(setting, 0, Moment(hung, np.zeros_like(hung)))
    for name, own in {"hood": None, **own_potentials(setting, potential)}.items():
        pos = hung
        if own is not None:
            still = own.only({key: term for key, term in own.terms.items() if key in ("stretching", "bending", "gravity")})
            pos = own_rest(still, problem, hung - origin) + origin
        above = resting_energy(setting.cloth, pos) - resting_energy(setting.cloth, hung)
        strain = strain_metrics(setting.cloth, torch.as_tensor(pos))["strain_p99"]
        print(f"{name:12} {1e3 * above:8.2f} mJ above hood's rest, strain p99 {strain:.4f}", flush=True)

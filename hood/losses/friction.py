"""Coulomb friction between cloth and body, as a lagged potential."""

from __future__ import annotations

import torch
from torch import Tensor

from hood.losses.problem import StepProblem
from hood.scene.contact import Contact


class Friction:
    """Friction energy [J], the sum over vertices of μ_f N f(‖u_T‖).

    u_T is the tangential slip from t to t+1 relative to the matched body point, N = 3 w max(ε - d_t, 0)² the
    normal force of the collision term at t (lagged, so that the friction is a potential). f is the C¹
    mollifier of Li et al. ("Incremental Potential Contact", 2020, eq. 12 and 13) with e = ``slip_speed`` ·
    dt: quadratic-cubic below a slip of e, equal to ‖u_T‖ above. The force is at most μ_f N and reaches it at
    ``slip_speed``; below, contacts creep.

    Args:
        coefficient: μ_f.
        slip_speed: ε_v [m/s], speed below which friction counts as static.
        weight, epsilon: w [J/m³] and ε [m] of the collision term.
    """

    def __init__(self, coefficient: float = 0.5, slip_speed: float = 5e-3, weight: float = 5e5, epsilon: float = 2e-3) -> None:
        if coefficient < 0 or slip_speed <= 0:
            raise ValueError(
                f"friction: coefficient is {coefficient}, slip_speed {slip_speed}; give coefficient >= 0 and slip_speed > 0"
            )
        self.coefficient = coefficient
        self.slip_speed = slip_speed
        self.weight = weight
        self.epsilon = epsilon

    def with_weight(self, weight: float) -> Friction:
        """The same term with another collision weight, for a ramp during training."""
        return Friction(self.coefficient, self.slip_speed, weight, self.epsilon)

    def applies(self, problem: StepProblem) -> bool:
        return problem.contact is not None and self.coefficient > 0

    def normal_force(self, problem: StepProblem, contact: Contact) -> Tensor:
        """Lagged normal forces N [N], shape (V,)."""
        touching = contact.valid & (problem.cloth.mass > 0)
        dist = torch.where(touching, contact.dist, self.epsilon)
        return 3.0 * self.weight * (self.epsilon - dist).clamp_min(0.0) ** 2

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        contact = problem.contact
        if contact is None:
            return next_pos.new_zeros(problem.num_scenes)
        force = self.normal_force(problem, contact)
        slip = (next_pos - problem.state.pos) - (contact.next_point - contact.point)
        slip = torch.where(force.unsqueeze(1) > 0, slip, 0.0)
        normal = contact.next_normal
        slip = slip - (slip * normal).sum(dim=1, keepdim=True) * normal
        limit = self.slip_speed * problem.vertex_dt.squeeze(1)
        return problem.sum_vertices(self.coefficient * force * mollified_norm((slip * slip).sum(dim=1), limit))


def mollified_norm(norm_sq: Tensor, limit: Tensor) -> Tensor:
    """f(y) for y² = ``norm_sq``: y²/e - y³/(3e²) + e/3 below e = ``limit``, y above; C¹, flat at y = 0."""
    positive = norm_sq > 0
    norm = torch.where(positive, torch.where(positive, norm_sq, 1.0).sqrt(), 0.0)
    small = norm_sq / limit * (1.0 - norm / (3.0 * limit)) + limit / 3.0
    return torch.where(norm < limit, small, norm)

"""The scalar laws of contact and friction, each with its slope and curvature: what training, solver and refinement compute.

The compiled forms take the same laws from ``hood/native/laws.h``. A friction law f(y) must be flat at 0, twice
differentiable, have f'' <= f' / y, and be y from the limit on: the solvers rely on it. :func:`mollified_norm` takes the square
of the slip; ``friction_curvature`` in C++ holds the force. Orders of operations are part of a law: results of earlier versions
stay the same to the last bit.
"""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor

Weight = TypeVar("Weight", float, Tensor, float | Tensor)


def contact_energy(weight: float | Tensor, depth: Tensor) -> Tensor:
    """w p³ [J] (N,) of depths p = max(ε - d, 0) [m], by ``depth`` = ε - d (N,) and w = ``weight`` [J/m³], one or (N,)."""
    return weight * depth.clamp_min(0.0) ** 3


def contact_force(weight: float | Tensor, depth: Tensor) -> Tensor:
    """3 w p² [N] (N,), the slope of :func:`contact_energy`."""
    depth = depth.clamp_min(0.0)
    return contact_stiffness(weight) * depth * depth


def lagged_contact_force(weight: float | Tensor, depth: Tensor) -> Tensor:
    """:func:`contact_force` as friction takes it at the start of a step: the square first, which rounds otherwise."""
    return contact_stiffness(weight) * depth.clamp_min(0.0) ** 2


def contact_curvature(weight: float | Tensor, depth: Tensor) -> Tensor:
    """6 w p [N/m] (N,), the slope of :func:`contact_force`."""
    return 6.0 * weight * depth.clamp_min(0.0)


def contact_stiffness(weight: Weight) -> Weight:
    """3 w [N/m²]: force by the square of the depth."""
    return 3.0 * weight


def contact_depth(weight: float, force: Tensor) -> Tensor:
    """Depths p [m] (N,) at which contact carries forces (N,) [N]."""
    return (force / contact_stiffness(weight)).sqrt()


def contact_push(weight: float | Tensor, start: Tensor, end: Tensor, compliance: Tensor) -> Tensor:
    """Forces (N,) [N] that take contact from the depth ``end`` where a Newton model leads to the one where the whole penalty
    balances that model.

    Args:
        start: (N,) m, depth at the state, at least 0.
        end: (N,) m, signed.
        compliance: (N,) m/N, of everything in the model.
    """
    cubic = contact_stiffness(weight)
    # The model's own force at the end, and the stiffness of everything else.
    force = cubic * start * (2.0 * end - start)
    rest = torch.maximum(1.0 / compliance - 2.0 * cubic * start, 0.1 / compliance)
    # cubic q² + rest (q - end) = force for the depth q >= 0.
    load = (force + rest * end).clamp_min(0.0)
    balance = 2.0 * load / (rest + (rest * rest + 4.0 * cubic * load).sqrt())
    return torch.where(end > balance, end - balance, 0.0) / compliance


def contact_balance(weight: float | Tensor, depth: Tensor, compliance: Tensor) -> Tensor:
    """Depths p [m] (N,) with p = s - a 3 w p²: where contact meets the ``compliance`` a (N,) [m/N] of all else, which alone
    would lead to depths s = ``depth`` (N,), at least 0."""
    return 2.0 * depth / (1.0 + (1.0 + 12.0 * weight * compliance * depth).sqrt())


def mollified_norm(norm_sq: Tensor, limit: Tensor) -> Tensor:
    """f(y) [m] for slips y² = ``norm_sq`` (N,): y²/e - y³/(3e²) + e/3 below e = ``limit`` (N,) [m], y above; C², flat at 0.

    The mollifier of Li et al., "Incremental Potential Contact" (2020), equations 12 and 13.
    """
    positive = norm_sq > 0
    norm = torch.where(positive, torch.where(positive, norm_sq, 1.0).sqrt(), 0.0)
    small = norm_sq / limit * (1.0 - norm / (3.0 * limit)) + limit / 3.0
    return torch.where(norm < limit, small, norm)


def slip_slope(norm: Tensor, limit: Tensor) -> Tensor:
    """f'(y) / y [1/m] (N,) of :func:`mollified_norm` at y = ``norm`` (N,) [m]: finite at 0, and positive."""
    small = norm < limit
    return torch.where(small, (2.0 - norm / limit) / limit, 1.0 / torch.where(small, 1.0, norm))


def slip_curvature(norm: Tensor, limit: Tensor) -> Tensor:
    """f''(y) [1/m] (N,) of :func:`mollified_norm`, 0 beyond the limit."""
    return torch.where(norm < limit, 2.0 * (1.0 - norm / limit) / limit, 0.0)

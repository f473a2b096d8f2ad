"""The start state: a skinned garment, taken out of the body and brought near its rest lengths."""

from __future__ import annotations

import torch
from torch import Tensor

from hood.scene.cloth import Cloth
from hood.scene.contact import find_contact
from hood.scene.state import Obstacle

#: Edges may start this much longer or shorter than at rest; beyond it they are projected back.
_STRAIN_LIMIT = 0.04
_SEARCH_EVERY = 10


def settle(cloth: Cloth, pos: Tensor, obstacle: Obstacle | None, clearance: float = 2e-3, iterations: int = 60) -> Tensor:
    """Positions (V, 3) [m] near ``pos`` with bounded edge strain, at least ``clearance`` [m] outside the body.

    Skinning stretches loose cloth between the limbs and pushes cuffs into the skin; the first frame would then start with
    forces far beyond the weight. Alternates averaged edge-length projections (position based dynamics, Müller et al. 2007)
    with pushing out along the body's normals; ends with the latter. Pinned vertices stay.
    """
    start, end = cloth.edges.unbind(dim=1)
    rest_length = (cloth.rest_pos[end] - cloth.rest_pos[start]).norm(dim=1)
    free = cloth.free.to(pos.dtype)
    share = free[start] + free[end]
    valence = torch.zeros_like(free).index_add(0, start, share.sign()).index_add(0, end, share.sign()).clamp_min(1.0)
    contact = None
    for iteration in range(iterations):
        if obstacle is not None:
            if iteration % _SEARCH_EVERY == 0:
                contact = find_contact(pos, cloth.vertex_scene, obstacle)
            assert contact is not None
            depth = (clearance - ((pos - contact.point) * contact.normal).sum(1)).clamp_min(0.0)
            pos = pos + (depth * contact.valid * free).unsqueeze(1) * contact.normal
        if iteration == iterations - 1:
            break
        span = pos[end] - pos[start]
        length = span.norm(dim=1)
        target = torch.minimum(torch.maximum(length, rest_length * (1 - _STRAIN_LIMIT)), rest_length * (1 + _STRAIN_LIMIT))
        move = span * ((length - target) / length.clamp_min(1e-9) / share.clamp_min(1.0)).unsqueeze(1)
        total = torch.zeros_like(pos).index_add(0, start, move).index_add(0, end, -move)
        # Over-relaxed Jacobi: plain averaging needs about twice the iterations.
        pos = pos + 1.5 * total / valence.unsqueeze(1) * free.unsqueeze(1)
    return push_out(cloth, pos, obstacle, clearance)


def push_out(cloth: Cloth, pos: Tensor, obstacle: Obstacle | None, clearance: float, rounds: int = 4) -> Tensor:
    """``pos`` (V, 3) with every free vertex at least ``clearance`` [m] outside the body at t (up to ``rounds`` searches:
    leaving one limb may enter another)."""
    if obstacle is None:
        return pos
    free = cloth.free
    for _ in range(rounds):
        contact = find_contact(pos, cloth.vertex_scene, obstacle)
        # The margin covers the difference between the tangent plane and the true distance.
        depth = (clearance - contact.dist) * (contact.valid & free)
        if not bool((depth > 0).any()):
            break
        pos = pos + (depth.clamp_min(0.0) + 2e-4 * (depth > 0)).unsqueeze(1) * contact.normal
    return pos

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
#: A thorough start goes on while an edge is stretched by more, so many times.
_STRETCH_LIMIT, _MOST_ROUNDS = 0.08, 3
#: Iterations of such a round, and the spectral radius its acceleration assumes.
_ROUND, _RADIUS = 240, 0.99
#: Plain iterations first: the acceleration assumes that errors shrink.
_PLAIN = 5


def settle(
    cloth: Cloth,
    pos: Tensor,
    obstacle: Obstacle | None,
    clearance: float = 2e-3,
    iterations: int = 60,
    thorough: bool = False,
) -> Tensor:
    """Positions (V, 3) [m] near ``pos`` with bounded edge strain, at least ``clearance`` [m] outside the body.

    Skinning stretches loose cloth between the limbs and pushes cuffs into the skin; the first frame would then start with
    forces far beyond the weight. Alternates averaged edge-length projections (position based dynamics, Müller et al. 2007)
    with pushing out along the body's normals; ends with the latter. Pinned vertices stay.

    Args:
        thorough: go on while an edge is stretched by more than 8%, by up to three rounds of accelerated projections. A
            garment made in one pose and started in another needs them; they cost several times as much.
    """
    pos = _project(cloth, pos, obstacle, clearance, iterations, relaxation=1.5)
    start, end = cloth.edges.unbind(dim=1)
    rest_length = (cloth.rest_pos[end] - cloth.rest_pos[start]).norm(dim=1)
    movable = cloth.free[start] | cloth.free[end]

    def stretch(at: Tensor) -> float:
        return float(((at[end] - at[start]).norm(dim=1) / rest_length - 1.0)[movable].max()) if bool(movable.any()) else 0.0

    best, least = pos, stretch(pos) if thorough else 0.0
    for _ in range(_MOST_ROUNDS):
        if not least > _STRETCH_LIMIT:
            break
        pos = _project(cloth, pos, obstacle, clearance, _ROUND, relaxation=1.2, radius=_RADIUS)
        if stretch(pos) < least:
            best, least = pos, stretch(pos)
    return best


def _project(
    cloth: Cloth,
    pos: Tensor,
    obstacle: Obstacle | None,
    clearance: float,
    iterations: int,
    relaxation: float,
    radius: float = 0.0,
) -> Tensor:
    """Jacobi projections; with a ``radius`` > 0 accelerated by Chebyshev weights (Wang 2015)."""
    start, end = cloth.edges.unbind(dim=1)
    rest_length = (cloth.rest_pos[end] - cloth.rest_pos[start]).norm(dim=1)
    free = cloth.free.to(pos.dtype)
    share = free[start] + free[end]
    valence = torch.zeros_like(free).index_add(0, start, share.sign()).index_add(0, end, share.sign()).clamp_min(1.0)
    contact = None
    before, weight = pos, 1.0
    for iteration in range(iterations):
        entered = pos
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
        pos = pos + relaxation * total / valence.unsqueeze(1) * free.unsqueeze(1)
        if radius > 0.0 and iteration >= _PLAIN:
            weight = 2.0 / (2.0 - radius**2) if iteration == _PLAIN else 4.0 / (4.0 - radius**2 * weight)
            pos = weight * (pos - before) + before
        before = entered
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

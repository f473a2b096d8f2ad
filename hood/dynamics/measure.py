"""What is reported about a frame: strain and penetration. Never part of the loss."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hood.losses.elements import absolute_strain
from hood.losses.problem import STANDARD_GRAVITY, StepProblem
from hood.scene.cloth import Cloth
from hood.scene.contact import Contact

#: A vertex deeper than this [m] inside the body counts as penetrating.
PENETRATION_DEPTH = 2e-3

STRAIN_METRICS = ("strain_p50", "strain_p99", "strain_max")
PENETRATION_METRICS = ("penetration_count", "penetration_share", "penetration_depth")


#: Of a step in which layers of cloth are kept apart: pairs of features within their reach at its end, pairs of faces that were
#: crossed at its start, pairs of features that held vertices drove through each other, 1 where nearly everything is near
#: everything and nothing is kept apart, what it took, and how far held vertices stop short of their targets at most [m], which
#: files from before do not have.
LAYER_METRICS = ("layer_contacts", "layer_crossed", "layer_forced", "layer_overflow", "ms_layers", "pin_lag")


def layer_metrics(problem: StepProblem, next_pos: Tensor) -> dict[str, float]:
    """:data:`LAYER_METRICS` of the step to ``next_pos`` (V, 3); nothing where layers play no role."""
    if not problem.layers:
        return {}
    work = [scene.layers.work for scene in problem.layers]
    pins = [scene.pins for scene in problem.layers if scene.pins is not None]
    near = sum(len(scene.layers.contacts(scene.of(next_pos)).corners) for scene in problem.layers)
    values = (
        near,
        sum(scene.layers.crossed for scene in problem.layers),
        sum(scene.layers.forced for scene in problem.layers),
        any(one.overflowed for one in work),
        1e3 * (sum(one.seconds for one in work) + sum(one.seconds for one in pins)),
        max((one.lag.max(initial=0.0) for one in pins), default=0.0),
    )
    return dict(zip(LAYER_METRICS, map(float, values), strict=True))


def edge_strain(cloth: Cloth, pos: Tensor) -> Tensor:
    """Relative length change of every edge, (E,), signed."""
    start, end = cloth.edges.unbind(dim=1)
    rest = (cloth.rest_pos[end] - cloth.rest_pos[start]).norm(dim=1)
    return (pos[end] - pos[start]).norm(dim=1) / rest - 1.0


def strain_metrics(cloth: Cloth, pos: Tensor) -> dict[str, float]:
    """Median, 99th percentile and maximum of the absolute edge strain; NaN where ``pos`` (V, 3) is not finite, and
    without edges."""
    strain = absolute_strain(cloth, pos)
    if strain is None:
        strain = edge_strain(cloth, pos).abs().double().cpu().numpy()
    if len(strain) == 0 or not np.isfinite(strain).all():
        return dict.fromkeys(STRAIN_METRICS, float("nan"))
    strain.sort()
    return dict(zip(STRAIN_METRICS, (_quantile(strain, share) for share in (0.5, 0.99, 1.0)), strict=True))


def _quantile(ascending: np.ndarray, share: float) -> float:
    """What numpy's function says, of values (N,) in ascending order, for a quarter of its time."""
    place = share * (len(ascending) - 1)
    below = int(place)
    low, high = float(ascending[below]), float(ascending[min(below + 1, len(ascending) - 1)])
    return low + (place - below) * (high - low)


def penetration_metrics(contact: Contact | None, cloth: Cloth) -> dict[str, float]:
    """Count, share and depth [m] of the vertices deeper than :data:`PENETRATION_DEPTH` inside the body at t.

    Vertices beyond the reach of the contact energy count as well: there nothing pushes them out. Massless ones do not: they
    belong to no face, nothing moves them, and nobody sees them.
    """
    if contact is None:
        return {"penetration_count": 0.0, "penetration_share": 0.0, "penetration_depth": 0.0}
    # In numpy: a few small calls of torch would take as long as a search.
    dist, seen = contact.dist.detach().cpu().numpy(), cloth.mass.cpu().numpy() > 0
    depth = -dist[np.isfinite(dist) & seen]
    count = int(np.count_nonzero(depth > PENETRATION_DEPTH))
    return {
        "penetration_count": float(count),
        "penetration_share": count / max(int(np.count_nonzero(seen)), 1),
        "penetration_depth": float(depth.max(initial=0.0)),
    }


def vertex_residual(problem: StepProblem, gradient: Tensor) -> Tensor:
    """Relative gradient vertex by vertex: ‖∂Φ/∂x_v‖ / (m_v g), (V,), the force left unbalanced in units of the vertex's own
    weight, from ``gradient`` (V, 3) [N]. 0 where nothing moves.

    Its root mean square, weighted by the squares of the weights, is :func:`hood.losses.potential.relative_gradient`. Standard
    gravity stands in where the problem has none.
    """
    cloth, strength = problem.cloth, float(problem.gravity.norm())
    weight = cloth.mass * (strength if strength > 0 else STANDARD_GRAVITY)
    moves = cloth.free & (weight > 0)
    return torch.where(moves, gradient.norm(dim=1) / torch.where(moves, weight, 1.0), 0.0)

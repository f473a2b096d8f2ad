"""Cloth near cloth in the torch form of the solver: the barrier's curvature beside the pattern, and moves that cross nothing.

Energy and gradient come from the term itself (:class:`hood.energies.self_contact.LayerBarrier`). Its pairs change with the
positions, so that their curvature cannot lie in the fixed pattern of the Hessian: it is a sum of outer products of rows of four
vertices.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from hood.contact.self_contact import SceneLayers
from hood.energies.laws import slip_slope
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerGrips, has_layers
from hood.energies.term import Form, having
from hood.tensors.dense import add_rows


def layers_of(potential: Potential, problem: StepProblem) -> tuple[SceneLayers, ...]:
    """The layers that the potential's barrier acts between; none without such a term."""
    return problem.layers if has_layers(potential) else ()


def grips_of(potential: Potential, problem: StepProblem) -> LayerGrips | None:
    """What grips what by the potential's friction between layers; None where nothing does."""
    terms = [term for term in having(potential.terms, Form.PAIRS).values() if term.applies(problem)]
    if not terms:
        return None
    parts = [term.closed_form(problem) for term in terms]
    columns = ([getattr(part, field.name) for part in parts] for field in fields(LayerGrips))
    return LayerGrips(*(torch.cat(column) for column in columns))


@dataclass(frozen=True)
class LayerRows:
    """Curvature Σ n nᵀ of barrier and friction on M free vertices, in the solver's numbering."""

    vertices: Tensor  # (N, 4); M for vertices that do not move
    normals: Tensor  # (N, 4, 3)
    own: Tensor  # (M, 3, 3), the diagonal blocks

    def couple(self, x: Tensor) -> Tensor:
        """Product (M, 3) of all blocks but the diagonal ones with ``x`` (M, 3)."""
        padded = torch.cat([x, x.new_zeros(1, 3)])
        along = (self.normals * padded[self.vertices]).sum(dim=2)
        others = along.sum(dim=1, keepdim=True) - along
        parts = (others.unsqueeze(2) * self.normals).reshape(-1, 3)
        return add_rows(torch.zeros_like(padded), self.vertices.reshape(-1), parts)[:-1]


def layer_rows(layers: tuple[SceneLayers, ...], grips: LayerGrips | None, pos: Tensor, unknown: np.ndarray) -> LayerRows | None:
    """The curvature at ``pos`` (V, 3); None where nothing is near anything.

    Args:
        unknown: (V,) numbers of the free vertices, -1 for others.
    """
    num_free = int(unknown.max(initial=-1)) + 1
    vertices, normals = [], []
    for scene in layers:
        _, rows, corners, _ = scene.layers.model(scene.of(pos))
        vertices.append(unknown[corners + scene.first])
        normals.append(rows)
    if grips is not None:
        vertices += 2 * [unknown[grips.corners.cpu().numpy()]]
        normals += [row.cpu().numpy() for row in _grip_rows(grips, pos)]
    number, row = np.concatenate(vertices), np.concatenate(normals)
    if len(number) == 0:
        return None
    number = np.where(number < 0, num_free, number)
    index, n = torch.as_tensor(number, device=pos.device), torch.as_tensor(row).to(pos)
    blocks = (n.unsqueeze(3) * n.unsqueeze(2)).reshape(-1, 3, 3)
    own = add_rows(pos.new_zeros(num_free + 1, 3, 3), index.reshape(-1), blocks)[:-1]
    return LayerRows(index, n, own)


def _grip_rows(grips: LayerGrips, pos: Tensor) -> list[Tensor]:
    """Rows (N, 4, 3) along two directions across the normal; their outer products are the slope f'/y across and along the slip,
    which majorises friction as at single vertices (:meth:`hood.solver.derivatives.vertices.VertexForces.model`)."""
    slip = grips.slip(pos.to(grips.weights))
    size = torch.linalg.vector_norm(slip, dim=1)
    slope = grips.force * slip_slope(size, grips.limit)
    axis = torch.eye(3).to(slip)[grips.normal.abs().argmin(dim=1)]
    one = torch.nn.functional.normalize(torch.linalg.cross(grips.normal, axis), dim=1)
    both = one, torch.linalg.cross(grips.normal, one)
    return [slope.sqrt()[:, None, None] * grips.weights.unsqueeze(2) * across.unsqueeze(1) for across in both]


def approached(layers: tuple[SceneLayers, ...], target: Tensor) -> Tensor:
    """Positions (V, 3) near ``target`` (V, 3) that can be reached from the start of the step without crossing cloth."""
    reached = [torch.as_tensor(scene.layers.approach(scene.of(target))) for scene in layers]
    return torch.cat(reached).to(target)


def limits(layers: tuple[SceneLayers, ...], now: Tensor, there: Tensor) -> Tensor:
    """Shares (B,) of the straight ways from ``now`` to ``there`` (V, 3) on which no cloth meets cloth."""
    return now.new_tensor([scene.layers.limit(scene.of(now), scene.of(there)) for scene in layers])


def eased(layers: tuple[SceneLayers, ...], now: Tensor, there: Tensor) -> Tensor:
    """Positions (V, 3) near ``there`` (V, 3), by ways from ``now`` that are bent where cloth would meet cloth."""
    reached = [torch.as_tensor(scene.layers.ease(scene.of(now), scene.of(there))) for scene in layers]
    return torch.cat(reached).to(there)


def touching(layers: tuple[SceneLayers, ...], pos: Tensor) -> bool:
    """Whether any cloth is near or through cloth at ``pos`` (V, 3), where the step begins."""
    return any(scene.layers.crossed > 0 or len(scene.near_at_start(pos).corners) > 0 for scene in layers)


def free_way(layers: tuple[SceneLayers, ...], now: Tensor, there: Tensor) -> bool:
    """Whether no cloth meets cloth on the straight ways from ``now`` to ``there`` (V, 3), nor is near any there. A step from
    there needs no search to begin with; where cloth does, it is as if this had not been asked."""
    answers = [scene.layers.free_way(scene.of(now), scene.of(there)) for scene in layers]
    free = all(answer for answer, _ in answers)
    for scene, (_, apart) in zip(layers, answers, strict=True):
        if not free:
            scene.layers.restart()
        elif apart:
            scene.layers.remember_apart(scene.of(there), known=True)
    return free

"""Barrier between layers of cloth: of one garment folded on itself, and of garments over each other."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from hood.losses.layer_friction import LayerFriction, fading
from hood.losses.layer_sides import LayerSides
from hood.losses.potential import Potential
from hood.losses.problem import StepProblem
from hood.scene.layers import SceneLayers

#: Distance [m] below which features count as this far apart: the energy stays finite where they touch.
_LEAST = 1e-12


class LayerBarrier:
    """Energy [J] that keeps layers of cloth apart, a sum over pairs of features that share no vertex: p A r b(d / r).

    A pair is a vertex and a face, or two edges; d [m] is their exact distance, r the reach, A the area at rest that the pair
    stands for, and b(s) = -(1 - s)² ln s below s = 1: twice continuously differentiable where it sets in, infinite where the
    features meet. The pressure between layers is of the order of p at half the reach and grows like 1/d. The distance of two
    edges has a kink where they are parallel; there their share fades, as in Incremental Potential Contact (Li et al. 2020),
    and vertices and faces carry the load. Rigid-motion invariant; no net force or torque.

    The energy knows no sides, so cloth that is crossed at x_t would stay crossed: such pairs are left out until they have come
    apart (:class:`hood.mesh.layers.Layers`). Solvers never cross cloth on their way; elsewhere the energy alone acts.

    Args:
        reach: r [m]; where faces are small, half of the smallest height around.
        pressure: p [Pa].
        between: layers of different pieces of cloth (garments of an outfit) alone.
    """

    kind: ClassVar[str] = "LayerBarrier"

    def __init__(self, reach: float = 3e-3, pressure: float = 20.0, between: bool = False) -> None:
        if not (reach > 0 and pressure > 0):
            raise ValueError(f"layers: reach is {reach}, pressure {pressure}; give both > 0")
        self.reach, self.pressure, self.between = reach, pressure, between

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with its layers searched for, once per step.

        Raises:
            hood.native.build.BuildError: there is no compiler for the search.
        """
        return problem.with_layers(self.reach, self.pressure, self.between)

    def applies(self, problem: StepProblem) -> bool:
        if not problem.layers:
            raise ValueError("step problem: layers not searched for yet; pass the problem through Potential.prepare once")
        return True

    def rests(self, problem: StepProblem) -> bool:
        """Whether no pair is within its reach at x_t."""
        near = (len(scene.near_at_start(problem.state.pos).corners) for scene in problem.layers)
        return bool(problem.layers) and not any(near)

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        return torch.stack([self._scene(scene, next_pos) for scene in problem.layers])

    def _scene(self, scene: SceneLayers, next_pos: Tensor) -> Tensor:
        found = scene.layers.contacts(scene.of(next_pos))
        if len(found.corners) == 0:
            return next_pos.new_zeros(()) + 0.0 * next_pos.sum()
        device, real = next_pos.device, torch.promote_types(next_pos.dtype, torch.float32)
        weights, reach, area, parallel = (
            torch.as_tensor(values, device=device, dtype=real)
            for values in (found.weights, found.reach, found.area, found.parallel)
        )
        x = next_pos[torch.as_tensor(found.corners + scene.first, device=device)]
        # The nearest points move along the features, which does not change the distance to first order.
        gap = (weights.unsqueeze(2) * x).sum(dim=1)
        share = torch.linalg.vector_norm(gap, dim=1).clamp_min(_LEAST) / reach
        energy = self.pressure * area * reach * (1.0 - share) ** 2 * -share.log()
        normal = torch.linalg.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 2])
        # Pairs of a vertex and a face have 0 to fade below.
        return (energy * fading((normal * normal).sum(dim=1), parallel)).sum()


#: Terms that act between layers; of other classes the solvers know nothing.
LAYER_TERMS = (LayerBarrier, LayerFriction)


def has_layers(potential: Potential) -> bool:
    """Whether the potential keeps layers of cloth apart."""
    return any(type(term) is LayerBarrier for term in potential.terms.values())


def without_layers(potential: Potential) -> Potential:
    """The potential without what acts between layers of cloth; itself where there is nothing of the kind."""
    if not any(type(term) in LAYER_TERMS for term in potential.terms.values()):
        return potential
    return potential.only({name: term for name, term in potential.terms.items() if type(term) not in LAYER_TERMS})


def for_networks(potential: Potential) -> Potential:
    """What a network is shown of the potential, and known to have been trained with: no feature tells of layers of cloth."""
    return potential.only(
        {name: term for name, term in potential.terms.items() if type(term) not in (*LAYER_TERMS, LayerSides)}
    )

"""Barrier between layers of cloth: of one garment folded on itself, and of garments over each other.

Penalty that keeps cloth on the side of other cloth that it is on at t: a signal for training, and for taking apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from hood.contact.self_contact import SceneLayers
from hood.energies.laws import contact_energy
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem, sum_per_scene
from hood.energies.self_friction import fading
from hood.energies.term import LAYER_FORMS, Energy, Form, Passes, Role, Term, having


class SignedSelfContactPenalty(Energy):
    """Energy [J] of layers of cloth, a sum over pairs of a vertex and a face near each other at t: w max(ε - d, 0)³.

    d = ± n · (x_v - x_f) is the distance of the vertex from the face's plane, both at t + 1, positive on the side on which the
    vertex is at t (:func:`hood.contact.self_contact.find_sides`). A vertex on the wrong side at t + 1 is pushed back, however
    deep it went: where :class:`hood.energies.self_contact.LayerBarrier` is infinite or blind, this term has a slope. Cloth that
    is crossed at t stays so. Rigid-motion invariant; no net force or torque; twice differentiable but for faces without an
    area.

    Pairs are found once a step. What comes from beyond the reach within one, passes two edges through each other, or slides off
    its face, is not seen, or felt where nothing is: good enough to learn from, or to take garments apart; the solver and
    rollouts take the barrier.

    Args:
        weight: w [J/m³]; the body's is 5e5.
        epsilon: ε [m]; where faces are small, half of the smallest height around.
        reach: distance [m] at t below which cloth is near; farther than cloth moves against cloth in a step.
    """

    kind: ClassVar[str] = "SignedSelfContactPenalty"
    role = Role.TRAINING

    def __init__(self, weight: float = 5e5, epsilon: float = 3e-3, reach: float = 2e-2) -> None:
        if weight < 0 or epsilon <= 0 or reach < epsilon:
            raise ValueError(
                f"layer_sides: weight is {weight}, epsilon {epsilon}, reach {reach}; give weight >= 0 and 0 < epsilon <= reach"
            )
        self.weight, self.epsilon, self.reach = weight, epsilon, reach

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with the sides that its vertices are on, searched for once per step."""
        return problem.with_sides(self.reach)

    def applies(self, problem: StepProblem) -> bool:
        if problem.sides is None:
            raise ValueError("step problem: sides not searched for yet; pass the problem through Potential.prepare once")
        return len(problem.sides.vertex) > 0

    def distances(self, problem: StepProblem, next_pos: Tensor) -> Tensor:
        """d [m] (N,) of every pair at ``next_pos`` (V, 3)."""
        pairs = problem.sides
        assert pairs is not None
        x, point = next_pos[pairs.corners], next_pos[pairs.vertex]
        normal = torch.linalg.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        square = (normal * normal).sum(dim=1)
        proper = square > torch.finfo(square.dtype).tiny
        length = torch.where(proper, square, 1.0).sqrt()
        return pairs.side * torch.where(proper, ((point - x[:, 0]) * normal).sum(dim=1), 0.0) / length

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        pairs = problem.sides
        assert pairs is not None
        depth = pairs.room.clamp_max(self.epsilon) - self.distances(problem, next_pos)
        return sum_per_scene(contact_energy(self.weight, depth), pairs.scene, problem.num_scenes)


def layer_sides(weight: float = 0.0, epsilon: float = 3e-3, reach: float = 2e-2) -> SignedSelfContactPenalty | None:
    """The term of a config; None, which a potential leaves out, where it weighs nothing."""
    return SignedSelfContactPenalty(weight, epsilon, reach) if weight else None


#: Distance [m] below which features count as this far apart: the energy stays finite where they touch.
_LEAST = 1e-12


class LayerBarrier(Energy):
    """Energy [J] that keeps layers of cloth apart, a sum over pairs of features that share no vertex: p A r b(d / r).

    A pair is a vertex and a face, or two edges; d [m] is their exact distance, r the reach, A the area at rest that the pair
    stands for, and b(s) = -(1 - s)² ln s below s = 1: twice continuously differentiable where it sets in, infinite where the
    features meet. The pressure between layers is of the order of p at half the reach and grows like 1/d. The distance of two
    edges has a kink where they are parallel; there their share fades, as in Incremental Potential Contact (Li et al. 2020),
    and vertices and faces carry the load. Rigid-motion invariant; no net force or torque.

    The energy knows no sides, so cloth that is crossed at x_t would stay crossed: such pairs are left out until they have come
    apart (:class:`hood.mesh.cloth_proximity.ClothSurface`). Solvers never cross cloth on their way; elsewhere the energy alone
    acts.

    Args:
        reach: r [m]; where faces are small, half of the smallest height around.
        pressure: p [Pa].
        between: layers of different pieces of cloth (garments of an outfit) alone.
    """

    kind: ClassVar[str] = "LayerBarrier"
    role = Role.SELF_CONTACT
    form = Form.LAYERS

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

    def is_inactive(self, problem: StepProblem) -> bool:
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

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> bool:
        return True


def has_layers(potential: Potential) -> bool:
    """Whether the potential keeps layers of cloth apart."""
    return bool(having(potential.terms, Form.LAYERS))


def without_layers(potential: Potential) -> Potential:
    """The potential without what acts between layers of cloth; itself where there is nothing of the kind."""
    return _without(potential, having(potential.terms, *LAYER_FORMS))


def for_networks(potential: Potential) -> Potential:
    """What a network is shown of the potential, and known to have been trained with: no feature tells of layers of cloth."""
    return potential.only(_without(potential, having(potential.terms, *LAYER_FORMS, Role.TRAINING)).terms)


def _without(potential: Potential, left_out: Mapping[str, Term]) -> Potential:
    if not left_out:
        return potential
    return potential.only({name: term for name, term in potential.terms.items() if name not in left_out})

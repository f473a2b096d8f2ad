"""Energies between layers of cloth: of one garment folded on itself, and of garments over each other.

A barrier that keeps layers apart, Coulomb friction between them as a lagged potential, and a penalty that keeps cloth on the
side of other cloth that it is on at t: a signal for training, and for taking apart.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from hood.contact.self_contact import SceneLayers
from hood.energies.friction import ballistic_position
from hood.energies.laws import contact_energy, mollified_norm
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem, sum_per_scene
from hood.energies.term import LAYER_FORMS, Energy, Form, Passes, Role, Term, having
from hood.mesh.cloth_proximity import Contacts, library
from hood.native.arguments import COUNT, POINTER, fields


@dataclass(frozen=True)
class LayerGrips:
    """N pairs of features that grip each other during a step."""

    corners: Tensor  # (N, 4) vertices
    weights: Tensor  # (N, 4), of the corners in the gap between the nearest points at t; their sum is 0
    normal: Tensor  # (N, 3), along the gap
    force: Tensor  # (N,) N, the coefficient included
    limit: Tensor  # (N,) m, slip below which they count as sticking
    scene: Tensor  # (N,)

    def slip(self, pos: Tensor) -> Tensor:
        """Tangential motion (N, 3) [m] since t of the nearest points relative to each other, at ``pos`` (V, 3)."""
        moved = (self.weights.unsqueeze(2) * pos[self.corners]).sum(dim=1)  # at t it is along the normal
        return moved - _dot(moved, self.normal).unsqueeze(1) * self.normal


class LayerFriction(Energy):
    """Friction energy [J] between layers, the sum over pairs of features of μ N f(‖u_T‖).

    The pairs are those within the reach of :class:`hood.energies.self_contact.LayerBarrier` at t, u_T is the tangential motion
    from t to t+1 of their nearest points relative to each other, f the law of slip of
    :class:`hood.energies.friction.LaggedFriction`. N is the barrier's force at t, but no more than either side can bring during
    the step,

        P = m/dt² max(r - d̂, 0) + L,

    with m the side's mass at the pair, d̂ the distance at t+1 if both sides flew under their weight, and L what the cloth around
    the side and the layers behind it press it on with at t. Vertices share m and L among their pairs by the load of these. A
    side that is held, or lies on the body, can bring anything. Layers that lie still are pressed with exactly N.

    No net force: a pair pulls its sides by as much, in opposite directions. These act as far apart as the layers are, at most
    the reach, which leaves that couple.

    Args:
        coefficient: μ.
        slip_speed: speed [m/s] below which friction counts as static.
    """

    kind: ClassVar[str] = "LayerFriction"
    role = Role.SELF_FRICTION
    form = Form.PAIRS

    def __init__(self, coefficient: float = 0.5, slip_speed: float = 5e-3) -> None:
        if coefficient < 0 or slip_speed <= 0:
            raise ValueError(
                f"layer friction: coefficient is {coefficient}, slip_speed {slip_speed}; "
                "give coefficient >= 0 and slip_speed > 0"
            )
        self.coefficient, self.slip_speed = coefficient, slip_speed

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with the pairs that are near each other at t.

        Raises:
            ValueError: no term before this one has searched for layers.
        """
        if self.coefficient == 0:
            return problem
        if not problem.layers:
            raise ValueError("layer friction: no layers are searched for; add a LayerBarrier to the potential, before it")
        return problem.with_layers_at_start()

    def applies(self, problem: StepProblem) -> bool:
        return self.coefficient > 0 and any(len(_lagged(scene).corners) > 0 for scene in problem.layers)

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        grips = self.grips(problem)
        slip = grips.slip(next_pos.to(grips.weights))
        energy = grips.force * mollified_norm(_dot(slip, slip), grips.limit)
        return sum_per_scene(energy, grips.scene, problem.num_scenes)

    def grips(self, problem: StepProblem) -> LayerGrips:
        """What grips what during the step; the problem must have been prepared."""
        pairs = _pairs(problem)
        force = self.coefficient * torch.minimum(pairs.force, _pressing(problem, pairs))
        limit = self.slip_speed * problem.step.dt.to(force)[pairs.scene]
        return LayerGrips(pairs.corners, pairs.weights, pairs.normal, force, limit, pairs.scene)

    def needs_internal_force(self, problem: StepProblem) -> bool:
        return self.applies(problem)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> LayerGrips:
        return self.grips(problem)


@dataclass(frozen=True)
class _Pairs:
    """N pairs near each other at t, of a whole batch, in float64."""

    corners: Tensor  # (N, 4)
    weights: Tensor  # (N, 4)
    edges: Tensor  # (N,) bool, two edges
    normal: Tensor  # (N, 3), from the second side to the first
    force: Tensor  # (N,) N, of the barrier
    reach: Tensor  # (N,) m
    scene: Tensor  # (N,)


def _lagged(scene: SceneLayers) -> Contacts:
    if scene.at_start is None:
        raise ValueError("layer friction: pairs not searched for yet; pass the problem through Potential.prepare once")
    return scene.at_start


def _pairs(problem: StepProblem) -> _Pairs:
    pos = problem.state.pos.double()
    parts = [_scene_pairs(scene, pos, index) for index, scene in enumerate(problem.layers)]
    return _Pairs(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def _scene_pairs(scene: SceneLayers, pos: Tensor, index: int) -> tuple[Tensor, ...]:
    found = _lagged(scene)
    device = pos.device
    corners = torch.as_tensor(found.corners + scene.first, device=device)
    weights = torch.as_tensor(found.weights, device=device)
    edges = torch.as_tensor(found.edges, device=device)
    x = pos[corners]
    weights = _following(weights, x, edges)
    gap = (weights.unsqueeze(2) * x).sum(dim=1)
    dist = torch.linalg.vector_norm(gap, dim=1).clamp_min(1e-12)
    reach, area, parallel = (torch.as_tensor(values, device=device) for values in (found.reach, found.area, found.parallel))
    force = scene.layers.pressure * area * barrier_force(dist / reach)
    cross = torch.linalg.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 2])
    force = torch.where(edges, force * fading(_dot(cross, cross), parallel), force)
    return corners, weights, edges, gap / dist.unsqueeze(1), force, reach, torch.full_like(corners[:, 0], index)


def barrier_force(share: Tensor) -> Tensor:
    """-b'(s) for distances s = ``share`` (N,) in units of the reach, of the barrier b(s) = -(1 - s)² ln s."""
    rest = 1.0 - share
    return rest * (rest / share - 2.0 * share.log())


def fading(square: Tensor, parallel: Tensor) -> Tensor:
    """Share (N,) of the barrier of two edges the ``square`` of whose cross product is below ``parallel``; 1 for others."""
    ratio = torch.where(parallel > 0, square / torch.where(parallel > 0, parallel, 1.0), 1.0).clamp_max(1.0)
    return ratio * (2.0 - ratio)


class _Pressing(ctypes.Structure):
    """``LayerPressing`` of ``layer_pressing.h``."""

    _fields_ = [
        *fields("count num_vertices", COUNT),
        *fields("corners edges weights normal force reach inertia there pull backed", POINTER),
    ]


def _pressing(problem: StepProblem, pairs: _Pairs) -> Tensor:
    """P [N] (N,), of the side that can bring less; ``hood/native/layer_pressing.h``."""
    cloth = problem.cloth
    there = torch.where(cloth.free.unsqueeze(1), ballistic_position(problem), _held(problem))
    inertia = cloth.mass.double() / problem.vertex_dt.squeeze(1).double() ** 2
    backing = ~cloth.free | _on_body(problem)
    vectors, around = (pairs.weights, pairs.normal, pairs.force, pairs.reach, inertia, there), problem.internal_force
    if any(values.requires_grad for values in vectors) or (around is not None and around.requires_grad):
        return _followed_pressing(pairs, inertia, there, around, backing)
    arrays = [np.ascontiguousarray(values.cpu().numpy(), np.int64) for values in (pairs.corners, pairs.edges)]
    arrays += [np.ascontiguousarray(values.double().cpu().numpy()) for values in vectors]
    pull = None if around is None else np.ascontiguousarray(around.double().cpu().numpy())
    backed = np.ascontiguousarray(backing.cpu().numpy(), np.uint8)
    pointers = [array.ctypes.data for array in arrays] + [None if pull is None else pull.ctypes.data, backed.ctypes.data]
    pressing = np.empty(len(pairs.force))
    library().layers_pressing(ctypes.byref(_Pressing(len(pressing), len(there), *pointers)), pressing.ctypes.data)
    return torch.from_numpy(pressing).to(pairs.force.device)


def _followed_pressing(pairs: _Pairs, inertia: Tensor, there: Tensor, pull: Tensor | None, backed: Tensor) -> Tensor:
    """The same as a function that autograd follows, of mass over dt² (V,) [N/m], where vertices fly to (V, 3) [m], the forces
    around (V, 3) [N] and what is held from behind (V,) bool."""
    load = pairs.weights * pairs.force.unsqueeze(1)  # (N, 4) N, at the corners
    rows, normal = pairs.corners.reshape(-1), pairs.normal
    pushed = load.unsqueeze(2) * normal.unsqueeze(1)
    net = torch.zeros_like(there).index_add(0, rows, pushed.reshape(-1, 3))
    blocks = torch.einsum("nc,ni,nj->ncij", load.abs(), normal, normal).reshape(-1, 3, 3)
    spread = there.new_zeros(len(there), 3, 3).index_add(0, rows, blocks)
    missing = (pairs.reach - torch.einsum("nc,nci,ni->n", pairs.weights, there[pairs.corners], normal)).clamp_min(0.0)
    none = torch.zeros_like(pairs.edges)
    first = torch.stack([~none, pairs.edges, none, none], dim=1)  # (N, 4), the corners of its first side
    outward = torch.where(first, 1.0, -1.0).unsqueeze(2) * normal.unsqueeze(1)  # (N, 4, 3)
    one = (net[pairs.corners] * outward).sum(dim=2)
    both = torch.einsum("nci,ncij,ncj->nc", outward, spread[pairs.corners], outward)
    ahead, behind = (0.5 * (both + one)).clamp_min(0.0), (0.5 * (both - one)).clamp_min(0.0)
    if pull is not None:
        behind = behind - ((pull.double() - net)[pairs.corners] * outward).sum(dim=2)
    part = load.abs()
    acts = part > 0
    share = torch.where(acts, part / torch.where(acts, torch.maximum(ahead, part), 1.0), 0.0)
    brings = share * (inertia[pairs.corners] * missing.unsqueeze(1) + behind.clamp_min(0.0))
    held = acts & backed[pairs.corners]
    sides = [(brings * side).sum(dim=1).where(~(held & side).any(dim=1), torch.inf) for side in (first, ~first)]
    return torch.minimum(*sides)


def _held(problem: StepProblem) -> Tensor:
    target = problem.step.pin_target
    return problem.state.pos if target is None else torch.where(problem.cloth.pinned.unsqueeze(1), target, problem.state.pos)


def _on_body(problem: StepProblem) -> Tensor:
    """Vertices (V,) bool that the body may press on."""
    contact = problem.contact
    if contact is None:
        return torch.zeros_like(problem.cloth.free)
    return contact.valid & (contact.dist < _TOUCH)


#: Distance [m] from the body below which it may carry cloth: where contact sets in at most.
_TOUCH = 1e-2


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=1)


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
        return bool(problem.layers) and not any(len(scene.near_at_start(problem.state.pos).corners) for scene in problem.layers)

    def is_zero(self, problem: StepProblem, pos: Tensor) -> bool:
        """Whether no pair is within its reach at ``pos`` (V, 3); never where that is not finite."""
        return all(scene.is_apart(pos) for scene in problem.layers)

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
        # The nearest points move along the features: nothing of first order, a part of the second derivative.
        weights = _following(weights, x, torch.as_tensor(found.edges, device=device))
        gap = (weights.unsqueeze(2) * x).sum(dim=1)
        share = torch.linalg.vector_norm(gap, dim=1).clamp_min(_LEAST) / reach
        energy = self.pressure * area * reach * (1.0 - share) ** 2 * -share.log()
        normal = torch.linalg.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 2])
        # Pairs of a vertex and a face have 0 to fade below.
        return (energy * fading((normal * normal).sum(dim=1), parallel)).sum()

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> bool:
        return True


def nearest_weights(x: Tensor, known: Tensor, edges: Tensor) -> Tensor:
    """Weights (N, 4) of the corners ``x`` (N, 4, 3) in the gap between the nearest points of vertex and face, or of two edges
    where ``edges`` (N,) bool, as autograd follows them: on the face, edge or corner that the ``known`` weights (N, 4) are on.

    Parallel edges, whose nearest points are not told apart, keep the known ones.
    """
    size = known.abs()
    rows = torch.arange(len(x), device=x.device)
    # Of a face: from its corner of the largest weight to the other two; of edges: from their first ends to the second.
    base = torch.where(edges, 0, 1 + size[:, 1:].argmax(dim=1))
    first, second = torch.where(edges, 1, 1 + base % 3), torch.where(edges, 3, 1 + (base + 1) % 3)
    start = x[:, 0] - torch.where(edges.unsqueeze(1), x[:, 2], x[rows, base])
    one = torch.where(edges.unsqueeze(1), x[:, 1] - x[:, 0], x[rows, base] - x[rows, first])
    two = torch.where(edges.unsqueeze(1), x[:, 2] - x[:, 3], x[rows, base] - x[rows, second])
    held = torch.where(edges, size[:, 0] * size[:, 1] == 0, size[rows, first] == 0)
    still = torch.where(edges, size[:, 2] * size[:, 3] == 0, size[rows, second] == 0)
    one, two = (torch.where(fixed.unsqueeze(1), 0.0, way) for fixed, way in ((held, one), (still, two)))
    # Ends that the nearest points are held at beside their starts.
    ends = edges.unsqueeze(1) & torch.stack([held & (size[:, 1] > 0), still & (size[:, 3] > 0)], dim=1)
    start = start + torch.where(ends[:, :1], x[:, 1] - x[:, 0], 0.0) + torch.where(ends[:, 1:], x[:, 2] - x[:, 3], 0.0)
    a, b, c = _dot(one, one) + held.to(x), _dot(one, two), _dot(two, two) + still.to(x)
    p, q = -_dot(one, start), -_dot(two, start)
    determinant = a * c - b * b
    told = determinant > 1e-9 * a * c
    determinant = torch.where(told, determinant, 1.0)
    u = torch.where(told, (c * p - b * q) / determinant, 0.0).unsqueeze(1)
    v = torch.where(told, (a * q - b * p) / determinant, 0.0).unsqueeze(1)
    u, v = torch.where(ends[:, :1], 1.0, u), torch.where(ends[:, 1:], 1.0, v)
    of_edges = torch.cat([1.0 - u, u, v - 1.0, -v], dim=1)
    of_face = torch.zeros_like(of_edges)
    of_face = of_face.index_put((rows, torch.zeros_like(rows)), torch.ones_like(u[:, 0]))
    of_face = of_face.index_put((rows, base), (u + v - 1.0)[:, 0])
    of_face = of_face.index_put((rows, first), -u[:, 0], accumulate=True)
    of_face = of_face.index_put((rows, second), -v[:, 0], accumulate=True)
    found = torch.where(edges.unsqueeze(1), of_edges, of_face)
    return torch.where(told.unsqueeze(1), found, known)


def _following(weights: Tensor, x: Tensor, edges: Tensor) -> Tensor:
    """``weights`` (N, 4) with the derivatives of :func:`nearest_weights`, where the corners ``x`` (N, 4, 3) have any."""
    if not x.requires_grad:
        return weights
    moved = nearest_weights(x, weights, edges)
    return weights + (moved - moved.detach())


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
    kept = {name: term for name, term in potential.terms.items() if name not in left_out}
    return potential.only(kept) if left_out else potential

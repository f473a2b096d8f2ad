"""First and positive second derivatives of the energies, element by element, in closed form.

Every second derivative here is positive semi-definite: exact where the energy is convex, otherwise its convex part.
An element's matrix is given as rows ``root`` (N, K, ...) with matrix = rootᵀ root, plus, for faces, a part that acts on
the three axes alike. Inside, elements come last: sums over three axes are slow in torch where those are the last ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hood.losses.attachment import Attachment
from hood.losses.bending import Bending, CurrentLengthBending, bending_weight
from hood.losses.collision import CentroidCollision, Collision
from hood.losses.friction import Friction, LaggedFriction, WeightFriction
from hood.losses.gravity import Gravity
from hood.losses.inertia import Inertia
from hood.losses.potential import Potential, Term
from hood.losses.problem import StepProblem
from hood.losses.stretching import Stretching

#: Terms whose derivatives are written out here. A subclass may compute something else and does not count.
BENDINGS = (Bending, CurrentLengthBending)
COLLISIONS = (Collision, CentroidCollision)
FRICTIONS = (Friction, WeightFriction)
CLOSED_FORM = (Stretching, *BENDINGS, Attachment, Inertia, Gravity, *COLLISIONS, *FRICTIONS)
#: As in hood.mesh.geometry: a triangle is degenerate when a sine in it is below this many units of rounding.
_DEGENERATE_ULPS = 8.0


@dataclass(frozen=True)
class FaceModel:
    """Membrane of N faces: gradient = stress-weighted edges, matrix = rootᵀ root + axial ⊗ I₃."""

    gradient: Tensor  # (N, 3, 3) N, of corner, axis
    root: Tensor  # (N, 3, 3, 3) row, corner, axis
    axial: Tensor  # (N, 3, 3) N/m, corner by corner


def face_shape(rest_inverse: Tensor) -> Tensor:
    """Derivatives (F, 3, 2) of the deformation gradient's columns by the corners: F = Σ_j x_j ⊗ shape_j."""
    return torch.cat([-rest_inverse.sum(dim=1, keepdim=True), rest_inverse], dim=1)


def face_model(corners: Tensor, shape: Tensor, weight: Tensor, lame_mu: Tensor, lame_lambda: Tensor) -> FaceModel:
    """StVK membrane with the tension-only projection.

    With S = 2 μ G + λ tr(G) I the gradient by corner j is A h F S b_j. The second derivative has a material part,
    positive for μ, λ + μ >= 0, and (b_j · S b_k) I₃, which is indefinite under compression: S is replaced there by
    its positive part, from the eigenvalues of a 2 × 2 matrix.

    Args:
        corners: (N, 3, 3) m.
        shape: (N, 3, 2) 1/m, see :func:`face_shape`.
        weight: (N,) m³, rest area times thickness.
        lame_mu, lame_lambda: (N,) Pa.
    """
    x, b = corners.permute(1, 2, 0).contiguous(), shape.permute(1, 2, 0).contiguous()
    f0, f1 = (x * b[:, :1]).sum(0), (x * b[:, 1:]).sum(0)
    g00, g11 = 0.5 * ((f0 * f0).sum(0) - 1.0), 0.5 * ((f1 * f1).sum(0) - 1.0)
    g01 = 0.5 * (f0 * f1).sum(0)
    pressure = lame_lambda * (g00 + g11)
    stress = (2.0 * lame_mu * g00 + pressure, 2.0 * lame_mu * g01, 2.0 * lame_mu * g11 + pressure)
    t0, t1 = _apply(stress, weight * b)
    gradient = t0[:, None] * f0 + t1[:, None] * f1
    t0, t1 = _apply(_positive_part(*stress), weight * b)
    axial = t0[:, None] * b[:, 0] + t1[:, None] * b[:, 1]
    # Strains G00 ± G11 and 2 G01 diagonalise the material: moduli λ + μ, μ, μ.
    along, across = b[:, 0, None] * f0, b[:, 1, None] * f1
    shear = b[:, 0, None] * f1 + b[:, 1, None] * f0
    bulk, soft = (weight * (lame_lambda + lame_mu)).sqrt(), (weight * lame_mu).sqrt()
    root = torch.stack([bulk * (along + across), soft * (along - across), soft * shear])
    return FaceModel(gradient.permute(2, 0, 1), root.permute(3, 0, 1, 2), axial.permute(2, 0, 1))


def _apply(symmetric: tuple[Tensor, Tensor, Tensor], b: Tensor) -> tuple[Tensor, Tensor]:
    s00, s01, s11 = symmetric
    return s00 * b[:, 0] + s01 * b[:, 1], s01 * b[:, 0] + s11 * b[:, 1]


def _positive_part(s00: Tensor, s01: Tensor, s11: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The symmetric 2 × 2 matrix with its negative eigenvalues replaced by 0."""
    mean, half = 0.5 * (s00 + s11), 0.5 * (s00 - s11)
    radius = torch.hypot(half, s01)
    high, low = (mean + radius).clamp_min(0.0), (mean - radius).clamp_min(0.0)
    centre = 0.5 * (high + low)
    slope = torch.where(radius > 0, 0.5 * (high - low) / torch.where(radius > 0, radius, 1.0), 0.0)
    return centre + slope * half, slope * s01, centre - slope * half


def hinge_model(corners: Tensor, rest_angle: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Bending: gradient (N, 4, 3) and the one row (N, 4, 3) of its Gauss-Newton matrix, √k ∇θ ∇θᵀ √k.

    Args:
        corners: (N, 4, 3) m: edge start, edge end, opposite vertices.
        rest_angle: (N,) rad.
        weight: (N,) J, second derivative of the energy by the angle.
    """
    angle, slope = _angles(corners.permute(1, 2, 0).contiguous())
    bend = angle - rest_angle
    bend = bend - 2.0 * math.pi * torch.round(bend / (2.0 * math.pi))
    return (weight * bend * slope).permute(2, 0, 1), (weight.sqrt() * slope).permute(2, 0, 1)


def current_length_model(corners: Tensor, weight: Tensor, rest_length: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`hinge_model` of ½ weight r² with r = θ l / l₀, where l is the edge's length now; its row is √weight ∇r.

    The arguments are those of :func:`hinge_model`, and ``rest_length`` (N,) m.
    """
    x = corners.permute(1, 2, 0).contiguous()
    angle, slope = _angles(x)
    edge = x[1] - x[0]
    length = (edge * edge).sum(0).sqrt()
    ratio = length / rest_length
    bend_slope = ratio * slope
    along = angle / (rest_length * torch.where(length > 0, length, 1.0)) * edge
    bend_slope[0] -= along
    bend_slope[1] += along
    return (weight * angle * ratio * bend_slope).permute(2, 0, 1), (weight.sqrt() * bend_slope).permute(2, 0, 1)


def _angles(x: Tensor) -> tuple[Tensor, Tensor]:
    """Angles (N,) of hinges with corners (4, 3, N), and their gradients (4, 3, N) by them [1/m].

    The angle is that of :func:`hood.mesh.geometry.dihedral_angles`. With e = x₁ - x₀ and the opposite-vertex normals
    n₁ = e × a, n₂ = b × e its gradients are -‖e‖ n₁/‖n₁‖² and -‖e‖ n₂/‖n₂‖² at the opposite vertices; those of the
    edge's ends follow from there being no net force and torque. Degenerate hinges have angle and gradient 0.
    """
    local = x[1:] - x[0]
    size = local.abs().amax(dim=(0, 1)).clamp_min(torch.finfo(x.dtype).tiny)
    edge, a, b = (local / size).unbind(dim=0)
    n1, n2 = torch.linalg.cross(edge, a, dim=0), torch.linalg.cross(b, edge, dim=0)
    edge_sq, n1_sq, n2_sq = ((v * v).sum(0) for v in (edge, n1, n2))
    regular = _regular(n1_sq, edge_sq * (a * a).sum(0)) & _regular(n2_sq, edge_sq * (b * b).sum(0))
    edge_sq, n1_sq, n2_sq = (torch.where(regular, value, 1.0) for value in (edge_sq, n1_sq, n2_sq))
    length = edge_sq.sqrt()
    sine = torch.where(regular, -length * (n1 * b).sum(0), 0.0)
    angle = torch.atan2(sine, torch.where(regular, (n1 * n2).sum(0), 1.0))
    scale = torch.where(regular, -length, 0.0) / size
    at_a, at_b = scale / n1_sq * n1, scale / n2_sq * n2
    at_end = -((edge * a).sum(0) / edge_sq * at_a + (edge * b).sum(0) / edge_sq * at_b)
    return angle, torch.stack([-at_a - at_b - at_end, at_end, at_a, at_b])


def _regular(cross_sq: Tensor, product_sq: Tensor) -> Tensor:
    info = torch.finfo(cross_sq.dtype)
    return (cross_sq > (_DEGENERATE_ULPS * info.eps) ** 2 * product_sq) & (cross_sq > info.tiny / info.eps)


def bending_model(
    term: Term, corners: Tensor, rest_angle: Tensor, weight: Tensor, rest_length: Tensor
) -> tuple[Tensor, Tensor]:
    """:func:`hinge_model` of the term at hand; the last three arguments are rows of :func:`hinge_constants`."""
    if type(term) is CurrentLengthBending:
        return current_length_model(corners, weight, rest_length)
    return hinge_model(corners, rest_angle, weight)


def hinge_constants(problem: StepProblem) -> tuple[Tensor, Tensor, Tensor]:
    """Rest angle [rad], second derivative of the rest shape's bending energy by the angle [J], edge at rest [m]: (H,) each."""
    cloth = problem.cloth
    weight = bending_weight(cloth.bending_stiffness, cloth.rest_length**2, cloth.hinge_area)
    return cloth.rest_angle, weight, cloth.rest_length


def attachment_stiffness(term: Attachment, problem: StepProblem) -> Tensor:
    """Spring constants [N/m] (A,) of the step's attachments, 0 where open."""
    attachments = problem.step.attachments
    assert attachments is not None
    return term.stiffness * attachments.active.to(problem.state.pos.dtype)


def vertex_model(potential: Potential, problem: StepProblem, pos: Tensor, acc: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient (N, 3) [N] and positive matrix (N, 3, 3) [N/m] of the energies that act on single vertices.

    The N vertices may be some of a cloth's, see :func:`only_vertices`.
    """
    gradient = torch.zeros_like(pos)
    matrix = pos.new_zeros(len(pos), 3, 3)
    for term in potential.terms.values():
        if not term.applies(problem):
            continue
        if type(term) is Inertia:
            mass = problem.cloth.mass[:, None]
            gradient = gradient + mass * acc
            matrix.diagonal(dim1=1, dim2=2).add_(mass / problem.vertex_dt**2)
        elif type(term) is Gravity:
            gradient = gradient - problem.cloth.mass[:, None] * problem.gravity.to(pos)
        elif isinstance(term, Collision) and type(term) in COLLISIONS:
            force, block = _collision(term, problem, pos)
            gradient, matrix = gradient + force, matrix + block
        elif isinstance(term, LaggedFriction) and type(term) in FRICTIONS:
            force, block = _friction(term, problem, pos)
            gradient, matrix = gradient + force, matrix + block
    return gradient, matrix


def only_vertices(problem: StepProblem, rows: Tensor) -> StepProblem:
    """As much of a problem as :func:`vertex_model` reads, for the vertices ``rows`` (N,)."""
    cloth = replace(problem.cloth, mass=problem.cloth.mass[rows], vertex_scene=problem.cloth.vertex_scene[rows])
    state = replace(problem.state, pos=problem.state.pos[rows], vel=problem.state.vel[rows])
    contact = problem.contact
    if contact is not None:
        contact = type(contact)(**{name: value[rows] for name, value in vars(contact).items()})
    return replace(problem, cloth=cloth, state=state, contact=contact)


def _collision(term: Collision, problem: StepProblem, pos: Tensor) -> tuple[Tensor, Tensor]:
    depth, normal = term.depth(problem, pos)
    depth = depth.clamp_min(0.0)
    gradient = (-3.0 * term.weight * depth * depth)[:, None] * normal
    return gradient, _outer((6.0 * term.weight * depth)[:, None] * normal, normal)


def _friction(term: LaggedFriction, problem: StepProblem, pos: Tensor) -> tuple[Tensor, Tensor]:
    """Slope f'/y across the slip and curvature f'' along it, both positive for the mollified norm."""
    contact = problem.contact
    assert contact is not None
    force = term.coefficient * term.normal_force(problem, contact)
    sliding = (force > 0)[:, None]
    slip = torch.where(sliding, pos - problem.state.pos - (contact.next_point - contact.point), 0.0)
    normal = torch.where(sliding, contact.next_normal, 0.0)
    slip = slip - (slip * normal).sum(1, keepdim=True) * normal
    speed = (slip * slip).sum(1).sqrt()
    limit = term.slip_speed * problem.vertex_dt.squeeze(1)
    small = speed < limit
    slope = force * torch.where(small, (2.0 - speed / limit) / limit, 1.0 / torch.where(small, 1.0, speed))
    along = force * torch.where(small, 2.0 * (1.0 - speed / limit) / limit, 0.0)
    heading = slip / torch.where(speed > 0, speed, 1.0)[:, None]
    tangent = torch.eye(3, dtype=pos.dtype, device=pos.device) - _outer(normal, normal)
    matrix = slope[:, None, None] * tangent + _outer((along - slope)[:, None] * heading, heading)
    return slope[:, None] * slip, matrix


def other_gradient(potential: Potential, problem: StepProblem, pos: Tensor, acc: Tensor) -> Tensor | None:
    """Gradient (V, 3) [N] of the energies that have no closed form here, by autograd; None without any."""
    others = {name: term for name, term in potential.terms.items() if type(term) not in CLOSED_FORM}
    if not any(term.applies(problem) for term in others.values()):
        return None
    return Potential(others).gradient(problem, pos, acc)[0]


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a[:, :, None] * b[:, None, :]

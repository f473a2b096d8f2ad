"""Energies, first and positive second derivatives, element by element, in closed form.

Every matrix here is positive semi-definite: exact where the energy is convex, otherwise larger than the exact one. What was
added comes along as *indefinite part*, the exact second derivative minus the matrix, where it is written out. Elements come
last in every table: sums over three axes are slow in torch where those are the last ones. Element matrices are given by the
rows of their upper triangle, see :func:`hood.solver.system.sparsity.upper_pairs`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.energies.bending import HingeForm, bending_weight
from hood.energies.membrane import isotropic_density, isotropic_stress, weave_density, weave_roots, weave_stress
from hood.tensors.dense import at_once, index_of, safe_root

#: As in hood.mesh.geometry: a triangle is degenerate when a sine in it is below this many units of rounding.
_DEGENERATE_ULPS = 8.0
_TURN = 2.0 * math.pi


class Corners:
    """Reads the corners of elements (N, C) from a table of vertices."""

    def __init__(self, table: Tensor) -> None:
        self.shape = (3, table.shape[1], table.shape[0])
        self._index = table.t().contiguous().reshape(-1)

    def __call__(self, pos: Tensor) -> Tensor:
        """(C, 3, N) of ``pos`` (V, 3)."""
        if not at_once(pos):  # numpy gathers several times faster than torch
            flat = torch.from_numpy(np.take(pos.t().contiguous().numpy(), self._index.numpy(), axis=1))
        else:
            flat = pos.t()[:, self._index]
        return flat.view(self.shape).transpose(0, 1)


@dataclass(frozen=True)
class FaceConstants:
    """What the membrane of N faces depends on but their corners."""

    shape: Tensor  # (2, 3, N) 1/m, of column and corner: F = Σ_j x_j ⊗ shape_j
    weight: Tensor  # (N,) m³, rest area times thickness
    lame_mu: Tensor  # (N,) Pa
    lame_lambda: Tensor  # (N,) Pa
    rate: Tensor | None = None  # (N,) viscous stress is so many times the elastic one of the step's strain; None: no damping
    before: Tensor | None = None  # (3, N) Green strains at t, with ``rate``
    weave: Tensor | None = None  # (4, N) √Pa, see hood.energies.membrane, in place of the Lamé parameters; None: isotropic

    def take(self, faces: Tensor, first: Tensor) -> FaceConstants:
        """Those of some ``faces`` (M,) with their corners turned so that ``first`` (M,) leads."""
        corner = (first + torch.arange(3, device=first.device)[:, None]) % 3
        shape = self.shape[:, corner, faces]
        own = (self.weight, self.lame_mu, self.lame_lambda, self.rate, self.before, self.weave)
        return FaceConstants(shape, *(None if values is None else values[..., faces] for values in own))  # type: ignore[arg-type]

    def damped(self, rate: Tensor, pos: Tensor, faces: Tensor) -> FaceConstants:
        """The same with damping of ``rate`` (N,) about the strains of ``faces`` (N, 3) at ``pos`` (V, 3)."""
        _, _, before = _strain(Corners(faces)(pos), self.shape)
        return replace(self, rate=rate, before=torch.stack(before))


def face_constants(cloth: Cloth, factor: float = 1.0) -> FaceConstants:
    """Constants of the faces of a cloth, with a ``factor`` to its energy."""
    inverse = cloth.rest_inverse.permute(2, 1, 0)  # column, corner 1 and 2, face
    shape = torch.cat([-inverse.sum(dim=1, keepdim=True), inverse], dim=1)
    weight, weave = factor * cloth.rest_area * cloth.thickness, weave_roots(cloth)
    return FaceConstants(shape.contiguous(), weight, cloth.lame_mu, cloth.lame_lambda, weave=weave)


@dataclass(frozen=True)
class FaceModel:
    """Membrane of N faces, differentiated by their first C corners."""

    gradient: Tensor  # (C, 3, N) N
    matrix: Tensor  # (3C (3C + 1) / 2, N) N/m, upper triangle by corner, then axis
    indefinite_part: Tensor  # (C (C + 1) / 2, N) N/m, acts on the three axes alike; negative semi-definite


def face_energy(x: Tensor, constants: FaceConstants) -> Tensor:
    """Energy [J] (N,) of faces with corners ``x`` (3, 3, N), as in :class:`hood.energies.membrane.Stretching`."""
    _, _, strain = _strain(x, constants.shape)
    energy = _density(strain, constants)
    if constants.rate is not None and constants.before is not None:
        g00, g01, g11 = (now - then for now, then in zip(strain, constants.before, strict=True))
        energy = energy + constants.rate * _density((g00, g01, g11), constants)
    return constants.weight * energy


def _density(strain: tuple[Tensor, Tensor, Tensor], constants: FaceConstants) -> Tensor:
    """Energy density [J/m³] (N,) of Green strains."""
    if constants.weave is not None:
        return weave_density(constants.weave, strain)
    return isotropic_density(constants.lame_mu, constants.lame_lambda, strain)


def face_model(x: Tensor, constants: FaceConstants, num_corners: int = 3, out: Tensor | None = None) -> FaceModel:
    """StVK membrane with the tension-only projection.

    With S = 2 μ G + λ tr(G) I the gradient by corner j is A h F S b_j. The second derivative has a material part,
    positive for μ, λ + μ >= 0, and (b_j · S b_k) I₃, which is indefinite under compression: S is replaced there by
    its positive part, from the eigenvalues of a 2 × 2 matrix. The rest is the indefinite part. Damping adds its stress to S and
    makes the material part stiffer. Cloth with warp and weft has the S and the material part of :mod:`hood.energies.membrane`.

    Args:
        x: (3, 3, N) m, of corner and axis.
        num_corners: C, leading corners by which to differentiate.
        out: storage of the result's ``matrix``; not used where that is found at once (:func:`hood.tensors.dense.at_once`).
    """
    f0, f1, (g00, g01, g11) = _strain(x, constants.shape)
    b, mu = constants.shape[:, :num_corners], constants.lame_mu
    weighted = constants.weight * b
    stress = _stress((g00, g01, g11), constants)
    pull = _apply(stress, weighted)
    gradient = pull[0][:, None] * f0 + pull[1][:, None] * f1
    tension = _apply(_positive_part(*stress), weighted)
    weight = constants.weight if constants.rate is None else constants.weight * (1.0 + constants.rate)
    along, across = b[0, :, None] * f0, b[1, :, None] * f1
    shear = b[0, :, None] * f1 + b[1, :, None] * f0
    if constants.weave is None:
        # Strains G00 ± G11 and 2 G01 diagonalise the material: moduli λ + μ, μ, μ.
        bulk, soft = (weight * (constants.lame_lambda + mu)).sqrt(), (weight * mu).sqrt()
        roots = [bulk * (along + across), soft * (along - across), soft * shear]
    else:
        first, coupled, second, turn = weight.sqrt() * constants.weave
        roots = [first * along + coupled * across, second * across, turn * shear]
    axial = _symmetric(tension, b)
    if at_once(x):
        matrix = _all_at_once(roots, axial, num_corners)
    else:
        matrix = _outer_sum(roots, out)
        _add_axial(matrix, axial, num_corners)
    return FaceModel(gradient, matrix, _symmetric(pull, b) - axial)


def _stress(strain: tuple[Tensor, Tensor, Tensor], constants: FaceConstants) -> tuple[Tensor, Tensor, Tensor]:
    """Second Piola-Kirchhoff stresses S00, S01, S11 [Pa] (N,), elastic and viscous."""
    if constants.rate is not None and constants.before is not None:
        rate = constants.rate
        strain = tuple((1.0 + rate) * now - rate * then for now, then in zip(strain, constants.before, strict=True))  # type: ignore[assignment]
    if constants.weave is not None:
        return weave_stress(constants.weave, strain)
    return isotropic_stress(constants.lame_mu, constants.lame_lambda, strain)


def _strain(x: Tensor, shape: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Columns (3, N) of the deformation gradient and the Green strains G00, G01, G11 (N,)."""
    d1, d2 = x[1] - x[0], x[2] - x[0]
    f0, f1 = torch.addcmul(d1 * shape[0, 1], d2, shape[0, 2]), torch.addcmul(d1 * shape[1, 1], d2, shape[1, 2])
    return f0, f1, (0.5 * (_dot(f0, f0) - 1.0), 0.5 * _dot(f0, f1), 0.5 * (_dot(f1, f1) - 1.0))


def _apply(symmetric: tuple[Tensor, Tensor, Tensor], b: Tensor) -> tuple[Tensor, Tensor]:
    s00, s01, s11 = symmetric
    return torch.addcmul(s00 * b[0], s01, b[1]), torch.addcmul(s01 * b[0], s11, b[1])


def _symmetric(pull: tuple[Tensor, Tensor], b: Tensor) -> Tensor:
    """Upper triangle of the matrix b_j · S b_k (C, C, N)."""
    rows = [torch.addcmul(pull[0][j] * b[0, j:], pull[1][j], b[1, j:]) for j in range(b.shape[1])]
    return torch.cat(rows)


def _add_axial(matrix: Tensor, axial: Tensor, num_corners: int) -> None:
    size, place = 3 * num_corners, 0
    for j in range(num_corners):
        for k in range(j, num_corners):
            for axis in range(3):
                row = 3 * j + axis
                matrix[row * size - row * (row - 1) // 2 + 3 * (k - j)] += axial[place]
            place += 1


def _outer_sum(roots: list[Tensor], out: Tensor | None) -> Tensor:
    """Upper triangle of Σ rootᵀ root, each (C, 3, N)."""
    rows = [root.flatten(0, 1) for root in roots]
    size = rows[0].shape[0]
    result = rows[0].new_empty(size * (size + 1) // 2, rows[0].shape[1]) if out is None else out
    outer_upper(rows[0], result)
    for row in rows[1:]:
        outer_upper(row, result, add=True)
    return result


def _all_at_once(roots: list[Tensor], axial: Tensor, num_corners: int) -> Tensor:
    """The matrix of :func:`face_model` without writing twice to a place."""
    size, place = 3 * num_corners, 0
    table = [len(axial)] * (size * (size + 1) // 2)  # of most entries a row of zeros
    for j in range(num_corners):
        for k in range(j, num_corners):
            for row in range(3 * j, 3 * j + 3):
                table[row * size - row * (row - 1) // 2 + 3 * (k - j)] = place
            place += 1
    padded = torch.cat([axial, torch.zeros_like(axial[:1])])
    matrix = padded.index_select(0, index_of(tuple(table), axial.device))
    for root in roots:
        matrix = matrix + upper_of_products(root.flatten(0, 1))
    return matrix


def upper_of_products(row: Tensor) -> Tensor:
    """Upper triangles (K (K + 1) / 2, N) of the products rowᵀ row of ``row`` (K, N), in two gathers and a product."""
    pairs = [(i, j) for i in range(len(row)) for j in range(i, len(row))]
    first, second = (index_of(tuple(pair[side] for pair in pairs), row.device) for side in range(2))
    return row.index_select(0, first) * row.index_select(0, second)


def outer_upper(row: Tensor, out: Tensor, add: bool = False) -> None:
    """Upper triangles of the products rowᵀ row of ``row`` (K, N) into ``out`` (K (K + 1) / 2, N), or on top of it."""
    size = row.shape[0]
    parts = out.split([size - i for i in range(size)])
    for i, (first, part) in enumerate(zip(row.unbind(), parts, strict=True)):
        if add:
            part.addcmul_(first, row[i:])
        else:
            torch.mul(first, row[i:], out=part)


def _positive_part(s00: Tensor, s01: Tensor, s11: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The symmetric 2 × 2 matrix with its negative eigenvalues replaced by 0."""
    mean, half = 0.5 * (s00 + s11), 0.5 * (s00 - s11)
    radius = safe_root(torch.addcmul(half * half, s01, s01))  # hypot is many times slower
    high, low = (mean + radius).clamp_min(0.0), (mean - radius).clamp_min(0.0)
    centre = 0.5 * (high + low)
    slope = torch.where(radius > 0, 0.5 * (high - low) / torch.where(radius > 0, radius, 1.0), 0.0)
    return torch.addcmul(centre, slope, half), slope * s01, torch.addcmul(centre, slope, half, value=-1)


@dataclass(frozen=True)
class HingeConstants:
    """What the bending of N hinges depends on but their corners."""

    rest_angle: Tensor  # (N,) rad
    weight: Tensor  # (N,) J, second derivative of the rest shape's energy by the angle
    rest_length: Tensor  # (N,) m
    before: Tensor | None = None  # (N,) rad, angles at t, of damping alone
    per_dt: Tensor | None = None  # (N,) 1/s, with it

    def take(self, hinges: Tensor) -> HingeConstants:
        """Those of some ``hinges`` (M,)."""
        own = (self.rest_angle, self.weight, self.rest_length, self.before, self.per_dt)
        return HingeConstants(*(None if values is None else values[hinges] for values in own))  # type: ignore[arg-type]

    def moving(self, pos: Tensor, hinges: Tensor, dt: Tensor) -> HingeConstants:
        """The same with what damping needs to know of a step of ``dt`` (N,) from ``pos`` (V, 3)."""
        return replace(self, before=_angles(Corners(hinges)(pos), self.rest_length)[0], per_dt=1.0 / dt)

    def of(self, form: HingeForm) -> HingeConstants:
        """Constants of the shape that an energy is about: that at rest, or of damping that at t."""
        if form.damping is None or self.before is None or self.per_dt is None:
            return self
        return HingeConstants(self.before, form.damping * self.per_dt * self.weight, self.rest_length)


def hinge_constants(cloth: Cloth) -> HingeConstants:
    """Constants of the hinges of a cloth."""
    weight = bending_weight(cloth.bending_stiffness, cloth.hinge_rest_length**2, cloth.hinge_area)
    return HingeConstants(cloth.rest_angle, weight, cloth.hinge_rest_length)


def hinge_energy(form: HingeForm, x: Tensor, constants: HingeConstants) -> Tensor:
    """Energy [J] (N,) of hinges with corners ``x`` (4, 3, N): edge start, edge end, opposite vertices."""
    constants = constants.of(form)
    angle, _ = _angles(x, constants.rest_length)
    if form.by_length:
        edge = x[1] - x[0]
        return 0.5 * constants.weight * (angle / constants.rest_length) ** 2 * _dot(edge, edge)
    return 0.5 * constants.weight * _bend(angle, constants) ** 2


def hinge_model(form: HingeForm, x: Tensor, constants: HingeConstants) -> tuple[Tensor, Tensor]:
    """Bending: gradient (4, 3, N) and the one row (4, 3, N) of its Gauss-Newton matrix.

    The energy is ½ weight r² with r = θ - θ₀, or θ l / l₀ in the published code's form, where l is the edge's length now:
    the gradient is weight r ∇r and the row √weight ∇r.
    """
    constants = constants.of(form)
    angle, geometry = _angles(x, constants.rest_length)
    slope = geometry.slope()
    if form.by_length:
        edge = x[1] - x[0]
        length = _dot(edge, edge).sqrt()
        residual = angle * length / constants.rest_length
        slope = length / constants.rest_length * slope
        along = angle / (constants.rest_length * torch.where(length > 0, length, 1.0)) * edge
        slope[0] -= along
        slope[1] += along
    else:
        residual = _bend(angle, constants)
    return constants.weight * residual * slope, constants.weight.sqrt() * slope


def _bend(angle: Tensor, constants: HingeConstants) -> Tensor:
    bend = angle - constants.rest_angle
    return bend - _TURN * torch.round(bend / _TURN)


@dataclass(frozen=True)
class _Hinge:
    """Hinges in units of their edge at rest: edge e, arms a and b, opposite-vertex normals n₁ = e × a, n₂ = b × e."""

    unit: Tensor  # (N,) m
    regular: Tensor
    edge: Tensor
    arms: tuple[Tensor, Tensor]
    normals: tuple[Tensor, Tensor]
    edge_sq: Tensor
    normals_sq: tuple[Tensor, Tensor]

    def slope(self) -> Tensor:
        """Gradients (4, 3, N) of the angle by the corners [1/m].

        -‖e‖ n₁/‖n₁‖² and -‖e‖ n₂/‖n₂‖² at the opposite vertices; those of the edge's ends follow from there being no
        net force and torque. Degenerate hinges have none.
        """
        scale = torch.where(self.regular, -self.edge_sq.sqrt(), 0.0) / self.unit
        at_a, at_b = (scale / sq * n for n, sq in zip(self.normals, self.normals_sq, strict=True))
        share_a, share_b = (_dot(self.edge, arm) / self.edge_sq for arm in self.arms)
        at_end = -torch.addcmul(share_a * at_a, share_b, at_b)
        return torch.stack([-at_a - at_b - at_end, at_end, at_a, at_b])


def _angles(x: Tensor, rest_length: Tensor) -> tuple[Tensor, _Hinge]:
    """Angles (N,) of hinges with corners (4, 3, N), those of :func:`hood.mesh.geometry.dihedral_angles`; 0 if degenerate."""
    edge, a, b = ((x[1:] - x[0]) / rest_length).unbind(dim=0)
    n1, n2 = _cross(edge, a), _cross(b, edge)
    edge_sq, n1_sq, n2_sq = _dot(edge, edge), _dot(n1, n1), _dot(n2, n2)
    regular = _regular(n1_sq, edge_sq * _dot(a, a)) & _regular(n2_sq, edge_sq * _dot(b, b))
    edge_sq, n1_sq, n2_sq = (torch.where(regular, value, 1.0) for value in (edge_sq, n1_sq, n2_sq))
    sine = torch.where(regular, -edge_sq.sqrt() * _dot(n1, b), 0.0)
    angle = torch.atan2(sine, torch.where(regular, _dot(n1, n2), 1.0))
    return angle, _Hinge(rest_length, regular, edge, (a, b), (n1, n2), edge_sq, (n1_sq, n2_sq))


def _regular(cross_sq: Tensor, product_sq: Tensor) -> Tensor:
    info = torch.finfo(cross_sq.dtype)
    return (cross_sq > (_DEGENERATE_ULPS * info.eps) ** 2 * product_sq) & (cross_sq > info.tiny / info.eps)


def spring_model(stiffness: Tensor, x: Tensor, target: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Springs that draw x[0] - x[1] to ``target`` (3, N), None for 0: gradient (2, 3, N) and upper triangle (21, N) of their
    matrices."""
    gap = x[0] - x[1]
    pull = stiffness * (gap if target is None else gap - target)
    matrix = stiffness.new_zeros(21, len(stiffness))
    for axis in range(3):
        first = axis * 6 - axis * (axis - 1) // 2
        matrix[first], matrix[first + 3] = stiffness, -stiffness
        last = axis + 3
        matrix[last * 6 - last * (last - 1) // 2] = stiffness
    return torch.stack([pull, -pull]), matrix


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Over the leading axis of three."""
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def _cross(a: Tensor, b: Tensor) -> Tensor:
    axes = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    if at_once(a):
        return torch.stack([torch.addcmul(a[j] * b[k], a[k], b[j], value=-1) for _, j, k in axes])
    result = torch.empty_like(a)
    for i, j, k in axes:
        torch.mul(a[j], b[k], out=result[i])
        result[i].addcmul_(a[k], b[j], value=-1)
    return result

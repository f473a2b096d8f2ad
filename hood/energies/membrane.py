"""Stretching: the membrane energy of St. Venant-Kirchhoff cloth, isotropic, or orthotropic with a warp and a weft.

Of cloth with warp and weft: linear orthotropic elasticity of a thin sheet (Jones, "Mechanics of Composite Materials", 1999,
chapter 2), on the Green strain as in St. Venant-Kirchhoff's material. E is the strain in the frame of the face's warp (1) and
weft (2):

    A (½ k_warp E₁₁² + ½ k_weft E₂₂² + k_coupling E₁₁ E₂₂ + 2 k_shear E₁₂²)

| stiffness [N/m] | of the isotropic fabric and its factors |
|---|---|
| k_warp | warp · h (λ + 2 μ) |
| k_weft | weft · h (λ + 2 μ) |
| k_coupling | √(warp · weft) · h λ |
| k_shear | shear · h μ |

So a strip that may narrow resists ``warp`` or ``weft`` times as hard as one of the isotropic fabric, and Poisson's ratio, the
geometric mean of both directions, stays λ / (λ + 2 μ). The energy is positive for all factors > 0: k_warp k_weft > k_coupling²
is (λ + 2 μ)² > λ², which μ > 0 and μ + λ > 0 make true. With all factors 1 it is the isotropic energy.

Symbols: A → ``cloth.rest_area`` [m²], h → ``cloth.thickness`` [m], λ, μ → ``cloth.lame_lambda``, ``cloth.lame_mu`` [Pa]; warp,
weft, shear → the columns of ``cloth.weave``. The first column of ``cloth.rest_inverse`` is the warp.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.energies.problem import StepProblem, sum_per_scene
from hood.energies.term import Energy, Form, Passes, Role
from hood.tensors.batch import made_of


def weave_roots(cloth: Cloth, dtype: torch.dtype | None = None) -> Tensor | None:
    """Square roots (4, F) [√Pa] of the stiffness of every face, over its thickness; None for isotropic cloth.

    They are a, b, c, d with the energy density [J/m³] ½ ((a E₁₁ + b E₂₂)² + (c E₂₂)² + (d 2 E₁₂)²): positive however much the
    stiffnesses differ.

    Args:
        dtype: to compute in; None: that of the cloth.
    """
    if cloth.weave is None:
        return None
    warp, weft, shear = cloth.weave.to(dtype).unbind(dim=1)
    mu, lam = cloth.lame_mu.to(dtype), cloth.lame_lambda.to(dtype)
    plane = lam + 2.0 * mu
    across = weft * plane
    narrowing = 4.0 * mu * (lam + mu) / (plane * plane)  # 1 - ν², without the difference
    return torch.stack([(warp * plane).sqrt(), lam / plane * across.sqrt(), (across * narrowing).sqrt(), (shear * mu).sqrt()])


def weave_density(roots: Tensor, strain: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Energy density [J/m³] (N,) of Green strains E₁₁, E₁₂, E₂₂ by the roots (4, N) of their stiffness."""
    e11, e12, e22 = strain
    first, second, turn = torch.addcmul(roots[0] * e11, roots[1], e22), roots[2] * e22, 2.0 * roots[3] * e12
    return 0.5 * (first * first + second * second + turn * turn)


def weave_stress(roots: Tensor, strain: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Second Piola-Kirchhoff stresses S₁₁, S₁₂, S₂₂ [Pa] (N,) of such strains."""
    e11, e12, e22 = strain
    first = torch.addcmul(roots[0] * e11, roots[1], e22)
    return roots[0] * first, 2.0 * roots[3] * roots[3] * e12, torch.addcmul(roots[1] * first, roots[2] * roots[2], e22)


def isotropic_density(mu: Tensor, lam: Tensor, strain: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Energy density μ tr G² + ½ λ tr² G [J/m³] (N,) of Green strains G₀₀, G₀₁, G₁₁ by Lamé parameters (N,) [Pa]."""
    g00, g01, g11 = strain
    trace = g00 + g11
    square = g00 * g00 + g11 * g11 + 2.0 * g01 * g01
    return mu * square + 0.5 * lam * trace * trace


def isotropic_stress(mu: Tensor, lam: Tensor, strain: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Second Piola-Kirchhoff stresses 2 μ G + λ tr(G) I, S₀₀, S₀₁, S₁₁ [Pa] (N,), of such strains."""
    g00, g01, g11 = strain
    pressure = lam * (g00 + g11)
    return 2.0 * mu * g00 + pressure, 2.0 * mu * g01, 2.0 * mu * g11 + pressure


class Stretching(Energy):
    """StVK membrane energy [J], the sum over faces of A h (μ tr G² + ½ λ tr² G) (HOOD paper, section 3.3;
    SNUG).

    G = ½ (FᵀF - I) is the Green strain and F = D_s D_m⁻¹ the 3×2 deformation gradient. Zero at rest,
    invariant under rigid motion, no net force or torque; finite for every shape, as F enters as a polynomial.

    A → ``cloth.rest_area`` [m²], h → ``cloth.thickness`` [m], μ, λ → ``cloth.lame_mu``, ``cloth.lame_lambda``
    [Pa], D_m⁻¹ → ``cloth.rest_inverse`` [1/m]. Cloth that has a ``weave`` has the orthotropic energy of
    this module instead.
    """

    kind: ClassVar[str] = "Stretching"
    role = Role.ELASTIC
    form = Form.MEMBRANE

    def applies(self, problem: StepProblem) -> bool:
        return True

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        cloth = problem.cloth
        density = membrane_density(cloth, green_strain(next_pos, cloth.faces, cloth.rest_inverse))
        return sum_per_scene(cloth.rest_area * cloth.thickness * density, cloth.face_scene, cloth.num_scenes)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> bool:
        return True


class CodedStretching(Stretching):
    """The membrane energy [J] with which the published weights Fine15 and Fine48 were trained: λ times the bending stiffness.

    The fabric's constants reach their code in another order than it takes them, and a product in place multiplies λ by the
    bending stiffness k [J] as a number. The default fabric has 1.76 Pa in place of 44,400 Pa: cloth that resists shear and
    stretch by μ alone. Networks are shown the fabric as it is, λ included; so they do not learn what softens it, k apart.

    A fabric has one value a garment there. Of one that varies a face has the mean of λ k at its corners.
    """

    kind: ClassVar[str] = "CodedStretching"
    form = Form.MEMBRANE

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with the λ of this energy in its cloth; the fabric that networks are shown stays. Itself where that is
        done."""
        cloth = softened(problem.cloth)
        return problem if cloth is problem.cloth else replace(problem, cloth=cloth)

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        return super().__call__(self.prepare(problem), next_pos, acc)


def softened(cloth: Cloth) -> Cloth:
    """The cloth with λ k in place of λ in its energies, one and the same object whenever asked; what it made, itself."""
    made = made_of(cloth)
    if "softened" not in made:
        # From the fabric at vertices, which stays: a cloth that was softened and then copied is not softened twice.
        product = cloth.vertex_fabric[:, 1] * cloth.vertex_fabric[:, 2]
        made["softened"] = soft = replace(cloth, lame_lambda=product[cloth.faces].mean(dim=1))
        made_of(soft)["softened"] = soft
    soft = made["softened"]
    return soft


def membrane_density(cloth: Cloth, strain: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Elastic energy per volume [J/m³] (F,) of Green strains of the faces."""
    roots = weave_roots(cloth)
    if roots is not None:
        return weave_density(roots, strain)
    return isotropic_density(cloth.lame_mu, cloth.lame_lambda, strain)


def green_strain(pos: Tensor, faces: Tensor, rest_inverse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Components G₀₀, G₀₁, G₁₁ of the Green strain, each (F,).

    Written by components: small batched matrix products are slower, and autocast would run them in half
    precision.
    """
    corners = pos[faces]
    d1, d2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    inverse = rest_inverse.unsqueeze(-1)
    f0 = d1 * inverse[:, 0, 0] + d2 * inverse[:, 1, 0]
    f1 = d1 * inverse[:, 0, 1] + d2 * inverse[:, 1, 1]
    g00 = 0.5 * ((f0 * f0).sum(dim=1) - 1.0)
    g01 = 0.5 * (f0 * f1).sum(dim=1)
    g11 = 0.5 * ((f1 * f1).sum(dim=1) - 1.0)
    return g00, g01, g11

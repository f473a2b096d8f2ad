"""Membrane energy of St. Venant-Kirchhoff cloth; that of cloth with warp and weft is in :mod:`hood.losses.weave`."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from hood.losses.problem import StepProblem, sum_per_scene
from hood.losses.weave import weave_density, weave_roots
from hood.scene.cloth import Cloth


class Stretching:
    """StVK membrane energy [J], the sum over faces of A h (μ tr G² + ½ λ tr² G) (HOOD paper, section 3.3;
    SNUG).

    G = ½ (FᵀF - I) is the Green strain and F = D_s D_m⁻¹ the 3×2 deformation gradient. Zero at rest,
    invariant under rigid motion, no net force or torque; finite for every shape, as F enters as a polynomial.

    A → ``cloth.rest_area`` [m²], h → ``cloth.thickness`` [m], μ, λ → ``cloth.lame_mu``, ``cloth.lame_lambda``
    [Pa], D_m⁻¹ → ``cloth.rest_inverse`` [1/m]. Cloth that has a ``weave`` has the orthotropic energy of
    :mod:`hood.losses.weave` instead.
    """

    kind: ClassVar[str] = "Stretching"

    def applies(self, problem: StepProblem) -> bool:
        return True

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        cloth = problem.cloth
        density = membrane_density(cloth, green_strain(next_pos, cloth.faces, cloth.rest_inverse))
        return sum_per_scene(cloth.rest_area * cloth.thickness * density, cloth.face_scene, cloth.num_scenes)


def membrane_density(cloth: Cloth, strain: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Elastic energy per volume [J/m³] (F,) of Green strains of the faces."""
    roots = weave_roots(cloth)
    if roots is not None:
        return weave_density(roots, strain)
    g00, g01, g11 = strain
    trace = g00 + g11
    square = g00 * g00 + g11 * g11 + 2.0 * g01 * g01
    return cloth.lame_mu * square + 0.5 * cloth.lame_lambda * trace * trace


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

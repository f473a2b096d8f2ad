"""Cloth with warp and weft: its energy against the isotropic one, closed forms and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.assets.material import FaceField, Material, stretch_stiffness
from hood.cloth.cloth import Cloth, build_cloth, concatenate_cloths
from hood.energies.compiled_elements import element_energies, library
from hood.energies.damping import StretchDamping
from hood.energies.membrane import Stretching, green_strain, weave_roots
from hood.energies.potential import Potential
from hood.energies.problem import sum_per_scene
from hood.mesh import geometry
from hood.testing import cylinder, grid, make_problem, random_rotation, sphere, with_weave

F64 = torch.float64
WOVEN = Material(warp=40.0, weft=15.0, shear=0.3)


def woven(mesh, material: Material = WOVEN, uv=None) -> Cloth:
    return build_cloth(*mesh, material, dtype=F64, uv=uv)


def deformed(cloth: Cloth, size: float = 0.02, seed: int = 0) -> Tensor:
    noise = np.random.default_rng(seed).normal(size=tuple(cloth.rest_pos.shape))
    return 1.05 * cloth.rest_pos + size * torch.as_tensor(noise)


def energy(cloth: Cloth, pos: Tensor, term=None) -> Tensor:
    return (term or Stretching())(make_problem(cloth), pos, pos).sum()


@pytest.mark.parametrize("mesh", [cylinder(7, 4), grid(4, 5), sphere(1)], ids=["tube", "sheet", "ball"])
def test_equal_stiffnesses_are_the_isotropic_energy_with_its_gradient_and_hessian(mesh):
    cloth = build_cloth(*mesh, Material(), dtype=F64)
    same = with_weave(cloth, 1.0, 1.0, 1.0)
    assert not torch.equal(same.rest_inverse, cloth.rest_inverse)
    for pos in (cloth.rest_pos, deformed(cloth), deformed(cloth, 0.2)):
        size = 1.0 + float(energy(cloth, pos))
        assert float(energy(same, pos)) == pytest.approx(float(energy(cloth, pos)), rel=1e-13, abs=1e-16)
        forces = [torch.autograd.functional.jacobian(lambda x, c=one: energy(c, x), pos) for one in (cloth, same)]
        torch.testing.assert_close(forces[1], forces[0], rtol=1e-12, atol=1e-12 * size)
        hessians = [torch.autograd.functional.hessian(lambda x, c=one: energy(c, x), pos) for one in (cloth, same)]
        torch.testing.assert_close(hessians[1], hessians[0], rtol=1e-12, atol=1e-12 * float(hessians[0].abs().max()))


def test_the_default_fabric_has_no_weave_and_a_factor_gives_it_one():
    assert build_cloth(*grid(3, 3), Material(), dtype=F64).weave is None
    assert build_cloth(*grid(3, 3), Material(warp=FaceField(np.ones(8))), dtype=F64).grain is None
    assert woven(grid(3, 3)).weave.tolist() == [[40.0, 15.0, 0.3]] * 8


def test_isotropic_cloth_is_computed_as_ever_to_the_last_bit():
    mesh = cylinder(7, 4)
    cloth = build_cloth(*mesh, Material(warp=1.0, weft=1.0, shear=1.0))
    pos = deformed(cloth).float()
    assert torch.equal(cloth.rest_inverse, geometry.rest_inverse(torch.as_tensor(mesh[0]), cloth.faces).float())
    g00, g01, g11 = green_strain(pos, cloth.faces, cloth.rest_inverse)
    trace, square = g00 + g11, g00 * g00 + g11 * g11 + 2.0 * g01 * g01
    density = cloth.lame_mu * square + 0.5 * cloth.lame_lambda * trace * trace
    expected = sum_per_scene(cloth.rest_area * cloth.thickness * density, cloth.face_scene, 1)
    assert torch.equal(Stretching()(make_problem(cloth), pos, pos), expected)


def test_every_stiffness_is_what_its_factor_says():
    """A flat sheet in the plane y = 0 has its warp along z and its weft along x."""
    mesh, base = grid(3, 3, 1.0), Material()
    cloth = woven(mesh)
    h, mu, lam = base.thickness, base.lame_mu, base.lame_lambda
    plane, e = h * (lam + 2.0 * mu), 1e-6

    def density(x: list[float], z: list[float]) -> float:
        """J/m² of the sheet with its x and z axes taken to these."""
        pos = cloth.rest_pos[:, :1] * torch.tensor(x, dtype=F64) + cloth.rest_pos[:, 2:] * torch.tensor(z, dtype=F64)
        return float(energy(cloth, pos))

    assert density([1, 0, 0], [0, 0, 1 + e]) == pytest.approx(0.5 * 40.0 * plane * e**2, rel=1e-5)
    assert density([1 + e, 0, 0], [0, 0, 1]) == pytest.approx(0.5 * 15.0 * plane * e**2, rel=1e-5)
    assert density([1, 0, e], [0, 0, 1]) == pytest.approx(0.5 * 0.3 * h * mu * e**2, rel=1e-5)
    both = 0.5 * (40.0 + 15.0) * plane + np.sqrt(40.0 * 15.0) * h * lam
    assert density([1 + e, 0, 0], [0, 0, 1 + e]) == pytest.approx(both * e**2, rel=1e-5)
    # A strip that may narrow: the least energy over the other strain.
    strip = stretch_stiffness(mu, lam, h)
    narrowing = e * np.sqrt(40.0 / 15.0) * lam / (lam + 2.0 * mu)
    assert density([1 - narrowing, 0, 0], [0, 0, 1 + e]) == pytest.approx(0.5 * 40.0 * strip * e**2, rel=1e-5)


@pytest.mark.parametrize("factors", [(1e3, 1.0, 1.0), (1.0, 1e3, 1e-3), (1e3, 1e3, 1e-3), (1e-3, 1e3, 1.0)])
@pytest.mark.parametrize("lam", [-20000.0, 0.0, 1e7])
def test_the_stiffness_is_positive_definite_whatever_the_factors(factors, lam):
    cloth = woven(grid(2, 2), Material(lame_lambda=lam, warp=factors[0], weft=factors[1], shear=factors[2]))
    first, coupled, second, turn = weave_roots(cloth)
    matrix = torch.zeros(len(first), 3, 3, dtype=F64)
    matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 2, 2] = first**2, coupled**2 + second**2, turn**2
    matrix[:, 0, 1] = matrix[:, 1, 0] = first * coupled
    assert bool((matrix[:, 0, 0] * matrix[:, 1, 1] > matrix[:, 0, 1] ** 2).all())
    size = matrix.diagonal(dim1=1, dim2=2).rsqrt()
    assert float(torch.linalg.eigvalsh(size[:, :, None] * matrix * size[:, None, :]).min()) > 0
    assert float(energy(cloth, deformed(cloth, 0.3))) > 0


@pytest.mark.parametrize("term", [Stretching(), StretchDamping(0.05)], ids=["elastic", "damping"])
def test_contract(term):
    """Rigid motion costs nothing, forces and torques vanish, gradients are those of finite differences."""
    rng, mesh = np.random.default_rng(3), cylinder(7, 4)
    cloth = woven(mesh)
    pos = deformed(cloth)
    problem = make_problem(cloth)
    turn, shift = torch.as_tensor(random_rotation(rng)).T, torch.tensor([0.3, -0.2, 0.5], dtype=F64)
    size = float(energy(cloth, pos, term))
    assert abs(float(energy(cloth, cloth.rest_pos @ turn + shift, term))) < 1e-20 * size
    assert float(energy(cloth, pos @ turn + shift, term)) == pytest.approx(size, rel=1e-12)
    force, _ = Potential({"term": term}).gradient(problem, pos)
    scale = float(force.abs().sum())
    assert float(force.sum(dim=0).abs().max()) < 1e-12 * scale
    assert float(torch.linalg.cross(pos, force).sum(dim=0).abs().max()) < 1e-12 * scale
    assert torch.autograd.gradcheck(lambda x: term(problem, x, x), pos.clone().requires_grad_(True), eps=1e-7, atol=1e-5)
    flat = pos.clone()
    flat[:] = pos[0]  # all in one point
    assert bool(torch.isfinite(Potential({"term": term}).gradient(problem, flat)[0]).all())


def test_order_and_winding_of_the_corners_play_no_role():
    pos, faces = cylinder(7, 4)
    cloth = woven((pos, faces))
    x = deformed(cloth)
    for turned in (faces[:, [1, 2, 0]], faces[:, [0, 2, 1]], faces[::-1].copy()):
        assert float(energy(woven((pos, turned)), x)) == pytest.approx(float(energy(cloth, x)), rel=1e-12)


def test_a_batch_of_woven_and_plain_cloth_is_its_scenes():
    plain = [build_cloth(*mesh, Material(), dtype=F64) for mesh in (grid(4, 4), sphere(1))]
    cloths = [plain[0], woven(cylinder(6, 3)), plain[1]]
    places = [deformed(cloth, seed=seed) for seed, cloth in enumerate(cloths)]
    together = Stretching()(make_problem(concatenate_cloths(cloths)), torch.cat(places), torch.cat(places))
    alone = [float(energy(cloth, pos)) for cloth, pos in zip(cloths, places, strict=True)]
    assert together.tolist() == pytest.approx(alone, rel=1e-13)
    assert concatenate_cloths(cloths[::2]).weave is None


@pytest.mark.skipif(library() is None, reason="needs a compiler")
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_the_compiled_pass_is_the_torch_form(dtype):
    cloth = build_cloth(*cylinder(9, 5), WOVEN, dtype=dtype)  # 72 faces
    cloth = concatenate_cloths([cloth, build_cloth(*grid(4, 4), Material(), dtype=dtype)])
    problem = make_problem(cloth)
    pos = deformed(cloth)
    gradient = np.zeros(tuple(pos.shape))
    membrane = Potential({"stretching": Stretching()})
    found = element_energies(membrane, problem, pos.double().numpy(), gradient)["stretching"]
    real = {name: v.double() for name, v in vars(cloth).items() if isinstance(v, Tensor) and v.is_floating_point()}
    force, energies = membrane.gradient(make_problem(replace(cloth, **real)), pos.double())
    torch.testing.assert_close(found, energies["stretching"], rtol=1e-13, atol=0)
    torch.testing.assert_close(torch.from_numpy(gradient), force, rtol=1e-10, atol=1e-12 * float(force.abs().max()))

"""The laws of energies, in Python as in C++; slopes and curvatures of contact and friction are those of the values."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hood import native
from hood.energies import laws
from hood.energies.membrane import green_strain, isotropic_density, isotropic_stress, weave_density, weave_stress
from hood.mesh.geometry import dihedral_angles
from hood.native.arguments import POINTER
from hood.native.build import NATIVE_FLAGS, build

WEIGHT, LIMIT, FORCE = 3e4, 2e-3, 1.7
#: By their names in C++: the same in Python, of depths [m] or slips [m].
CONTACT = {
    "contact_energy": lambda p: laws.contact_energy(WEIGHT, p),
    "contact_force": lambda p: laws.contact_force(WEIGHT, p),
    "contact_curvature": lambda p: laws.contact_curvature(WEIGHT, p),
}
FRICTION = {
    "mollified_norm": lambda y: laws.mollified_norm(y * y, _like(y)),
    "slip_slope": lambda y: laws.slip_slope(y, _like(y)),
}
WITH_FORCE = {
    "friction_slope": lambda y: FORCE * laws.slip_slope(y, _like(y)),
    "friction_curvature": lambda y: FORCE * laws.slip_curvature(y, _like(y)),
}

#: Calls of the laws of elements, of rows of eight numbers.
ELEMENTS = """
template <int IN, int OUT, class Law> void call(const double* in, double* out, const Law& law) {
    for (int i = 0; i < LANES; i += AT_ONCE) {
        VN x[IN], y[OUT];
        for (int k = 0; k < IN; ++k) x[k] = load<VN>(in + LANES * k + i);
        law(x, y);
        for (int k = 0; k < OUT; ++k) store(out + LANES * k + i, y[k]);
    }
}
template <class Law> void respond(const Law& law, const VN* x, VN* y) {
    const Strain g{x[0], x[1], x[2]};
    const Stress s = stress_of(law, g, x[3]);
    y[0] = density_of(law, g), y[1] = s.s00, y[2] = s.s01, y[3] = s.s11;
}
extern "C" {
void _strain(const double* in, double* out) {
    call<6, 3>(in, out, [](const VN* x, VN* y) {
        VN f[2][3];
        for (int k = 0; k < 6; ++k) f[k / 3][k % 3] = x[k];
        const Strain g = green_strain(f);
        y[0] = g.g00, y[1] = g.g01, y[2] = g.g11;
    });
}
void _isotropic(const double* in, double* out) {
    call<6, 4>(in, out, [](const VN* x, VN* y) { respond(Isotropic{x[4], x[5]}, x, y); });
}
void _weave(const double* in, double* out) {
    call<8, 4>(in, out, [](const VN* x, VN* y) { respond(Weave{x[4], x[5], x[6], x[7]}, x, y); });
}
void _hinge(const double* in, double* out) {
    call<11, 14>(in, out, [](const VN* x, VN* y) {
        VN offset[3][3], slope[4][3];
        for (int k = 0; k < 9; ++k) offset[k / 3][k % 3] = x[k];
        Hinge h;
        hinge_of(offset, x[9], h);
        hinge_slopes(h, -h.length * x[9], slope);
        for (int k = 0; k < 12; ++k) y[k] = slope[k / 3][k % 3];
        y[12] = h.angle, y[13] = bending_energy(x[9], bend_of(h.angle, x[10]));
    });
}
}
"""


def _like(y: Tensor) -> Tensor:
    return torch.full_like(y, LIMIT)


def slope(function, x: Tensor) -> Tensor:
    x = x.clone().requires_grad_(True)
    return torch.autograd.grad(function(x).sum(), x)[0]


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    calls = [f"double _{name}(double p) {{ return {name}({WEIGHT}, p); }}" for name in CONTACT]
    calls += [f"double _{name}(double y) {{ return {name}(y, {LIMIT}); }}" for name in FRICTION]
    calls += [f"double _{name}(double y) {{ return {name}({FORCE}, y, {LIMIT}); }}" for name in WITH_FORCE]
    headers = [Path(native.__file__).with_name(name) for name in ("laws.h", "element_laws.h")]
    source = tmp_path_factory.mktemp("laws") / "calls.cpp"
    source.write_text("\n".join([*(f'#include "{path}"' for path in headers), 'extern "C" {', *calls, "}", ELEMENTS]))
    return build(source, NATIVE_FLAGS)


@pytest.mark.parametrize("name", [*CONTACT, *FRICTION, *WITH_FORCE])
def test_both_languages_have_one_law(name: str, compiled: ctypes.CDLL) -> None:
    call = getattr(compiled, f"_{name}")
    call.restype, call.argtypes = ctypes.c_double, [ctypes.c_double]
    x = torch.cat([torch.linspace(1e-9, 3 * LIMIT, 200), torch.tensor([LIMIT])]).double()
    expected = (CONTACT | FRICTION | WITH_FORCE)[name](x)
    found = torch.tensor([call(value) for value in x.tolist()], dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=4e-15, atol=1e-30)


def test_contact_slopes_are_of_its_energy() -> None:
    p = torch.linspace(-0.01, 0.02, 61, dtype=torch.float64)
    torch.testing.assert_close(slope(CONTACT["contact_energy"], p), CONTACT["contact_force"](p), rtol=1e-13, atol=1e-18)
    torch.testing.assert_close(slope(CONTACT["contact_force"], p), CONTACT["contact_curvature"](p), rtol=1e-13, atol=1e-18)
    force = CONTACT["contact_force"](p)
    torch.testing.assert_close(laws.contact_depth(WEIGHT, force), p.clamp_min(0.0))


def test_friction_slopes_are_of_its_energy() -> None:
    y = torch.linspace(1e-6, 3 * LIMIT, 61, dtype=torch.float64)
    torch.testing.assert_close(slope(FRICTION["mollified_norm"], y) / y, FRICTION["slip_slope"](y), rtol=1e-12, atol=0.0)
    curved = slope(lambda y: y * laws.slip_slope(y, _like(y)), y)
    torch.testing.assert_close(curved, laws.slip_curvature(y, _like(y)), rtol=1e-10, atol=1e-9)


def test_the_solvers_may_bound_friction_by_its_slope() -> None:
    """f'' <= f' / y, finite where nothing slips: f' / y in all directions bounds the exact matrix."""
    y = torch.cat([torch.zeros(1), torch.linspace(0.0, 3 * LIMIT, 200)]).double()
    assert bool((laws.slip_curvature(y, _like(y)) <= laws.slip_slope(y, _like(y))).all())
    assert bool(torch.isfinite(laws.slip_slope(y, _like(y))).all())


def drawn(seed: int, *sizes: int) -> Tensor:
    return torch.as_tensor(np.random.default_rng(seed).normal(size=sizes))


def of_elements(compiled: ctypes.CDLL, name: str, rows: list[Tensor], count: int) -> Tensor:
    """``count`` rows (N,) that a call of :data:`ELEMENTS` makes of others; N is a multiple of eight."""
    call = getattr(compiled, f"_{name}")
    call.restype, call.argtypes = None, [POINTER, POINTER]
    found = []
    for eight in torch.stack(rows).split(8, dim=1):
        given, made = np.ascontiguousarray(eight.numpy()), np.empty((count, 8))
        call(given.ctypes.data, made.ctypes.data)
        found.append(torch.from_numpy(made))
    return torch.cat(found, dim=1)


def assert_rows(found: Tensor, *expected: Tensor) -> None:
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-13, atol=1e-15 * float(other.abs().max()))


def test_strain_is_that_of_the_deformation_gradient(compiled: ctypes.CDLL) -> None:
    corners, inverse = drawn(0, 200, 3, 3), drawn(1, 200, 2, 2)
    columns = torch.einsum("nik,nij->jkn", corners[:, 1:] - corners[:, :1], inverse)
    expected = green_strain(corners.flatten(0, 1), torch.arange(600).reshape(200, 3), inverse)
    assert_rows(of_elements(compiled, "strain", [*columns.flatten(0, 1)], 3), *expected)


@pytest.mark.parametrize("name", ["isotropic", "weave"])
def test_density_and_stress_are_those_of_the_membrane(name: str, compiled: ctypes.CDLL) -> None:
    strain, factor = tuple(drawn(0, 3, 200)), drawn(1, 200)
    if name == "isotropic":
        constants = drawn(2, 2, 200).exp()
        density, stress = isotropic_density(*constants, strain), isotropic_stress(*constants, strain)
    else:
        constants = drawn(2, 4, 200).exp()
        density, stress = weave_density(constants, strain), weave_stress(constants, strain)
    found = of_elements(compiled, name, [*strain, factor, *constants], 4)
    assert_rows(found, density, *(factor * part for part in stress))


def test_angle_slopes_and_energy_are_those_of_a_hinge(compiled: ctypes.CDLL) -> None:
    offsets, scale, rest_angle = drawn(0, 200, 3, 3), drawn(1, 200).exp(), drawn(2, 200).clamp(-3.0, 3.0)
    offsets[7, 2], offsets[11, 0] = -0.5 * offsets[7, 0], 0.0  # faces without area
    corners = torch.cat([torch.zeros(200, 1, 3), offsets], dim=1)
    hinges = torch.arange(800).reshape(200, 4)
    angle = dihedral_angles(corners.flatten(0, 1), hinges)
    bend = torch.remainder(angle - rest_angle + torch.pi, 2.0 * torch.pi) - torch.pi
    found = of_elements(compiled, "hinge", [*offsets.flatten(1).T, scale, rest_angle], 14)
    assert_rows(found[12:], angle, 0.5 * scale * bend * bend)
    expected = slope(lambda x: dihedral_angles(x, hinges), corners.flatten(0, 1)).reshape(200, 12)
    assert not expected[[7, 11]].any()
    size = expected.abs().amax(dim=1).clamp_min(1e-30)
    torch.testing.assert_close(found[:12] / size, expected.T / size, rtol=0.0, atol=1e-13)

"""The laws of contact and friction: slopes and curvatures are those of the values, in Python as in C++."""

from __future__ import annotations

import ctypes
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hood import native
from hood.energies import laws
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
    header = Path(native.__file__).with_name("laws.h")
    source = tmp_path_factory.mktemp("laws") / "calls.cpp"
    source.write_text(f'#include "{header}"\nextern "C" {{\n' + "\n".join(calls) + "\n}\n")
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

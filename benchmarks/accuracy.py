"""What γ and rg mean in millimetres: the same numbers for a falling piece of cloth that is put at known places.

    python benchmarks/accuracy.py

A square of the default fabric, 20 cm wide with edges of 1 cm, is let go. A step of 1/30 s later it should have fallen by
g dt² = 10.9 mm; it is put there, beside that place, and there with its vertices shaken.
"""

from __future__ import annotations

import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.potential import default_potential, relative_gradient, scale
from hood.testing import grid, make_problem

DT, GRAVITY = 1 / 30, 9.81


def main() -> None:
    problem = make_problem(build_cloth(*grid(21, 21, 0.2), Material()), dt=DT)
    potential = default_potential()
    problem = potential.prepare(problem)
    falls = problem.state.pos - torch.tensor([0.0, GRAVITY * DT**2, 0.0])
    lowest = potential.total(problem, falls)
    noise = torch.randn(falls.shape, generator=torch.Generator().manual_seed(0))
    aside = torch.tensor([1e-3, 0.0, 0.0])
    places = {
        "where it should be": falls,
        "all of it 1.09 mm aside": falls + 1.09 * aside,
        "all of it 10.9 mm aside": falls + 10.9 * aside,
        "still where it was": problem.state.pos,
        "every vertex 0.01 mm off": falls + 1e-5 * noise,
        "every vertex 0.1 mm off": falls + 1e-4 * noise,
    }
    print(f"{'':26}{'γ':>10}{'rg':>10}")
    for name, pos in places.items():
        place = pos.clone().requires_grad_()
        phi = potential.total(problem, place)
        (gradient,) = torch.autograd.grad(phi.sum(), place)
        gamma, residual = (phi.detach() - lowest) / scale(problem), relative_gradient(problem, gradient)
        print(f"{name:26}{gamma.item():>10.2g}{residual.item():>10.2g}")


if __name__ == "__main__":
    main()

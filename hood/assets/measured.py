"""Measured cloth: what the instruments of textile laboratories give, in SI units, and the fabric of the potential made of it.

The units of KES-F (Kawabata, "The Standardization and Analysis of Hand Evaluation", 1980) and of trade, in SI:

| quantity | there | here |
|---|---|---|
| density | 1 mg/cm² | 0.01 kg/m² |
| | 1 oz/yd² | 0.0339057 kg/m² |
| | 1 momme, of silk: 1 lb on 45 in × 100 yd | 0.004340 kg/m² |
| bending rigidity B | 1 gf·cm²/cm | 9.80665e-5 N·m |
| shear stiffness G | 1 gf/(cm·degree) | 56.188 N/m, per radian |
| stretch stiffness | 500 gf/cm at an extension of EMT % | 49033 / EMT N/m, the secant |
| | WT gf·cm/cm² and linearity LT | EMT = 100 · 2 WT / (500 LT) % |

How they become the isotropic fabric of :class:`hood.losses.stretching.Stretching` and :class:`hood.losses.bending.Bending`, h
being the thickness [m] of that fabric, μ and λ [Pa] its Lamé parameters and k [J] its ``bending_stiffness``:

    h μ = G,    ν = Y / (2 G) - 1, cut to 0 … 0.5,    λ = 2 μ ν / (1 - ν),    k = 4 B

G is kept exactly, for drape depends on shear and hardly on stretch (Cusick, "The dependence of fabric drape on bending and
shear stiffness", J. Text. Inst. 56, 1965). Y is the geometric mean of warp and weft. An isotropic sheet of shear stiffness G
has a stretch stiffness of 4 G at most, and of 3 G at ν = 0.5; woven cloth has some hundred G. So the stretch stiffness of
wovens is not reached, which matters where they are pulled: see docs/fabrics.md.

Fabrics that are ``woven`` reach it, by the energy of :mod:`hood.losses.weave`: ``warp`` and ``weft`` are the measured stretch
stiffnesses over that of the isotropic fabric, whose G and ν stay.

k = 4 B: on a mesh of equilateral triangles the hinge energy of a sheet bent to a cylinder is that of a plate of rigidity k/4,
in every direction. B is the mean of warp and weft.
"""

from __future__ import annotations

import math

from hood.assets.material import Material

#: Gravity [m/s²] of the bending length, and the largest Poisson ratio that is used.
_GRAVITY, _POISSON = 9.81, 0.5
#: h, that of the models' training: only h μ and h λ act, and a network reads from μ and λ what it was trained on.
_THICKNESS = 4.7e-4


def measured(
    density: float,
    stretch_warp: float,
    stretch_weft: float,
    shear: float,
    bending_warp: float,
    bending_weft: float,
    friction: float = 1.0,
    woven: bool = False,
) -> Material:
    """The fabric nearest to a measured cloth, by the rules above.

    Args:
        density: kg/m².
        stretch_warp, stretch_weft: force per width over extension, N/m; of knits along wales and courses.
        shear: force per width over the angle of shear in radians, N/m.
        bending_warp, bending_weft: bending rigidity of a strip along warp or weft per width, N·m.
        friction: times the coefficient of friction on the body.
        woven: whether it stretches along warp and weft as measured; otherwise it is isotropic.

    Raises:
        ValueError: a value is not finite, or not positive (bending may be 0), or ``woven`` is neither true nor false; names
            the key.

    Examples:
        >>> fabric = measured(0.2635, 8134.0, 8134.0, 54.4, 1.331e-5, 1.331e-5)
        >>> round(fabric.lame_mu), f"{fabric.bending_stiffness:.3e}"
        (115745, '5.324e-05')
    """
    given = {
        "density": density, "stretch_warp": stretch_warp, "stretch_weft": stretch_weft, "shear": shear,
        "bending_warp": bending_warp, "bending_weft": bending_weft,
    }  # fmt: skip
    for key, value in given.items():
        bending = key.startswith("bending")
        if not math.isfinite(value) or value < 0 or (value == 0 and not bending):
            raise ValueError(f"material {key!r} is {value}; it must be finite and {'>= 0' if bending else '> 0'}")
    if not isinstance(woven, bool):
        raise ValueError(f"material 'woven' is {woven!r}; give true (warp and weft as measured) or false (isotropic)")
    poisson = min(max(0.5 * math.sqrt(stretch_warp * stretch_weft) / shear - 1.0, 0.0), _POISSON)
    mu = shear / _THICKNESS
    lam = 2.0 * mu * poisson / (1.0 - poisson)
    isotropic = stretch_stiffness(mu, lam, _THICKNESS)
    return Material(
        density=density,
        lame_mu=mu,
        lame_lambda=lam,
        bending_stiffness=4.0 * 0.5 * (bending_warp + bending_weft),
        thickness=_THICKNESS,
        friction=friction,
        warp=stretch_warp / isotropic if woven else 1.0,
        weft=stretch_weft / isotropic if woven else 1.0,
    )


def stretch_stiffness(mu: float, lam: float, thickness: float) -> float:
    """Force per width over extension [N/m] of a strip that may narrow, of an isotropic membrane: 4 h μ (μ + λ) / (2 μ + λ)."""
    return 4.0 * thickness * mu * (mu + lam) / (2.0 * mu + lam)


def bending_length(rigidity: float, density: float) -> float:
    """Bending length [m], (B / (ρ g))^(1/3), of a bending rigidity B [N·m] and a density ρ [kg/m²] (Peirce, "The 'handle' of
    cloth as a measurable quantity", J. Text. Inst. 21, 1930): half the overhang of a strip that bends down to 41.5°."""
    return (rigidity / (density * _GRAVITY)) ** (1.0 / 3.0)

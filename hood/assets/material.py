"""Fabrics: the material parameters of the potential, their ranges in training and their sampling.

Measured cloth: what the instruments of textile laboratories give, in SI units, and the fabric of the potential made of it.

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

How they become the isotropic fabric of :class:`hood.energies.membrane.Stretching` and :class:`hood.energies.bending.Bending`, h
being the thickness [m] of that fabric, μ and λ [Pa] its Lamé parameters and k [J] its ``bending_stiffness``:

    h μ = G,    ν = Y / (2 G) - 1, cut to 0 … 0.5,    λ = 2 μ ν / (1 - ν),    k = 4 B

G is kept exactly, for drape depends on shear and hardly on stretch (Cusick, "The dependence of fabric drape on bending and
shear stiffness", J. Text. Inst. 56, 1965). Y is the geometric mean of warp and weft. An isotropic sheet of shear stiffness G
has a stretch stiffness of 4 G at most, and of 3 G at ν = 0.5; woven cloth has some hundred G. So the stretch stiffness of
wovens is not reached, which matters where they are pulled: see docs/fabrics.md.

Fabrics that are ``woven`` reach it, by the energy of :mod:`hood.energies.membrane`: ``warp`` and ``weft`` are the measured
stretch stiffnesses over that of the isotropic fabric, whose G and ν stay.

k = 4 B: on a mesh of equilateral triangles the hinge energy of a sheet bent to a cylinder is that of a plate of rigidity k/4,
in every direction. B is the mean of warp and weft.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, fields

import numpy as np

#: Of a value that is given as a tensor with a gradient.
NO_GRADIENT = (
    "its tensor requires a gradient, and a simulation passes none back to it, as hood.differentiable does; give value.detach()"
)


@dataclass(frozen=True)
class FaceField:
    """A property with one value per face: panels of different fabric, exact up to the seam."""

    values: np.ndarray  # (F,) in the order of the garment's faces


@dataclass(frozen=True)
class EdgeField:
    """A property with one value per edge: a seam's or a pleat's bending stiffness."""

    values: np.ndarray  # (E,) in the order of hood.mesh.topology.unique_edges: ascending pairs, lexicographic


#: One number for the garment, an array (V,) with one value per vertex, or a field on faces or edges. What a field lies on
#: is said, never guessed: meshes may have as many vertices as faces.
Field = float | np.ndarray | FaceField | EdgeField

#: Properties that make a fabric differ along warp and weft, in the order of ``Cloth.weave``.
WEAVE = ("warp", "weft", "shear")

#: Units of the properties that have one, as they are shown to people.
UNITS = {"density": "kg/m²", "lame_mu": "Pa", "lame_lambda": "Pa", "bending_stiffness": "J", "thickness": "m"}

#: Ranges of the paper [SI, see :data:`UNITS`]; the features are normalised by them, training samples inside them.
RANGES: dict[str, tuple[float, float]] = {
    "density": (0.0434, 0.7),
    "lame_mu": (15909.0, 63636.0),
    "lame_lambda": (3535.414, 93333.735),
    "bending_stiffness": (6.3708e-8, 1.31397e-3),
}


@dataclass(frozen=True)
class Material:
    """A fabric. Every property is one number or a :data:`Field` on vertices, faces or edges.

    Energies use a field exactly where it lies on what they sum over (faces for all but ``bending_stiffness``, edges for
    that); elsewhere it is carried over by the rules of :mod:`hood.cloth.fabric`.

    Defaults: the paper's default fabric (density 0.20022 kg/m², μ 23600 Pa, λ 44400 Pa, bending stiffness 3.9626e-5 J).
    ``friction`` is a factor, not a coefficient, for friction on the body is of two: fabrics and regions that grip or slide.
    ``warp``, ``weft`` and ``shear`` are factors on the stiffness of the isotropic fabric, see :mod:`hood.energies.membrane`: of
    a strip along the warp, of one along the weft, and against shear between the two. All 1: isotropic.

    Raises:
        ValueError: a value is not finite or not physical; names the property and the index.
    """

    density: Field = 0.20022  # kg/m²
    lame_mu: Field = 23600.0  # Pa
    lame_lambda: Field = 44400.0  # Pa
    bending_stiffness: Field = 3.9626e-5  # J (N·m), k of the dihedral energy ½ k l₀² / (4 (A₁ + A₂)) θ²
    thickness: Field = 4.7e-4  # m
    friction: Field = 1.0  # times the coefficient of the potential's friction on the body
    warp: Field = 1.0  # times the stretch stiffness of the isotropic fabric, along the warp
    weft: Field = 1.0  # the same along the weft
    shear: Field = 1.0  # times its shear stiffness, between warp and weft

    @staticmethod
    def names() -> tuple[str, ...]:
        """Names of the properties."""
        return tuple(spec.name for spec in fields(Material))

    def __post_init__(self) -> None:
        rules = {
            "density": ("> 0", lambda v: v > 0),
            "lame_mu": ("> 0", lambda v: v > 0),
            "bending_stiffness": (">= 0", lambda v: v >= 0),
            "thickness": ("> 0", lambda v: v > 0),
            "friction": (">= 0", lambda v: v >= 0),
            **dict.fromkeys(WEAVE, ("> 0", lambda v: v > 0)),
        }
        for name in self.names():
            values, place = values_of(getattr(self, name))
            rule, ok = rules.get(name, ("finite", np.isfinite))
            index = first_bad(np.isfinite(values) & ok(values))
            if index is not None:
                where = "" if values.ndim == 0 else f" at {place} {index}"
                unit = f" {UNITS[name]}" if name in UNITS else ""
                raise ValueError(f"material {name!r} is {values.flat[index]}{where}; it must be finite and {rule}{unit}")
        (lame_mu, place), (lame_lambda, other) = values_of(self.lame_mu), values_of(self.lame_lambda)
        if place == other or "" in (place, other):
            check_lame(lame_mu, lame_lambda, place or other)


def values_of(field: Field) -> tuple[np.ndarray, str]:
    """Values of a property and what they lie on: ``"vertex"``, ``"face"``, ``"edge"``, or ``""`` for one number (shape ())."""
    on = {FaceField: "face", EdgeField: "edge"}.get(type(field), "vertex")
    given = field.values if isinstance(field, (FaceField, EdgeField)) else field
    if getattr(given, "requires_grad", False):
        raise ValueError(f"material: {NO_GRADIENT}")
    values = np.asarray(given, dtype=np.float64)
    return values, on if values.ndim else ""


def check_lame(lame_mu: np.ndarray, lame_lambda: np.ndarray, place: str) -> None:
    """Refuse μ + λ <= 0, with which a membrane has no stable rest shape; arrays of one length or numbers.

    Raises:
        ValueError: names the index.
    """
    if lame_mu.ndim and lame_lambda.ndim and lame_mu.shape != lame_lambda.shape:
        return  # one of the two has the wrong length: refused where the length is known
    total = np.asarray(lame_mu + lame_lambda)
    index = first_bad(total > 0)
    if index is not None:
        where = f" at {place} {index}" if total.ndim else ""
        raise ValueError(f"material: lame_mu + lame_lambda is {total.flat[index]}{where}; it must be > 0, raise 'lame_lambda'")


def first_bad(good: np.ndarray) -> int | None:
    """Index of the first False, None without any."""
    flat = np.atleast_1d(good).reshape(-1)
    return None if flat.all() else int(np.argmin(flat))


def sample_material(
    rng: np.random.Generator,
    pos: np.ndarray | None = None,
    piecewise_fraction: float = 0.0,
    num_pieces: int = 3,
    uniform: Collection[str] = (),
) -> Material:
    """A fabric drawn log-uniformly from :data:`RANGES` (paper, section 4.3); the properties ``uniform`` are drawn uniformly.

    With probability ``piecewise_fraction`` the garment ``pos`` (V, 3) is cut into up to ``num_pieces`` parts (Voronoi cells
    of random vertices) with a fabric each; the result then holds fields of shape (V,).
    """
    if pos is None or rng.random() >= piecewise_fraction:
        return Material(**{name: _drawn(rng, name, uniform) for name in RANGES})
    pieces = int(rng.integers(2, num_pieces + 1))
    seeds = pos[rng.choice(len(pos), size=pieces, replace=False)]
    piece = np.argmin(((pos[:, None, :] - seeds[None]) ** 2).sum(-1), axis=1)
    values = {name: np.array([_drawn(rng, name, uniform) for _ in range(pieces)]) for name in RANGES}
    return Material(**{name: table[piece] for name, table in values.items()})


def _drawn(rng: np.random.Generator, name: str, uniform: Collection[str]) -> float:
    low, high = RANGES[name]
    return float(rng.uniform(low, high) if name in uniform else np.exp(rng.uniform(np.log(low), np.log(high))))


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

"""Fabrics: the material parameters of the potential, their ranges in training and their sampling."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

#: Of a value that is given as a tensor with a gradient.
NO_GRADIENT = "its tensor requires a gradient, and a simulation passes none back to it; give value.detach()"


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
    that); elsewhere it is carried over by the rules of :mod:`hood.scene.fabric`.

    Defaults: the paper's default fabric (density 0.20022 kg/m², μ 23600 Pa, λ 44400 Pa, bending stiffness 3.9626e-5 J).
    ``friction`` is a factor, not a coefficient, for friction on the body is of two: fabrics and regions that grip or slide.
    ``warp``, ``weft`` and ``shear`` are factors on the stiffness of the isotropic fabric, see :mod:`hood.losses.weave`: of a
    strip along the warp, of one along the weft, and against shear between the two. All 1: isotropic.

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
    rng: np.random.Generator, pos: np.ndarray | None = None, piecewise_fraction: float = 0.0, num_pieces: int = 3
) -> Material:
    """A fabric drawn log-uniformly from :data:`RANGES` (paper, section 4.3).

    With probability ``piecewise_fraction`` the garment ``pos`` (V, 3) is cut into up to ``num_pieces`` parts (Voronoi cells
    of random vertices) with a fabric each; the result then holds fields of shape (V,).
    """
    if pos is None or rng.random() >= piecewise_fraction:
        return Material(**{name: _log_uniform(rng, *span) for name, span in RANGES.items()})
    pieces = int(rng.integers(2, num_pieces + 1))
    seeds = pos[rng.choice(len(pos), size=pieces, replace=False)]
    piece = np.argmin(((pos[:, None, :] - seeds[None]) ** 2).sum(-1), axis=1)
    values = {name: np.array([_log_uniform(rng, *span) for _ in range(pieces)]) for name, span in RANGES.items()}
    return Material(**{name: table[piece] for name, table in values.items()})


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))

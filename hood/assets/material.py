"""Fabrics: the material parameters of the potential, their ranges in training and their sampling."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

Field = float | np.ndarray

#: Ranges of METHOD §5 [SI]; the features are normalised by them, training samples inside them.
RANGES: dict[str, tuple[float, float]] = {
    "density": (0.0434, 0.7),
    "lame_mu": (15909.0, 63636.0),
    "lame_lambda": (3535.414, 93333.735),
    "bending_stiffness": (6.3708e-8, 1.31397e-3),
}


@dataclass(frozen=True)
class Material:
    """A fabric. Every property is one number or a field of shape (V,).

    Defaults: the paper's default fabric (density 0.20022 kg/m², μ 23600 Pa, λ 44400 Pa, bending 3.9626e-5).
    """

    density: Field = 0.20022  # kg/m²
    lame_mu: Field = 23600.0  # Pa
    lame_lambda: Field = 44400.0  # Pa
    bending_stiffness: Field = 3.9626e-5  # k of the dihedral energy
    thickness: Field = 4.7e-4  # m

    @staticmethod
    def names() -> tuple[str, ...]:
        return tuple(spec.name for spec in fields(Material))

    def __post_init__(self) -> None:
        rules = {
            "density": ("> 0", lambda v: v > 0),
            "lame_mu": ("> 0", lambda v: v > 0),
            "bending_stiffness": (">= 0", lambda v: v >= 0),
            "thickness": ("> 0", lambda v: v > 0),
        }
        for name in self.names():
            values = np.atleast_1d(np.asarray(getattr(self, name), dtype=np.float64))
            rule, ok = rules.get(name, ("finite", np.isfinite))
            bad = ~(np.isfinite(values) & ok(values))
            if bad.any():
                index = int(np.argmax(bad))
                raise ValueError(f"material {name!r} is {values[index]} at index {index}; it must be finite and {rule}")
        if np.any(np.asarray(self.lame_mu) + np.asarray(self.lame_lambda) <= 0):
            raise ValueError("material: lame_mu + lame_lambda must be > 0; raise lame_lambda")


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

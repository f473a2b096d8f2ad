"""Sizes of a garment: factors of its rest shape, constant or growing during a rollout."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from hood.assets.material import NO_GRADIENT
from hood.cloth.cloth import Cloth, along_grain
from hood.mesh import geometry
from hood.mesh.flat import followed, rest_of

#: Sizes outside are no garment's.
LEAST, MOST = 0.2, 5.0

#: Rest angles within this [rad] of those of the rest shape follow it.
_AS_DRAPED = 1e-2

GarmentSize = float | Sequence[float]


@dataclass(frozen=True)
class Sizes:
    """Factors of a rest shape along its axes, from ``start`` to ``end`` within the first ``seconds`` of a rollout.

    On the way the factor is a polynomial of fifth degree whose speed and acceleration are zero at both ends: nothing jerks.

    Args:
        parts: factors by which parts of the garment were cut before (:mod:`hood.assets.garment.parts`).
        to_measure: whether the rest shape is that of the body's shape, or of the mean body whoever wears it.

    Raises:
        ValueError: a factor that is no size, or a time that is not positive.
    """

    start: tuple[float, float, float] = (1.0, 1.0, 1.0)  # factors along x, y and z in frame 0
    end: tuple[float, float, float] = (1.0, 1.0, 1.0)  # from ``seconds`` on
    seconds: float = 1.0  # that the change takes
    parts: tuple[float, ...] = ()
    to_measure: bool = True

    def __post_init__(self) -> None:
        for factor in (*self.start, *self.end, *self.parts):
            if not LEAST <= factor <= MOST:
                raise ValueError(f"size is {factor:g}; give a factor of the garment, {LEAST:g} to {MOST:g}")
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise ValueError(f"size: it changes within {self.seconds} s; give seconds > 0")

    @property
    def changing(self) -> bool:
        """Whether start and end differ."""
        return self.start != self.end

    def at(self, seconds: float) -> tuple[float, float, float]:
        """Factors along x, y and z at a time since frame 0."""
        u = min(max(seconds / self.seconds, 0.0), 1.0)
        if u == 1.0:
            return self.end
        share = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
        x, y, z = (a + share * (b - a) for a, b in zip(self.start, self.end, strict=True))
        return x, y, z


def sizes_of(size: GarmentSize, end: GarmentSize | None = None, seconds: float = 1.0) -> Sizes:
    """Sizes from numbers for all axes, or three each; ``end`` None: the size stays.

    Raises:
        ValueError: neither one number nor three, or one that is no size.
    """
    start = _three(size)
    return Sizes(start, start) if end is None else Sizes(start, _three(end), seconds)


def resized(cloth: Cloth, before: tuple[float, float, float], now: tuple[float, float, float]) -> Cloth:
    """``cloth``, whose rest shape has the factors ``before``, with the factors ``now``: the same fabric, more or less of it.

    The same topology, by the same tensors. Rest angles follow where axes grow apart.
    """
    share = torch.tensor([b / a for a, b in zip(before, now, strict=True)], dtype=torch.float64, device=cloth.rest_pos.device)
    pos, hinges = cloth.rest_pos.double() * share, cloth.hinges
    real: dict[str, Tensor] = {
        "rest_pos": pos,
        "mass": geometry.vertex_masses(pos, cloth.faces, cloth.density.double()),
        "rest_area": geometry.triangle_areas(pos, cloth.faces),
        "rest_inverse": geometry.rest_inverse(pos, cloth.faces),
        "hinge_rest_length": (pos[hinges[:, 1]] - pos[hinges[:, 0]]).norm(dim=1),
        "hinge_area": sum(geometry.triangle_areas(pos, hinges[:, [0, 1, side]]) for side in (2, 3)),  # type: ignore[dict-item]
    }
    if cloth.flat is not None:
        corners = torch.cat([torch.zeros_like(cloth.flat[:, :1]), cloth.flat], dim=1).double().cpu().numpy()
        grown = followed(corners, cloth.faces.cpu().numpy(), cloth.rest_pos.double().cpu().numpy(), pos.cpu().numpy())
        flat = torch.as_tensor(grown[:, 1:], device=pos.device)
        real |= rest_of(flat, cloth.faces, hinges, cloth.density.double(), cloth.num_vertices)
    if cloth.grain is not None:
        real["rest_inverse"] = along_grain(real["rest_inverse"], cloth.grain.double())
    if len(set(share.tolist())) > 1:
        own = geometry.dihedral_angles(cloth.rest_pos.double(), hinges)
        # A pattern stays flat, and folds keep their angles.
        follows = ((cloth.rest_angle - own).abs() < _AS_DRAPED) & (cloth.rest_angle != 0.0)
        change = torch.where(follows, geometry.dihedral_angles(pos, hinges) - own, 0.0)
        real["rest_angle"] = cloth.rest_angle.double() + change
    rounded: dict[str, Any] = {name: value.to(cloth.rest_pos.dtype) for name, value in real.items()}
    return replace(cloth, **rounded)


def _three(size: GarmentSize) -> tuple[float, float, float]:
    if any(getattr(factor, "requires_grad", False) for factor in (size if isinstance(size, (list, tuple)) else (size,))):
        raise ValueError(f"size: {NO_GRADIENT}")
    factors = [size] * 3 if isinstance(size, (int, float)) else list(size)
    if len(factors) != 3 or not all(isinstance(f, (int, float)) and not isinstance(f, bool) for f in factors):
        raise ValueError(f"size is {size}; give one factor, such as 1.1, or three along x, y and z, such as [1,1.05,1]")
    x, y, z = (float(factor) for factor in factors)
    return x, y, z

"""Doubts about fabrics: values that no cloth has, mostly those of another unit."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from hood.assets.files.doubt import Doubt
from hood.limits import BENDING_KNOWN, DENSITY_KNOWN, SHEAR_KNOWN, STRETCH_KNOWN, Range
from hood.scene.cloth import Cloth

_WAYS_OUT = {
    "density": "density is in kg/m²: 0.2 for a cloth of 200 g/m²",
    "shear stiffness": "it is thickness times lame_mu, in metres and pascals",
    "stretch stiffness": "it is thickness times (2 lame_mu + lame_lambda) times warp or weft, in metres and pascals",
    "bending stiffness": "bending_stiffness is in N·m, four times the bending rigidity: 4e-5 for a cotton shirt",
}


def doubt_fabric(cloth: Cloth, name: str) -> list[Doubt]:
    """What is doubtful about the fabric of garment ``name``: areal density [kg/m²], shear stiffness and, of
    woven cloth, stretch stiffness [N/m], bending [N·m]."""
    stretch = None
    if cloth.weave is not None:
        stretch = cloth.thickness * (2.0 * cloth.lame_mu + cloth.lame_lambda) * cloth.weave[:, :2].min(dim=1).values
    return [
        *_doubt("density", cloth.density, DENSITY_KNOWN, name),
        *_doubt("shear stiffness", cloth.thickness * cloth.lame_mu, SHEAR_KNOWN, name),
        *_doubt("stretch stiffness", stretch, STRETCH_KNOWN, name),
        *_doubt("bending stiffness", cloth.bending_stiffness, BENDING_KNOWN, name),
    ]


def _doubt(what: str, values: Tensor | None, known: Range, name: str) -> Iterator[Doubt]:
    if values is None or not values.numel():
        return
    low, high = (float(edge(values.double())) for edge in (torch.min, torch.max))
    strange = high if high > known.most else low if low < known.least else None
    if strange is None:
        return
    yield Doubt(
        "fabric",
        f"garment {name!r}: its {what} is {strange:.3g} {known.unit}, cloth has {known.least:g} to {known.most:g} "
        f"({known.reason}); {_WAYS_OUT[what]}",
        (),
        strange,
        known.unit,
    )

"""A garment that was cut and drawn apart is told from garments of their own."""

from __future__ import annotations

import numpy as np
import pytest
from garment_kinds import Mesh, clean, halves, joined, normals, part

from hood.assets.contents.garments import Gap, find_gaps
from hood.mesh.parts import find_parts


def cut(name: str, axis: int, at: float, gap: float) -> Mesh:
    """What lies beyond ``at`` [m] along the axis is moved ``gap`` [m] away from the rest."""
    mesh = clean(name)
    beyond = (mesh[0][mesh[1]].mean(axis=1)[:, axis] - at) * np.sign(at) > 0
    off, faces = part(mesh, beyond)
    return joined(part(mesh, ~beyond), (off + gap * np.sign(at) * np.eye(3)[axis], faces))


def gaps(mesh: Mesh) -> list[Gap]:
    return find_gaps(*mesh, find_parts(*mesh))


@pytest.mark.parametrize("gap", [0.003, 0.015, 0.045])
@pytest.mark.parametrize(
    ("name", "axis", "at"),
    [("longsleeve", 0, 0.24), ("longsleeve", 0, -0.35), ("tshirt", 0, -0.2), ("dress", 1, -0.2), ("skirt", 1, -0.1)],
)
def test_the_gap_of_a_cut_is_found(name: str, axis: int, at: float, gap: float) -> None:
    (found,) = gaps(cut(name, axis, at, gap))
    assert found.parts == (0, 1)
    assert (found.middle, found.widest) == pytest.approx((gap, gap))


def test_a_wide_gap_is_none() -> None:
    assert gaps(cut("longsleeve", 0, 0.24, 0.08)) == []


def lining(name: str, within: float) -> Mesh:
    pos, faces = clean(name)
    return joined((pos, faces), (pos - within * normals(pos, faces), faces))


def over(first: str, second: str, overlap: float) -> Mesh:
    """The first ends ``overlap`` [m] below where the second begins, both cut level and as wide there as each other."""
    upper, lower = clean(first), clean(second)
    top = lower[0][:, 1].max()
    ends = upper[0][upper[1]].mean(axis=1)[:, 1] > top - overlap
    return joined(part(upper, ends), lower)


ITS_OWN = {
    "tank and skirt": lambda: joined(clean("tank"), clean("skirt")),
    "shirt and shorts": lambda: joined(clean("tshirt"), clean("shorts")),
    "long shirt and trousers": lambda: joined(clean("longsleeve"), clean("trousers")),
    "a hem over a waistband": lambda: over("tank", "skirt", 0.02),
    "a lining": lambda: lining("tank", 0.02),
    "a lining of a dress": lambda: lining("dress", 0.03),
    "the same shirt twice": lambda: joined(clean("tshirt"), (clean("tshirt")[0] + [0.0, 0.01, 0.0], clean("tshirt")[1])),
    "front and back": lambda: joined(*halves(clean("tank"), 0.02)),
}


@pytest.mark.parametrize("name", ITS_OWN)
def test_garments_near_each_other_have_none(name: str) -> None:
    mesh = ITS_OWN[name]()
    assert len(find_parts(*mesh)) == 2
    assert gaps(mesh) == []

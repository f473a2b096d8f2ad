"""Parts of the cloth that can be shown and hidden one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hood.media.pieces import hideable_parts, pieces_of
from hood.rollouts.file.reader import RolloutData


def outfit() -> RolloutData:
    """Six triangles that share no vertex: three of a tank, three of a skirt."""
    faces, none = np.arange(18).reshape(6, 3), np.zeros((1, 0, 3))
    pos = np.random.default_rng(0).normal(size=(1, 18, 3))
    still = {"piece": np.repeat([0, 1], 9)}
    told = {"garment": "tank+skirt", "fabric_names": "silk+denim"}
    return RolloutData(pos, faces, pos[0], none, np.zeros((0, 3), dtype=np.int64), np.zeros(1), {}, told, {}, [], still)


def test_parts_are_garments() -> None:
    data = outfit()
    names, part = hideable_parts(data, pieces_of(data))
    assert names == ["tank", "skirt"]
    assert part.tolist() == [0, 0, 0, 1, 1, 1]


def test_fabrics_of_one_garment_and_what_rides_on_it_are_parts() -> None:
    """The skirt is of two fabrics, and its last face a button."""
    data = outfit()
    fabric = np.repeat([0, 0, 0, 0, 1, 1], 3)
    told = data.attributes | {"riding_vertices": 3, "riding_faces": 1}
    data = replace(data, still=data.still | {"fabric": fabric}, attributes=told)
    names, part = hideable_parts(data, pieces_of(data))
    assert names == ["tank", "skirt, silk", "skirt, denim", "skirt, denim, pockets and buttons"]
    assert part.tolist() == [0, 0, 0, 1, 2, 3]


def test_an_older_file_is_one_part() -> None:
    data = replace(outfit(), still={}, attributes={})
    names, part = hideable_parts(data, pieces_of(data))
    assert names == ["cloth"]
    assert not part.any()

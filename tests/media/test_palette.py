"""Garments of an outfit have colours of their own, fabrics look like themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hood.app.settings.compose import options
from hood.cli.main import main
from hood.media.exports.sequences import clip_of
from hood.media.film import Film
from hood.media.pieces import LOOKS, FabricLook, looks_of, outfit_ranks, part_colour
from hood.media.renderer.render import GARMENT_COLOR
from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.testing import grid


def test_one_garment_is_one() -> None:
    faces = grid(3, 3, 1.0)[1]
    assert not outfit_ranks("shirt", np.concatenate([faces, faces + 9]), 18).any()
    assert part_colour(0) == GARMENT_COLOR


def test_garments_of_an_outfit_differ() -> None:
    """Three sheets one after another, a vertex of no face between the first two."""
    faces = grid(3, 3, 1.0)[1]
    ranks = outfit_ranks("a+b+c", np.concatenate([faces, faces + 10, faces + 19]), 28)
    assert [np.unique(part).tolist() for part in (ranks[:9], ranks[10:19], ranks[19:])] == [[0], [1], [2]]
    assert len({part_colour(rank) for rank in range(3)}) == 3


def test_the_recorded_garment_decides_over_the_components() -> None:
    """One garment of two sheets, and one of one."""
    faces = grid(3, 3, 1.0)[1]
    ranks = outfit_ranks("a+b", np.concatenate([faces, faces + 9, faces + 18]), 27, np.repeat([0, 0, 1], 9))
    np.testing.assert_array_equal(ranks, np.repeat([0, 1], [18, 9]))


def data_of(names: list[str], fabric: np.ndarray | None = None, piece: np.ndarray | None = None) -> RolloutData:
    """Two sheets side by side."""
    pos, faces = grid(3, 3, 1.0)
    both = np.concatenate([pos, pos + [3.0, 0.0, 0.0]]).astype(np.float32)
    still = {name: table for name, table in (("fabric", fabric), ("piece", piece)) if table is not None}
    attributes = {"garment": "a+b" if piece is not None else "a", "fabric_names": "+".join(names), "dt": 0.1}
    empty = np.zeros((1, 0, 3), np.float32)
    faces = np.concatenate([faces, faces + 9])
    return RolloutData(both[None], faces, both, empty, np.zeros((0, 3), int), np.zeros(1), {}, attributes, still=still)


def test_every_fabric_that_comes_with_the_library_has_a_look() -> None:
    assert {*LOOKS} == {*options("material")} - {"default"}


def test_a_fabric_looks_like_itself_and_others_as_before() -> None:
    looks, number = looks_of(data_of(["silk"]))
    assert looks == [LOOKS["silk"]]
    assert not number.any()
    assert looks_of(data_of([""]))[0] == [FabricLook()]


def test_parts_have_the_look_of_their_fabric() -> None:
    data = data_of(["denim", "silk"], np.repeat([1, 0], 9))
    looks, number = looks_of(data)
    assert [looks[one] for one in number[[0, 17]]] == [LOOKS["silk"], LOOKS["denim"]]
    part = clip_of(data).parts[0]
    assert (part.colour, part.roughness) in {(look.colour, look.roughness) for look in (LOOKS["silk"], LOOKS["denim"])}
    assert LOOKS["silk"].roughness < LOOKS["denim"].roughness


def test_garments_of_one_fabric_are_told_apart() -> None:
    looks, number = looks_of(data_of(["denim"], piece=np.repeat([0, 1], 9)))
    assert looks[number[0]] == LOOKS["denim"]
    assert looks[number[17]].colour != LOOKS["denim"].colour


def test_a_rollout_says_what_its_fabrics_are(tmp_path: Path) -> None:
    """By the names of the options, one of which has a value of its own."""
    cheap = "garment=tank num_frames=1 metrics=none guard=off stepper=guess settle=0 video=none sheet=false".split()
    words = ["material=silk", "material.density=0.07", "fabrics={above_spine2:denim}"]
    assert main(["rollout", *cheap, *words, f"output={tmp_path}"]) == 0
    data = read_rollout(tmp_path / "rollout.h5")
    assert data.attributes["fabric_names"] == "silk+denim"
    high = data.rest_pos[:, 1] > np.quantile(data.rest_pos[:, 1], 0.9)
    assert (data.still["fabric"][high] == 1).all()
    assert not data.still["fabric"].all()
    assert Film(data, 80, 112).frame(0).std() > 10

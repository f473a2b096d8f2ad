"""Rows of fasteners on a garment of one's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hood.assets.fitting.alterations import clean, sew
from hood.assets.garment.fasteners import ROOM, fasten, with_room
from hood.assets.garment.garment import Garment, load_garment, save_garment
from hood.assets.garment.outfit import join_garments
from hood.assets.garment.record import start_fitting
from hood.testing import grid
from hood.training.scenes import mirror_garment


def halves(gap: float = 0.0) -> Garment:
    """Two sheets side by side, as the front of a shirt, 5 rows of 3 vertices each: left of x = 0 one, right of it the other."""
    pos, faces = grid(5, 3, 1.0)
    flat = np.stack([0.1 * pos[:, 2] + gap / 2, 0.2 * pos[:, 0], np.ones(15)], axis=1)
    other = flat * [-1.0, 1.0, 1.0]
    back = np.array([[0.0, 0.0, -1.0], [0.1, 0.0, -1.0], [0.0, 0.1, -1.0]])
    rest = np.concatenate([flat - [flat[:, 0].min() - gap / 2, 0, 0], other - [other[:, 0].max() + gap / 2, 0, 0], back])
    every = np.concatenate([faces, faces[:, ::-1] + 15, [[30, 31, 32]]])
    return Garment("halves", rest, every, np.zeros(33, dtype=bool))


def rim(garment: Garment, first: int) -> np.ndarray:
    """Vertices of a half on the middle, from the top down."""
    numbers = np.arange(first, first + 15)
    inner = numbers[np.abs(garment.rest_pos[numbers, 0]) < 0.011]
    return inner[np.argsort(-garment.rest_pos[inner, 1])]


@pytest.mark.parametrize("gap", [0.0, 0.02])
def test_edges_beside_the_middle_are_paired_between_two_heights(gap: float) -> None:
    garment = halves(gap)
    left, right = rim(garment, 0), rim(garment, 15)
    heights = garment.rest_pos[left, 1]
    made, edges = fasten(garment, {"zip": {"heights": [float(heights.min()), float(heights.max())]}})
    np.testing.assert_array_equal(made.fasteners["zip"], np.stack([left, right], axis=1))
    np.testing.assert_array_equal(edges, made.fasteners["zip"])
    fewer, edges = fasten(garment, {"zip": {"heights": [float(heights[3]), float(heights[0])], "every": 2}})
    np.testing.assert_array_equal(fewer.fasteners["zip"], np.stack([left, right], axis=1)[:4:2])
    assert len(edges) == 4


def test_lists_are_paired_in_their_order_and_colours_by_distance(tmp_path: Path) -> None:
    garment = halves(0.02)
    left, right = rim(garment, 0), rim(garment, 15)
    (tmp_path / "right.txt").write_text(" ".join(map(str, right)))
    made, _ = fasten(garment, {"seam": {"left": left.tolist(), "right": str(tmp_path / "right.txt")}})
    np.testing.assert_array_equal(made.fasteners["seam"], np.stack([left, right], axis=1))
    colours = np.full((33, 3), 0.5)
    colours[left], colours[right] = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    made, _ = fasten(replace(garment, colours=colours), {"seam": {"painted": ["red", "green"]}})
    np.testing.assert_array_equal(made.fasteners["seam"], np.stack([left, right], axis=1))


def test_edges_on_each_other_stay_two_where_they_are_fastened_and_get_room() -> None:
    garment = halves(0.0)
    left = rim(garment, 0)
    fitting = start_fitting(garment)
    fitting.garment, edges = fasten(garment, {"zip": {"heights": [-1.0, 1.0], "every": 2}})
    sew(fitting, None, edges)
    clean(fitting)
    assert len(fitting.garment.rest_pos) == 33
    apart, moved = with_room(fitting.garment, edges)
    assert moved == 10
    gaps = np.linalg.norm(apart.rest_pos[edges[:, 0]] - apart.rest_pos[edges[:, 1]], axis=1)
    np.testing.assert_allclose(gaps, ROOM)
    assert (apart.rest_pos[left, 0] > 0).all()
    assert with_room(apart, edges) == (apart, 0)
    bare = start_fitting(garment)
    sew(bare, None)
    assert len(bare.garment.rest_pos) == 28


def test_rows_follow_their_vertices() -> None:
    garment = halves(0.02)
    rows = {"zip": np.stack([rim(garment, 0), rim(garment, 15)], axis=1)}
    unused = np.concatenate([[[9.0, 9.0, 9.0]], garment.rest_pos])
    shifted = replace(
        garment,
        rest_pos=unused,
        faces=garment.faces + 1,
        pinned=np.zeros(34, bool),
        fasteners={"zip": rows["zip"] + 1, "lost": np.array([[0, 4]])},
    )
    fitting = start_fitting(shifted)
    clean(fitting)
    assert list(fitting.garment.fasteners) == ["zip"]
    np.testing.assert_array_equal(fitting.garment.fasteners["zip"], rows["zip"])
    given = replace(garment, fasteners=rows)
    outfit = join_garments([given, halves(0.0), given])
    assert sorted(outfit.fasteners) == ["zip", "zip_2"]
    np.testing.assert_array_equal(outfit.fasteners["zip_2"], rows["zip"] + 66)
    assert join_garments([halves(), halves()]).fasteners is None
    assert mirror_garment(given).fasteners is rows


def test_rows_are_kept_in_files(tmp_path: Path) -> None:
    garment = halves(0.02)
    rows = {"zip": np.array([[0, 15]]), "front_buttons": np.array([[1, 16], [2, 17]])}
    save_garment(tmp_path / "halves.npz", replace(garment, fasteners=rows))
    back = load_garment(tmp_path / "halves.npz").fasteners
    assert back is not None
    assert sorted(back) == sorted(rows)
    for name, pairs in rows.items():
        np.testing.assert_array_equal(back[name], pairs)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([[0, 33]], r"pair 0 of fastener 'zip' is \[0, 33\]; give two different vertices below 33"),
        ([[0, 1], [4, 4]], r"pair 1 of fastener 'zip' is \[4, 4\]"),
        (np.zeros((0, 2), int), "fastener 'zip' has no pairs"),
        ([[0, 1, 2]], r"fastener_zip has shape \(1, 3\); fasteners are pairs of vertices"),
    ],
)
def test_broken_rows_of_a_file_are_refused(tmp_path: Path, pairs: Any, message: str) -> None:
    save_garment(tmp_path / "halves.npz", replace(halves(), fasteners={"zip": np.asarray(pairs)}))
    with pytest.raises(ValueError, match=message):
        load_garment(tmp_path / "halves.npz")


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (3, "fasten: zip is 3; give"),
        ({}, "zip names its sides in 0 ways"),
        ({"heights": [0, 1], "left": [1], "right": [2]}, "in 2 ways"),
        ({"high": 3}, "unknown key 'high'"),
        ({"heights": [1, 0]}, r"heights is \[1, 0\]; give the lower and the upper"),
        ({"heights": [3, 4]}, "between 3 and 4 m the garment has no edges left and right.*from 0.00 to 0.20 m"),
        ({"heights": [-1, 1], "every": 0}, "every is 0; give a whole number"),
        ({"left": [1, 2], "right": [3]}, "2 vertices left and 1 right"),
        ({"left": [1], "right": [33]}, r"right\[0\] is vertex 33 of 33"),
        ({"left": [1], "right": [1]}, "pair 0 is vertex 1 twice"),
        ({"left": [1]}, "right is None; give vertex numbers"),
        ({"painted": ["red", "pink"]}, "give two of red, green, blue"),
        ({"painted": ["red", "green"]}, "no vertex colours"),
    ],
)
def test_what_names_no_pairs_says_what_to_give(asked: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fasten(halves(0.02), {"zip": asked})

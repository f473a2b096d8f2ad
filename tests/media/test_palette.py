"""Garments of an outfit have colours of their own."""

from __future__ import annotations

import numpy as np

from hood.media.pieces import outfit_colours
from hood.media.renderer.render import GARMENT_COLOR
from hood.testing import grid


def test_one_garment_has_one_colour() -> None:
    faces = grid(3, 3, 1.0)[1]
    assert outfit_colours("shirt", np.concatenate([faces, faces + 9]), 18) == GARMENT_COLOR


def test_garments_of_an_outfit_differ() -> None:
    """Three sheets one after another, a vertex of no face between the first two."""
    faces = grid(3, 3, 1.0)[1]
    colours = np.asarray(outfit_colours("a+b+c", np.concatenate([faces, faces + 10, faces + 19]), 28))
    assert colours.shape == (28, 3)
    sheets = [colours[:9], colours[10:19], colours[19:]]
    assert [len(np.unique(sheet, axis=0)) for sheet in sheets] == [1, 1, 1]
    np.testing.assert_array_equal(sheets[0][0], GARMENT_COLOR)
    assert len(np.unique(np.stack([sheet[0] for sheet in sheets]), axis=0)) == 3
    assert ((colours >= 0) & (colours <= 1)).all()


def test_the_recorded_garment_decides_over_the_components() -> None:
    """One garment of two sheets, and one of one."""
    faces = grid(3, 3, 1.0)[1]
    piece = np.repeat([0, 0, 1], 9)
    colours = np.asarray(outfit_colours("a+b", np.concatenate([faces, faces + 9, faces + 18]), 27, piece))
    assert len(np.unique(colours[:18], axis=0)) == len(np.unique(colours[18:], axis=0)) == 1
    np.testing.assert_array_equal(colours[0], GARMENT_COLOR)
    assert not np.array_equal(colours[0], colours[18])

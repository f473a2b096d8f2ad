"""Hierarchies from given edge lists."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.mesh.topology import unique_edges
from hood.model.graph.hierarchy import build_hierarchy
from hood.model.graph.known_hierarchies import given_hierarchy
from hood.testing import grid


def test_shuffled_turned_and_repeated_lists_give_the_hierarchy_they_came_from() -> None:
    pos, faces = grid(12, 12)
    built = build_hierarchy(len(pos), unique_edges(faces), pos, 3)
    rng = np.random.default_rng(0)
    tables = [table.numpy() for table in built.coarse_edges]
    lists = [np.concatenate([t[rng.permutation(len(t))][:, ::-1], t[:2]]) for t in tables]
    for given in (lists, dict(enumerate(lists)), {5: {2: lists[2], 0: lists[0], 1: lists[1]}, 9: {0: lists[0]}}):
        found = given_hierarchy(len(pos), given)
        assert torch.equal(found.node_level, built.node_level)
        for mine, table in zip(found.coarse_edges, built.coarse_edges, strict=True):
            assert torch.equal(mine, table)
    two = given_hierarchy(len(pos), lists, num_coarse=2)
    assert len(two.coarse_edges) == 2
    assert int(two.node_level.max()) == 2


@pytest.mark.parametrize(
    "levels, num_coarse, words",
    [
        ([[[0, 1]]], 2, "1 levels are given and 2 needed"),
        ([[[0, 1], [2, 9]]], 1, r"edge 1 of level 1 is \[2, 9\]"),
        ([[[0, 1]], [[0, 2]]], 2, "vertex 2 has an edge on level 2 and none on level 1"),
    ],
)
def test_lists_that_do_not_fit_are_refused(levels: list, num_coarse: int, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        given_hierarchy(4, levels, num_coarse)

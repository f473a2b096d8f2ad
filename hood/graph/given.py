"""A hierarchy from edge lists that came with a garment, instead of one built here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from hood.graph.hierarchy import Hierarchy

Levels = Mapping[int, Any] | Sequence[ArrayLike]


def given_hierarchy(num_vertices: int, coarse_edges: Levels, num_coarse: int | None = None) -> Hierarchy:
    """The hierarchy with the given coarse edges.

    Edges may be listed in any order and direction and more than once.

    Args:
        num_vertices: V of the garment.
        coarse_edges: edges (E, 2) of c_0, c_1, … as a list or by ascending level; or such levels by graph centre, as
            garment files of the reference implementation hold them, of which the first centre is taken.
        num_coarse: levels to take, the finest first; None for all.

    Raises:
        ValueError: fewer levels than asked for, an index outside the garment, or levels that are not nested.
    """
    levels = _levels(coarse_edges)
    wanted = len(levels) if num_coarse is None else num_coarse
    if len(levels) < wanted:
        raise ValueError(f"coarse edges: {len(levels)} levels are given and {wanted} needed; compute more for this garment")
    node_level = np.zeros(num_vertices, dtype=np.int64)
    tables = []
    for level, edges in enumerate(levels[:wanted], start=1):
        table = _edge_table(edges, num_vertices, level)
        nodes = np.unique(table)
        if (node_level[nodes] < level - 1).any():
            vertex = int(nodes[np.argmax(node_level[nodes] < level - 1)])
            raise ValueError(
                f"coarse edges: vertex {vertex} has an edge on level {level} and none on level {level - 1}; nest them"
            )
        node_level[nodes] = level
        tables.append(torch.as_tensor(table))
    return Hierarchy(tuple(tables), torch.as_tensor(node_level))


def _levels(coarse_edges: Levels) -> list[np.ndarray]:
    if not isinstance(coarse_edges, Mapping):
        return [np.asarray(edges) for edges in coarse_edges]
    entries: list[Any] = [coarse_edges[key] for key in sorted(coarse_edges)]
    return _levels(entries[0] if entries and isinstance(entries[0], Mapping) else entries)


def _edge_table(edges: np.ndarray, num_vertices: int, level: int) -> np.ndarray:
    """(E, 2) int64, unique, lower index first, ascending."""
    table = np.sort(edges.astype(np.int64).reshape(-1, 2), axis=1)
    outside = (table < 0) | (table >= num_vertices)
    if outside.any():
        row = int(np.argmax(outside.any(axis=1)))
        raise ValueError(
            f"coarse edges: edge {row} of level {level} is {table[row].tolist()} but there are vertices 0…{num_vertices - 1}; "
            "the list is of another garment"
        )
    return np.unique(table[table[:, 0] != table[:, 1]], axis=0)

"""The nested levels of a garment's graph, built once per topology (paper, section 4.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from hood.graph import coarsen


@dataclass(frozen=True)
class Hierarchy:
    """Coarse edges of one garment or of a flat batch. Level 0 is the mesh; the set c_k is level k + 1 and one of its
    edges spans up to 2^(k+1) mesh hops. Levels are nested: the nodes of c_{k+1} are among those of c_k.
    """

    coarse_edges: tuple[Tensor, ...]  # each (E_k, 2) undirected, unique, lower index first, ascending
    node_level: Tensor  # (V,) deepest level in which the vertex has an edge, 0 = mesh only

    @property
    def num_vertices(self) -> int:
        return self.node_level.shape[0]


def num_passed_over(mean_edge: float, coarse_edge: float | None) -> int:
    """Levels of a mesh that the first coarse one leaves out, so that its edges are about ``coarse_edge`` [m] long or longer.

    Args:
        mean_edge: m, mean edge of the mesh at rest; a level's edges are about twice as long as those of the one before.
        coarse_edge: None: no level is left out.
    """
    if coarse_edge is None or not mean_edge > 0.0:
        return 0
    return max(math.ceil(math.log2(coarse_edge / (2.0 * mean_edge)) - 1e-6), 0)


def build_hierarchy(
    num_vertices: int, edges: np.ndarray, rest_pos: np.ndarray, num_coarse: int, passed_over: int = 0
) -> Hierarchy:
    """Coarse levels of a mesh graph.

    The root of a component is one of its centres (least eccentricity, exact) and serves all levels. Ties between
    centres and the order in which edges are visited follow the rest positions: vertices are ranked by x, then y, then
    z. Relabelling the mesh therefore gives the same graph; only vertices that coincide at rest fall back on their order
    in the file. Components of one or two vertices and levels that have run out of edges give empty sets.

    Args:
        num_vertices: V; vertices without an edge are allowed and stay on level 0.
        edges: (E, 2) undirected mesh edges.
        rest_pos: (V, 3) rest positions, read for their order alone.
        num_coarse: number of coarse levels, ≥ 0.
        passed_over: levels between the mesh and the first coarse one that are made and left out (:func:`num_passed_over`):
            an edge of c_k then spans up to 2^(k + 1 + passed_over) mesh hops.
    """
    edges, rest_pos = np.asarray(edges, dtype=np.int64).reshape(-1, 2), np.asarray(rest_pos)
    _check(num_vertices, edges, rest_pos, num_coarse)
    order = np.lexsort(rest_pos.T[::-1])  # the last key is the primary one
    rank = np.empty_like(order)
    rank[order] = np.arange(num_vertices)

    graph = coarsen.adjacency(num_vertices, rank[edges])
    roots = coarsen.centres(graph) if num_coarse and graph.nnz else np.zeros(0, dtype=np.int64)
    level_edges, node_level = [], np.zeros(num_vertices, dtype=np.int64)
    for _ in range(passed_over if num_coarse else 0):
        graph = coarsen.coarsen(graph, roots)
    for level in range(1, num_coarse + 1):
        graph = coarsen.coarsen(graph, roots)
        level_edges.append(_edge_list(graph, order))
        node_level[np.unique(level_edges[-1])] = level
    return Hierarchy(tuple(torch.as_tensor(e) for e in level_edges), torch.as_tensor(node_level))


def concatenate_hierarchies(hierarchies: Sequence[Hierarchy], vertex_counts: Sequence[int]) -> Hierarchy:
    """One hierarchy of a flat batch; item *i* has ``vertex_counts[i]`` vertices. Missing deeper levels are empty."""
    depth = max(len(h.coarse_edges) for h in hierarchies)
    offsets = np.concatenate([[0], np.cumsum(vertex_counts)[:-1]]).tolist()
    levels = [
        torch.cat([h.coarse_edges[k] + o for h, o in zip(hierarchies, offsets, strict=True) if k < len(h.coarse_edges)])
        for k in range(depth)
    ]
    return Hierarchy(tuple(levels), torch.cat([h.node_level for h in hierarchies]))


def _edge_list(graph: sparse.csr_matrix, order: np.ndarray) -> np.ndarray:
    coo = graph.tocoo()
    edges = order[np.stack([coo.row, coo.col], axis=1)]
    edges = edges[edges[:, 0] < edges[:, 1]]
    return edges[np.lexsort((edges[:, 1], edges[:, 0]))]


def _check(num_vertices: int, edges: np.ndarray, rest_pos: np.ndarray, num_coarse: int) -> None:
    if rest_pos.shape != (num_vertices, 3):
        raise ValueError(f"hierarchy: rest_pos has shape {rest_pos.shape}; it must be ({num_vertices}, 3)")
    if not np.isfinite(rest_pos).all():
        row = int(np.argmin(np.isfinite(rest_pos).all(axis=1)))
        raise ValueError(f"hierarchy: rest position of vertex {row} is not finite; repair the mesh first")
    outside = (edges < 0) | (edges >= num_vertices)
    if outside.any():
        row = int(np.argmax(outside.any(axis=1)))
        raise ValueError(f"hierarchy: edge {row} is {edges[row].tolist()} but there are vertices 0…{num_vertices - 1}")
    if num_coarse < 0:
        raise ValueError(f"hierarchy: num_coarse is {num_coarse}; give 0 or more coarse levels")

"""The nested levels of a garment's graph, built once per topology (paper, section 4.2).

Coarsening of one graph level by breadth-first parity (paper, section 4.2), on scipy sparse matrices.

Everything here works in the order of the vertex numbers it is given and breaks every tie by the lowest number;
``hierarchy.py`` numbers vertices by rest position first, which is what makes the result independent of file order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor


def adjacency(num_nodes: int, edges: np.ndarray) -> sparse.csr_matrix:
    """Symmetric 0/1 adjacency matrix (N, N) of undirected ``edges`` (E, 2); self-loops and repeats are dropped."""
    edges = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
    edges = edges[edges[:, 0] != edges[:, 1]]
    rows, cols = np.concatenate([edges, edges[:, ::-1]]).T
    return _pattern(sparse.csr_matrix((np.ones(len(rows), np.int32), (rows, cols)), shape=(num_nodes, num_nodes)))


def distances(graph: sparse.csr_matrix, roots: np.ndarray | int) -> np.ndarray:
    """Hop distance (N,) to the nearest of ``roots``; −1 where none is reachable. One sweep, level by level."""
    dist = np.full(graph.shape[0], -1, dtype=np.int64)
    front = np.atleast_1d(np.asarray(roots, dtype=np.int64))
    dist[front] = 0
    hops = 0
    while len(front):
        hops += 1
        reached = _neighbours(graph, front)
        front = np.unique(reached[dist[reached] < 0])
        dist[front] = hops
    return dist


def centre(graph: sparse.csr_matrix, nodes: np.ndarray) -> int:
    """A vertex of least eccentricity of the connected component ``nodes`` (sorted), exact.

    Eccentricity bounds (Takes and Kosters 2013): a sweep from v gives ecc(v) and, for every w at distance d,
    max(ecc(v) − d, d) ≤ ecc(w) ≤ ecc(v) + d. Sweeps alternate between far vertices, which raise the lower bounds, and
    vertices of least lower bound, the candidates. The first candidate whose eccentricity meets the least lower bound
    of all is a centre: typically after 10–30 sweeps instead of one per vertex.
    """
    local = graph[nodes][:, nodes]
    lower = np.zeros(len(nodes), dtype=np.int64)
    total = np.zeros(len(nodes), dtype=np.int64)
    swept = np.zeros(len(nodes), dtype=bool)
    best, best_ecc = 0, len(nodes) + 1
    candidate = 0
    while best_ecc > lower.min():
        dist = distances(local, candidate)
        ecc = int(dist.max())
        swept[candidate] = True
        if ecc < best_ecc:
            best, best_ecc = candidate, ecc
        lower = np.maximum(lower, np.maximum(ecc - dist, dist))
        lower[candidate] = ecc
        total += dist
        far = int(np.argmax(np.where(dist == ecc, np.where(swept, -1, total), -2)))
        if not swept[far]:  # the end of this sweep bounds the candidate's whole neighbourhood from below
            far_dist = distances(local, far)
            far_ecc = int(far_dist.max())
            swept[far] = True
            if far_ecc < best_ecc:
                best, best_ecc = far, far_ecc
            lower = np.maximum(lower, np.maximum(far_ecc - far_dist, far_dist))
            lower[far] = far_ecc
            total += far_dist
        least = lower.min()
        candidate = int(np.argmin(np.where((lower == least) & ~swept, total, np.iinfo(np.int64).max)))
    return int(nodes[best])


def centres(graph: sparse.csr_matrix) -> np.ndarray:
    """One centre per connected component that has an edge; components in the order of their lowest vertex."""
    count, label = csgraph.connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])
    return np.array([centre(graph, nodes) for nodes in groups if len(nodes) > 1], dtype=np.int64)


def coarsen(graph: sparse.csr_matrix, roots: np.ndarray) -> sparse.csr_matrix:
    """The next coarser level (same vertex numbers) of ``graph`` (N, N), from BFS parity around ``roots``.

    Vertices at even distance d stay. New edges (1) join every d − 1 neighbour of an odd vertex to every d + 1
    neighbour; (2) join the d − 1 neighbours of an odd vertex without d + 1 neighbours pairwise, where the graph of (1)
    leaves them more than 2 hops apart; (3) join adjacent even vertices that the graph so far leaves more than 2 hops
    apart. (3) visits pairs in ascending order and counts the edges it has added itself; (2) looks at (1) alone.
    """
    dist = distances(graph, roots)
    odd = np.flatnonzero(dist % 2 == 1)  # unreachable vertices (−1 % 2 == 1 in numpy) have no neighbours on any level
    incident = graph[odd].tocoo()
    ring = dist[odd][incident.row]
    inner = _select(incident, dist[incident.col] == ring - 1)
    outer = _select(incident, dist[incident.col] == ring + 1)
    through = inner.T @ outer
    first = _pattern(through + through.T)

    leaf = np.asarray(outer.sum(axis=1)).ravel() == 0
    pairs = inner[leaf].T @ inner[leaf]
    second = _pattern(first + _far_pairs(_pattern(pairs), first))

    coo = graph.tocoo()
    same = (dist[coo.row] == dist[coo.col]) & (dist[coo.row] % 2 == 0) & (dist[coo.row] >= 0)
    return _join_in_order(second, _far_pairs(_select(coo, same), second))


def _join_in_order(graph: sparse.csr_matrix, pairs: sparse.csr_matrix) -> sparse.csr_matrix:
    """Add ``pairs`` one by one in ascending order, skipping those that earlier additions brought within 2 hops."""
    upper = sparse.triu(pairs).tocoo()
    order = np.lexsort((upper.col, upper.row))
    candidates = list(zip(upper.row[order].tolist(), upper.col[order].tolist(), strict=True))
    base, added = graph, []
    near = {
        node: set(graph.indices[graph.indptr[node] : graph.indptr[node + 1]].tolist())
        for node in {node for pair in candidates for node in pair}
    }
    for a, b in candidates:
        if b not in near[a] and near[a].isdisjoint(near[b]):
            near[a].add(b)
            near[b].add(a)
            added.append((a, b))
    return _pattern(base + adjacency(graph.shape[0], np.array(added, dtype=np.int64)))


def _far_pairs(pairs: sparse.csr_matrix, graph: sparse.csr_matrix) -> sparse.csr_matrix:
    """Entries of ``pairs`` off the diagonal whose distance in ``graph`` exceeds 2 (or is infinite)."""
    coo = pairs.tocoo()
    keep = coo.row != coo.col
    rows, cols = coo.row[keep], coo.col[keep]
    ends, local = np.unique(rows, return_inverse=True)
    one = graph[ends]
    within = one + one @ graph  # walks of one and two hops, in the rows that are asked about only
    near = np.asarray(within[local, cols]).ravel() > 0 if len(rows) else np.zeros(0, dtype=bool)
    return sparse.csr_matrix((np.ones((~near).sum(), np.int32), (rows[~near], cols[~near])), shape=pairs.shape)


def _select(coo: sparse.coo_matrix, keep: np.ndarray) -> sparse.csr_matrix:
    return sparse.csr_matrix((coo.data[keep], (coo.row[keep], coo.col[keep])), shape=coo.shape)


def _pattern(matrix: sparse.spmatrix) -> sparse.csr_matrix:
    """0/1 matrix of the non-zeros off the diagonal, indices sorted."""
    coo = sparse.coo_matrix(matrix)
    coo.sum_duplicates()
    keep = (coo.row != coo.col) & (coo.data != 0)
    ones = np.ones(int(keep.sum()), np.int32)
    result = sparse.csr_matrix((ones, (coo.row[keep], coo.col[keep])), shape=coo.shape)
    result.sort_indices()
    return result


def _neighbours(graph: sparse.csr_matrix, nodes: np.ndarray) -> np.ndarray:
    """All neighbours of ``nodes``, with repeats."""
    start, stop = graph.indptr[nodes], graph.indptr[nodes + 1]
    length = stop - start
    offset = np.repeat(start - np.concatenate([[0], np.cumsum(length)[:-1]]), length)
    return graph.indices[np.arange(length.sum()) + offset].astype(np.int64)


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

    graph = adjacency(num_vertices, rank[edges])
    roots = centres(graph) if num_coarse and graph.nnz else np.zeros(0, dtype=np.int64)
    level_edges, node_level = [], np.zeros(num_vertices, dtype=np.int64)
    for _ in range(passed_over if num_coarse else 0):
        graph = coarsen(graph, roots)
    for level in range(1, num_coarse + 1):
        graph = coarsen(graph, roots)
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

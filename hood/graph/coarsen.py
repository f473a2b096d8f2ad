"""Coarsening of one graph level by breadth-first parity (paper, section 4.2), on scipy sparse matrices.

Everything here works in the order of the vertex numbers it is given and breaks every tie by the lowest number;
``hierarchy.py`` numbers vertices by rest position first, which is what makes the result independent of file order.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph


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

"""Hierarchies that are known already: those of a process's last garments in memory, large ones on disk.

A large garment's levels are computed once per user, not once per process. An entry on disk is named by the SHA-256 of
everything that the result depends on, so there is nothing to invalidate. Entries that cannot be read are computed again and
replaced; a folder that cannot be written to is done without. ``HOOD_CACHE`` moves the folder; empty or ``off`` does without.

A hierarchy from edge lists that came with a garment, instead of one built here.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from hood.model.graph.hierarchy import Hierarchy, build_hierarchy
from hood.native.build import cache_folder

#: Part of every name: raise it with any change to what :func:`hood.model.graph.hierarchy.build_hierarchy` returns.
VERSION = 2
#: Smaller meshes are not kept. Refined dress on one busy core of an AMD server CPU, building / reading: 28 / 0.4 ms at 1k
#: vertices, 87 / 0.5 ms at 5k, 190 / 1 ms at 12k and 2200 / 7 ms at 100k: below, a process's start would save some 30 ms.
MIN_VERTICES = 2000
#: Entries beyond this many are removed, the oldest first.
MAX_ENTRIES = 200
#: Garments whose hierarchies a process keeps; 0.2 MB each at 1k vertices, 2 MB at 12k.
MAX_TEMPLATES = 128

_TEMPLATES: OrderedDict[tuple[int, int, int], tuple[np.ndarray, np.ndarray, Hierarchy]] = OrderedDict()


def template_hierarchy(
    num_vertices: int, edges: np.ndarray, rest_pos: np.ndarray, num_coarse: int, passed_over: int = 0
) -> Hierarchy:
    """The same as :func:`cached_hierarchy`, kept in memory per array ``rest_pos``: training meets the same garments
    thousands of times. Of more than :data:`MAX_TEMPLATES` garments those met last are kept."""
    key = (id(rest_pos), num_coarse, passed_over)
    entry = _TEMPLATES.pop(key, None)
    # Holding the array keeps its id from being reused; other faces may still share it.
    if entry is None or entry[0] is not rest_pos or not np.array_equal(entry[1], edges):
        entry = (rest_pos, edges.copy(), cached_hierarchy(num_vertices, edges, rest_pos, num_coarse, passed_over))
    _TEMPLATES[key] = entry
    while len(_TEMPLATES) > MAX_TEMPLATES:
        _TEMPLATES.popitem(last=False)
    return entry[2]


def cached_hierarchy(
    num_vertices: int, edges: np.ndarray, rest_pos: np.ndarray, num_coarse: int, passed_over: int = 0
) -> Hierarchy:
    """What :func:`hood.model.graph.hierarchy.build_hierarchy` returns for the same arguments, from disk where it is known."""
    folder = cache_folder()
    if folder is None or num_vertices < MIN_VERTICES or num_coarse < 1:
        return build_hierarchy(num_vertices, edges, rest_pos, num_coarse, passed_over)
    path = folder / "hierarchy" / f"{_digest(num_vertices, edges, rest_pos, num_coarse, passed_over)}.npz"
    known = _read(path, num_vertices, num_coarse)
    if known is not None:
        return known
    built = build_hierarchy(num_vertices, edges, rest_pos, num_coarse, passed_over)
    _write(path, built)
    return built


def _digest(num_vertices: int, edges: np.ndarray, rest_pos: np.ndarray, num_coarse: int, passed_over: int = 0) -> str:
    rest_pos = np.ascontiguousarray(rest_pos)
    levels = f"{num_coarse} after {passed_over}" if passed_over else f"{num_coarse}"
    digest = hashlib.sha256(f"{VERSION} {num_vertices} {levels} {rest_pos.dtype} {rest_pos.shape}".encode())
    digest.update(np.ascontiguousarray(edges, dtype=np.int64).tobytes())
    digest.update(rest_pos.tobytes())
    return digest.hexdigest()


def _read(path: Path, num_vertices: int, num_coarse: int) -> Hierarchy | None:
    """The entry, or None where there is none that fits."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            level = arrays["node_level"]
            tables = [arrays[f"coarse{k}"] for k in range(num_coarse)]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    good = level.shape == (num_vertices,) and level.dtype == np.int64
    for table in tables:
        good = good and table.dtype == np.int64 and table.ndim == 2 and table.shape[1] == 2
        good = good and (table.size == 0 or (table.min() >= 0 and table.max() < num_vertices))
    return Hierarchy(tuple(torch.from_numpy(table) for table in tables), torch.from_numpy(level)) if good else None


def _write(path: Path, hierarchy: Hierarchy) -> None:
    """Write an entry atomically; other processes may be doing the same."""
    arrays = {f"coarse{k}": edges.numpy() for k, edges in enumerate(hierarchy.coarse_edges)}
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".partial", delete=False) as file:
            temporary = Path(file.name)
            np.savez(file, node_level=hierarchy.node_level.numpy(), **arrays)  # type: ignore[arg-type]
        os.replace(temporary, path)
        entries = sorted(path.parent.glob("*.npz"), key=lambda entry: entry.stat().st_mtime)
        for old in entries[:-MAX_ENTRIES]:
            old.unlink(missing_ok=True)
    except OSError:  # no space, no permission: the result is there all the same
        if temporary is not None:
            temporary.unlink(missing_ok=True)


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

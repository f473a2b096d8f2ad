"""Rows of fasteners made on a garment: which vertices of its edges belong together, and room for cloth between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from hood.assets.files.library import unknown
from hood.assets.files.text import read_indices
from hood.assets.garment.garment import Garment
from hood.assets.garment.parts import COLOURS, coloured_vertices
from hood.mesh import topology

#: Distance [m] that the two sides of a row have at least: layers of cloth are kept 3 mm apart.
ROOM, _ROUNDING = 4e-3, 1e-6
_FIX = (
    "{left: [12, 13], right: [40, 41]} (vertices, or .txt or .json lists of them, in one order), {painted: [red, green]} or "
    "{heights: [0.0, 0.55]} (edges left and right of the middle of the front, m); with every: 2 one of two pairs"
)


def fasten(garment: Garment, asked: Mapping[str, Any]) -> tuple[Garment, np.ndarray]:
    """The garment with rows of fasteners by name besides those that it has, and all pairs (N, 2) of their edges, those included
    that ``every`` leaves out: they may lie on each other and yet are two vertices.

    Args:
        asked: by name of the row ``{left, right}``, vertex numbers or a file of them, paired in their order; ``{painted}``, two
            of the colours red, green and blue; or ``{heights}``, two heights [m], between which edges of the cloth left and
            right of x = 0 in front are paired. Painted vertices and edges are paired where each is the other's nearest.
            ``every`` keeps one of so many pairs, from the top down (of lists: from the first).

    Raises:
        ValueError: a row that is given otherwise, or without pairs; names the row.
    """
    rows, edges = dict(garment.fasteners or {}), [np.zeros((0, 2), dtype=np.int64)]
    for name, given in asked.items():
        where = f"fasten: {name}"
        if not isinstance(given, Mapping):
            raise ValueError(f"{where} is {given}; give {_FIX}")
        for key in given:
            if key not in ("left", "right", "painted", "heights", "every"):
                raise ValueError(f"{where}: {unknown('key', str(key), ['left', 'right', 'painted', 'heights', 'every'])}")
        every = given.get("every", 1)
        if isinstance(every, bool) or not isinstance(every, int) or every < 1:
            raise ValueError(f"{where}: every is {every}; give a whole number of at least 1")
        pairs = _pairs(where, given, garment)
        edges.append(pairs)
        rows[str(name)] = pairs[::every]
    return replace(garment, fasteners=rows or None), np.concatenate(edges)


def _pairs(where: str, given: Mapping[str, Any], garment: Garment) -> np.ndarray:
    forms = [form for form in ("left", "painted", "heights") if form in given or (form == "left" and "right" in given)]
    if len(forms) != 1:
        raise ValueError(f"{where} names its sides in {len(forms)} ways; give {_FIX}")
    if forms[0] == "left":
        return _listed(where, given, garment)
    sides = _painted(where, given["painted"], garment) if forms[0] == "painted" else _in_front(where, given["heights"], garment)
    pairs = _nearest(garment.rest_pos, *sides)
    if len(pairs) == 0:
        raise ValueError(f"{where}: no vertices of the two sides face each other; give {_FIX}")
    return pairs[np.argsort(-garment.rest_pos[pairs[:, 0], 1], kind="stable")]


def _listed(where: str, given: Mapping[str, Any], garment: Garment) -> np.ndarray:
    count = len(garment.rest_pos) if garment.file_numbers is None else len(garment.file_numbers)
    sides = []
    for key in ("left", "right"):
        value = given.get(key)
        if isinstance(value, str):
            numbers = read_indices(Path(value).expanduser())
        elif isinstance(value, list) and all(isinstance(one, int) and not isinstance(one, bool) for one in value):
            numbers = np.array(value, dtype=np.int64)
        else:
            raise ValueError(f"{where}: {key} is {value}; give vertex numbers, [12, 13], or a .txt or .json list of them")
        outside = (numbers < 0) | (numbers >= count)
        if outside.any():
            row = int(np.argmax(outside))
            raise ValueError(f"{where}: {key}[{row}] is vertex {int(numbers[row])} of {count}; they are numbered from 0")
        present = numbers if garment.file_numbers is None else garment.file_numbers[numbers]
        if (present < 0).any():
            row = int(np.argmax(present < 0))
            raise ValueError(
                f"{where}: {key}[{row}] is vertex {int(numbers[row])}, which is no part of the garment; give another"
            )
        sides.append(present)
    left, right = sides
    if len(left) != len(right) or len(left) == 0:
        raise ValueError(f"{where}: {len(left)} vertices left and {len(right)} right; give as many on both sides, at least one")
    if (left == right).any():
        row = int(np.argmax(left == right))
        raise ValueError(f"{where}: pair {row} is vertex {int(left[row])} twice; give two different ones")
    return np.stack([left, right], axis=1)


def _painted(where: str, given: Any, garment: Garment) -> list[np.ndarray]:
    if not isinstance(given, list) or len(given) != 2 or given[0] == given[1] or not set(given) <= set(COLOURS):
        raise ValueError(f"{where}: painted is {given}; give two of {', '.join(COLOURS)}, such as painted: [red, green]")
    sides = [np.flatnonzero(coloured_vertices(colour, garment)) for colour in given]
    for colour, side in zip(given, sides, strict=True):
        if len(side) == 0:
            raise ValueError(f"{where}: no vertex of {garment.name!r} is {colour} (above the other colours by half the scale)")
    return sides


def _in_front(where: str, given: Any, garment: Garment) -> list[np.ndarray]:
    """Vertices of edges of the cloth in front, between two heights, left and right of x = 0: of the side that the cloth around
    them lies on."""
    numbers = isinstance(given, list) and len(given) == 2
    if not numbers or not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in given) or given[0] >= given[1]:
        raise ValueError(f"{where}: heights is {given}; give the lower and the upper one in m, such as heights: [0.0, 0.55]")
    pos, low, high = garment.rest_pos, float(given[0]), float(given[1])
    loops = topology.boundary_loops(garment.faces)
    border = np.unique(np.concatenate(loops)) if loops else np.zeros(0, dtype=np.int64)
    height, depth = pos[border, 1], pos[border, 2]
    front = border[(height >= low) & (height <= high) & (depth > 0.5 * (pos[:, 2].min() + pos[:, 2].max()))]
    across = (_around(garment) @ pos)[:, 0]
    sides = [front[across[front] > 0], front[across[front] < 0]]
    if min(len(side) for side in sides) == 0:
        spread = f"from {height.min():.2f} to {height.max():.2f} m" if len(border) else "nowhere"
        raise ValueError(
            f"{where}: between {low:g} and {high:g} m the garment has no edges left and right of the middle of its front; its "
            f"edges lie {spread}; give other heights, or two lists of vertices"
        )
    return sides


def _nearest(pos: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) of vertices each of which is the nearest of its side to the other."""
    there, back = cKDTree(pos[right]).query(pos[left])[1], cKDTree(pos[left]).query(pos[right])[1]
    mutual = back[there] == np.arange(len(left))
    return np.stack([left[mutual], right[there[mutual]]], axis=1)


def with_room(garment: Garment, pairs: np.ndarray) -> tuple[Garment, int]:
    """The garment with ``pairs`` (N, 2) that are nearer to each other than :data:`ROOM` drawn apart, each vertex towards the
    cloth of its own side, and how many vertices were moved."""
    worn = garment.worn_pos
    apart = np.linalg.norm(worn[pairs[:, 0]] - worn[pairs[:, 1]], axis=1)
    pairs = np.unique(pairs[apart < ROOM - _ROUNDING], axis=0)
    if len(pairs) == 0:
        return garment, 0
    first, second = pairs.T
    apart = np.linalg.norm(worn[first] - worn[second], axis=1)
    inwards = (_around(garment) @ worn) - worn
    way = inwards[first] - inwards[second]
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    half = 0.5 * np.maximum(ROOM - apart, 0.0)[:, None] * way
    shift = np.zeros_like(worn)
    shift[first], shift[second] = half, -half
    turned = shift if garment.rest_turn is None else np.einsum("vij,vj->vi", garment.rest_turn, shift)
    skin_pos = None if garment.skin_pos is None else garment.skin_pos + shift
    return replace(garment, rest_pos=garment.rest_pos + turned, skin_pos=skin_pos), len(np.unique(pairs))


def _around(garment: Garment) -> sparse.csr_matrix:
    """(V, V) means over the neighbours of every vertex."""
    edges, count = topology.unique_edges(garment.faces), len(garment.rest_pos)
    both = np.concatenate([edges, edges[:, ::-1]])
    ones = sparse.coo_matrix((np.ones(len(both)), both.T), shape=(count, count)).tocsr()
    return sparse.diags(1.0 / np.maximum(np.asarray(ones.sum(axis=1)).ravel(), 1.0)) @ ones

"""Extreme garments for the stability map: too small, torn, refined, with mesh faults."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from hood.assets.body.load import load_body
from hood.assets.garment.garment import Garment
from hood.mesh.editing.remeshing import closest, isotropic
from hood.mesh.editing.subdivision import quartered
from hood.mesh.topology import unique_edges

_Array = np.ndarray

#: The sheet [m] along a side, and its edges along it.
_SIDE, _EDGES = 1.0, 24


def _size(garment: Garment, factor: float, rng: np.random.Generator) -> Garment:
    """Its rest shape, put on as it was."""
    worn = garment.worn_pos
    return replace(garment, rest_pos=garment.rest_pos * factor, skin_pos=worn)


def _slivers(garment: Garment, ratio: float, rng: np.random.Generator) -> Garment:
    """Ten faces get a vertex on their longest edge, but for a height of its length over the ratio."""
    share = 2.0 / ratio
    return _split(garment, rng.choice(len(garment.faces), 10, replace=False), (0.5 - share / 2, 0.5 - share / 2, share))


def _duplicates(garment: Garment, count: float, rng: np.random.Generator) -> Garment:
    """Faces split at a vertex that lies 1 µm from one of their corners."""
    chosen = rng.choice(len(garment.faces), int(count), replace=False)
    a, b, c = (garment.rest_pos[garment.faces[chosen, corner]] for corner in range(3))
    near = 1e-6 / (np.linalg.norm(b - a, axis=1) + np.linalg.norm(c - a, axis=1))
    return _split(garment, chosen, np.stack([1.0 - 2.0 * near, near, near], axis=1))


def _flipped(garment: Garment, count: float, rng: np.random.Generator) -> Garment:
    """Faces turned over."""
    faces = garment.faces.copy()
    chosen = rng.choice(len(faces), int(count), replace=False)
    faces[chosen] = faces[chosen][:, ::-1]
    return replace(garment, faces=faces)


def _isolated(garment: Garment, count: float, rng: np.random.Generator) -> Garment:
    """Vertices of no face."""
    rows = rng.choice(len(garment.rest_pos), int(count), replace=False)
    return _grown(garment, np.repeat(rows[:, None], 3, axis=1), np.full((len(rows), 3), 1.0 / 3.0), garment.faces)


def _irregular(garment: Garment, share: float, rng: np.random.Generator) -> Garment:
    """Every vertex moved by so large a share of the way to a random point of one of its faces."""
    count = len(garment.rest_pos)
    order = rng.permutation(3 * len(garment.faces))
    corner = np.zeros(count, dtype=np.int64)
    corner[garment.faces.ravel()[order]] = order // 3
    origin = garment.faces[corner]
    weights = share * rng.dirichlet((1.0, 1.0, 1.0), count)
    own = np.repeat(np.arange(count)[:, None], 4, axis=1)
    own[:, 1:] = origin
    weights = np.column_stack([np.full(count, 1.0 - share), weights])
    return replace(garment, **_means(garment, own, weights))  # type: ignore[arg-type]


def _components(garment: Garment, count: float, rng: np.random.Generator) -> Garment:
    """Cut from top to bottom into so many bands that no longer hold together."""
    height = garment.rest_pos[garment.faces].mean(axis=1)[:, 1]
    band = np.argsort(np.argsort(height, kind="stable"), kind="stable") * int(count) // len(height)
    corners = np.stack([np.repeat(band, 3), garment.faces.ravel()], axis=1)
    pairs, faces = np.unique(corners, axis=0, return_inverse=True)
    origin = pairs[:, 1]
    rows = {key: _taken(getattr(garment, key), origin) for key in _SMOOTH + _MARKS}
    return replace(garment, faces=faces.reshape(-1, 3).astype(np.int64), **rows, **_NOTHING)  # type: ignore[arg-type]


def _remesh(garment: Garment, count: float, rng: np.random.Generator) -> Garment:
    """Triangulated anew with about so many vertices and edges of one length."""
    pos, faces = isotropic(garment.rest_pos, garment.faces, int(count))
    hit = closest(pos, garment.rest_pos, garment.faces)
    origin, weights = garment.faces[hit.face.numpy()], hit.bary.numpy()
    nearest = origin[np.arange(len(pos)), weights.argmax(axis=1)]
    fields = _means(garment, origin, weights) | {key: _taken(getattr(garment, key), nearest) for key in _MARKS}
    return replace(garment, **fields | {"rest_pos": pos}, faces=faces, fasteners=None, **_NOTHING)  # type: ignore[arg-type]


def _subdivide(garment: Garment, times: float, rng: np.random.Generator) -> Garment:
    """Every face into four, so many times."""
    for _ in range(int(times)):
        edges = unique_edges(garment.faces)
        finer = quartered(garment.faces, edges, len(garment.rest_pos))
        garment = _grown(garment, edges, np.full((len(edges), 2), 0.5), finer)
    return garment


def _sheet(garment: Garment, height: float, rng: np.random.Generator) -> Garment:
    """No garment but a level square, so high above the head of the default body."""
    along = np.linspace(-_SIDE / 2, _SIDE / 2, _EDGES + 1)
    x, z = np.meshgrid(along, along)
    pos = np.stack([x.ravel(), np.full(x.size, load_body().v_template[:, 1].max() + height), z.ravel()], axis=1)
    first = (np.arange(_EDGES)[:, None] * (_EDGES + 1) + np.arange(_EDGES)).ravel()
    below = first + _EDGES + 1
    faces = np.concatenate([np.stack([first, below, first + 1], axis=1), np.stack([first + 1, below, below + 1], axis=1)])
    return Garment("sheet", pos, faces, np.zeros(len(pos), dtype=bool))


#: By name: of a garment, an amount and a generator of random numbers.
FAULTS: Mapping[str, Callable[[Garment, float, np.random.Generator], Garment]] = {
    "size": _size, "slivers": _slivers, "duplicates": _duplicates, "flipped": _flipped, "isolated": _isolated,
    "irregular": _irregular, "components": _components, "remesh": _remesh, "subdivide": _subdivide, "sheet": _sheet,
}  # fmt: skip

#: Fields of a vertex that have means, those that have none, and those that do not fit other faces.
_SMOOTH, _MARKS = ("rest_pos", "skin_pos", "lbs_weights", "shapedirs"), ("pinned", "region", "stiffness", "piece", "rest_turn")
_NOTHING = dict.fromkeys(("uv", "uv_faces", "normal_faces", "colours", "coarse_edges", "panels"))


def _split(garment: Garment, chosen: _Array, weights: _Array | tuple[float, float, float]) -> Garment:
    """Faces ``chosen`` (N,) split into three at means of their corners by ``weights`` (N, 3) or (3,)."""
    a, b, c = (garment.faces[chosen, corner] for corner in range(3))
    new = len(garment.rest_pos) + np.arange(len(chosen))
    faces = garment.faces.copy()
    faces[chosen] = np.stack([a, b, new], axis=1)
    more = np.stack([np.stack([b, c, new], axis=1), np.stack([c, a, new], axis=1)], axis=1).reshape(-1, 3)
    origin = np.stack([a, b, c], axis=1)
    return _grown(garment, origin, np.broadcast_to(np.asarray(weights), origin.shape), np.concatenate([faces, more]))


def _grown(garment: Garment, origin: _Array, weights: _Array, faces: _Array) -> Garment:
    """With further vertices at means of others, ``origin`` and ``weights`` (N, K), which are marked like the first of them."""
    smooth: dict[str, _Array | None] = {}
    for key, means in _means(garment, origin, weights).items():
        smooth[key] = None if means is None else np.concatenate([getattr(garment, key), means])
    marks: dict[str, _Array | None] = {}
    for key in _MARKS:
        values = getattr(garment, key)
        marks[key] = None if values is None else np.concatenate([values, values[origin[:, 0]]])
    return replace(garment, faces=faces, **smooth, **marks, **_NOTHING)  # type: ignore[arg-type]


def _means(garment: Garment, origin: _Array, weights: _Array) -> dict[str, _Array | None]:
    """The smooth fields at weighted means of vertices (N, K); None where the garment has none."""
    found: dict[str, _Array | None] = {}
    for key in _SMOOTH:
        values = getattr(garment, key)
        found[key] = None if values is None else np.einsum("nk,nk...->n...", weights, values[origin].astype(np.float64))
    return found


def _taken(values: _Array | None, rows: _Array) -> _Array | None:
    return None if values is None else values[rows]

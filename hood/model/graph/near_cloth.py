"""Cloth near cloth for the graph: pairs of vertices that are close now and were not at rest."""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.mesh.topology import Rings, connected_components
from hood.tensors.batch import forget

#: Vertices of one piece of cloth that are nearer at rest than so many radii lie side by side, however fine the mesh is: they
#: are no layers.
_FLAT = 1.5


@dataclass(frozen=True)
class _Rest:
    """What is known of a cloth at rest."""

    pos: np.ndarray  # (V, 3) m, float64
    piece: np.ndarray  # (V,) connected part, over all scenes
    rings: Rings
    bounds: list[int]  # first vertex of every scene, and the end


@torch.no_grad()
def find_near_cloth(cloth: Cloth, pos: Tensor, radius: float) -> Tensor:
    """Pairs (E, 2) of vertices of one scene closer than ``radius`` [m] at ``pos`` (V, 3), the lower number first, ascending.

    Of two connected parts, or of one folded on itself: neighbours within two edges, and what was as near at rest as cloth side
    by side is, are left out. Places that are not finite are near nothing. The search is done on the CPU.
    """
    rest, here = _rest_of(cloth), pos.detach().cpu().double().numpy()
    pairs = [_pairs(here[first:last], radius) + first for first, last in zip(rest.bounds, rest.bounds[1:], strict=False)]
    first, second = np.concatenate(pairs).T if pairs else np.zeros((2, 0), dtype=np.int64)
    side_by_side = np.linalg.norm(rest.pos[first] - rest.pos[second], axis=1) < _FLAT * radius
    same = rest.piece[first] == rest.piece[second]
    kept = ~(same & side_by_side) & ~rest.rings.hold(first, second)
    return torch.as_tensor(np.stack([first[kept], second[kept]], axis=1), device=pos.device)


def _pairs(pos: np.ndarray, radius: float) -> np.ndarray:
    """(E, 2) int64, ascending."""
    finite = np.flatnonzero(np.isfinite(pos).all(axis=1))
    if len(finite) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    found = finite[cKDTree(pos[finite]).query_pairs(radius, output_type="ndarray")].reshape(-1, 2)
    found.sort(axis=1)
    return np.asarray(found[np.lexsort((found[:, 1], found[:, 0]))])


_RESTS: dict[int, tuple[weakref.ref[Tensor], _Rest]] = {}


def _rest_of(cloth: Cloth) -> _Rest:
    """Kept as long as the cloth's edges live."""
    key = id(cloth.edges)
    known = _RESTS.get(key)
    if known is not None and known[0]() is cloth.edges:
        return known[1]
    edges = cloth.edges.cpu().numpy()
    bounds = torch.searchsorted(cloth.vertex_scene.cpu(), torch.arange(cloth.num_scenes + 1)).tolist()
    count = cloth.num_vertices
    rest = _Rest(cloth.rest_pos.cpu().double().numpy(), connected_components(count, edges), Rings(count, edges), bounds)
    _RESTS[key] = weakref.ref(cloth.edges, forget(_RESTS, key)), rest
    return rest

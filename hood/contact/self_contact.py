"""On which side of the cloth near them vertices are at t: what a step may not change, whatever leads it.

Cloth near cloth in a batch of scenes: what is found out about a cloth once, and about each of its steps.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.mesh.closest_point.search import closest_point_on_triangles
from hood.mesh.cloth_proximity import ClothSurface, Contacts, Followed, LayerMesh, follow, vertex_room
from hood.mesh.topology import Rings, unique_edges
from hood.tensors.batch import forget, made_of

#: Beside a face by more than this [m] a vertex is paired with it only where it is the nearest one.
_BESIDE = 3e-3


@dataclass(frozen=True)
class LayerPairs:
    """N pairs of a vertex and a face without a common vertex, near each other at t."""

    vertex: Tensor  # (N,)
    corners: Tensor  # (N, 3) of the face
    side: Tensor  # (N,) 1 where the vertex is on the side of the face's normal, else -1
    room: Tensor  # (N,) m, half of the smallest height of the faces around both
    scene: Tensor  # (N,)


@torch.no_grad()
def find_sides(cloth: Cloth, pos: Tensor, reach: float) -> LayerPairs:
    """Pairs of every scene within ``reach`` [m] at ``pos`` (V, 3); of neighbours along the mesh within their ``room`` alone.

    A vertex has a side of a face it is over: its distance is at least what it lies beside the face. Beyond a rim there is none.
    The search is done on the CPU.
    """
    here = pos.detach().cpu().double()
    parts = [_find(one, here[one.first : one.last].numpy(), reach) for one in _patches(cloth)]
    vertex, corners, side, room = (torch.as_tensor(np.concatenate(column)) for column in zip(*parts, strict=True))
    vertex = vertex.to(pos.device)
    rest = corners.to(pos.device), side.to(pos), room.to(pos)
    return LayerPairs(vertex, *rest, cloth.vertex_scene[vertex])


class _Patch:
    """What is known of one scene's cloth at rest."""

    def __init__(self, rest: np.ndarray, faces: np.ndarray, first: int) -> None:
        self.faces, self.first, self.last = faces, first, first + len(rest)
        self.room = vertex_room(rest, faces)
        self._rings = Rings(len(rest), unique_edges(faces))

    def are_neighbours(self, vertex: np.ndarray, corners: np.ndarray) -> np.ndarray:
        """(N,) bool: a corner (N, 3) is at most two edges away from the vertex (N,)."""
        return np.asarray(self._rings.hold(vertex[:, None], corners).any(axis=1))


def _find(patch: _Patch, pos: np.ndarray, reach: float) -> tuple[np.ndarray, ...]:
    """Vertices (N,) and corners (N, 3) in the batch's numbers, sides (N,) and rooms (N,)."""
    vertex, face = _candidates(pos, patch.faces, reach)
    corners = patch.faces[face]
    apart = (corners != vertex[:, None]).all(axis=1)
    vertex, corners = vertex[apart], corners[apart]
    room = np.minimum(patch.room[vertex], patch.room[corners].min(axis=1))
    height, beside, dist = _heights(pos, vertex, corners)
    near = dist < np.where(patch.are_neighbours(vertex, corners), np.minimum(room, reach), reach)
    over = near & (height != 0) & (np.abs(height) >= beside)
    order = np.flatnonzero(over)[np.lexsort((dist[over], vertex[over]))]
    nearest = np.zeros(len(vertex), dtype=bool)
    nearest[order[np.unique(vertex[order], return_index=True)[1]]] = True
    kept = over & (nearest | (beside <= _BESIDE))
    side = np.sign(height[kept])
    return vertex[kept] + patch.first, corners[kept] + patch.first, side, room[kept]


def _candidates(pos: np.ndarray, faces: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N,) and faces (N,) of which one may be within ``reach`` of the other."""
    finite = np.isfinite(pos).all(axis=1)
    sound = np.flatnonzero(finite[faces].all(axis=1))
    if not len(sound):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    centre = pos[faces[sound]].mean(axis=1)
    radius = np.linalg.norm(pos[faces[sound]] - centre[:, None], axis=2).max(axis=1)
    rows = np.flatnonzero(finite)
    found = cKDTree(pos[rows]).query_ball_point(centre, radius + reach, return_sorted=True)
    count = np.array([len(one) for one in found])
    vertex = rows[np.concatenate([np.asarray(one, dtype=np.int64) for one in found])]
    return vertex, np.repeat(sound, count)


def _heights(pos: np.ndarray, vertex: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of vertices (N,) over the planes of faces (N, 3) [m], signed; how far beside the face they are, and from it in all."""
    point, x = pos[vertex], pos[corners]
    bary = closest_point_on_triangles(torch.as_tensor(point), torch.as_tensor(x)).numpy()
    offset = point - (bary[:, :, None] * x).sum(axis=1)
    normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    height = (offset * normal).sum(axis=1)
    dist = np.linalg.norm(offset, axis=1)
    return height, np.sqrt(np.maximum(dist**2 - height**2, 0.0)), dist


def _patches(cloth: Cloth) -> list[_Patch]:
    """What is known of every scene, kept as long as the cloth's faces live."""
    made = made_of(cloth.faces)
    if "patches" in made:
        return made["patches"]
    rest, faces, scene = cloth.rest_pos.cpu().double().numpy(), cloth.faces.cpu().numpy(), cloth.face_scene.cpu().numpy()
    bounds = torch.searchsorted(cloth.vertex_scene.cpu(), torch.arange(cloth.num_scenes + 1)).tolist()
    made["patches"] = patches = [
        _Patch(rest[first:last], faces[scene == index] - first, first)
        for index, (first, last) in enumerate(zip(bounds, bounds[1:], strict=False))
    ]
    return patches


@dataclass(frozen=True)
class SceneLayers:
    """The layers of one scene, and where its vertices are in the batch."""

    layers: ClothSurface
    first: int
    last: int
    at_start: Contacts | None = None  # what is within its reach where the step begins, if anybody asked
    pins: Followed | None = None  # where held vertices come to; None without any

    def of(self, values: Tensor) -> np.ndarray:
        """This scene's rows of ``values`` (V, 3), float64."""
        own = values.detach()
        own = own if self.last - self.first == len(own) else own[self.first : self.last]
        return np.ascontiguousarray(own.cpu().numpy(), np.float64)

    def near_at_start(self, pos: Tensor) -> Contacts:
        """What is within its reach where the step begins, at ``pos`` (V, 3) m."""
        return self.layers.contacts(self.of(pos)) if self.at_start is None else self.at_start

    def is_apart(self, pos: Tensor) -> bool:
        """Whether nothing is within its reach at ``pos`` (V, 3) m; never where that is not finite."""
        here = self.of(pos)
        return bool(np.isfinite(here).all()) and not len(self.layers.contacts(here).corners)

    def begun_at(self, pos: Tensor) -> SceneLayers:
        """The same with ways that begin at ``pos`` (V, 3) m; what was near what where the step begins is still known."""
        return SceneLayers(self.layers.begun_at(self.of(pos)), self.first, self.last, self.at_start, self.pins)


def find_layers(
    cloth: Cloth, pos: Tensor, ahead: Tensor, reach: float, pressure: float, between: bool
) -> tuple[SceneLayers, ...]:
    """The layers of every scene at ``pos`` (V, 3), from where the step may lead to ``ahead`` (V, 3): targets of held vertices
    are in there, which may be out of reach (:func:`late_targets`). See :class:`hood.mesh.cloth_proximity.ClothSurface`."""
    found, free, held_by = [], cloth.free.cpu().numpy(), cloth.pinned.cpu().numpy()
    for mesh, first, last in _meshes(cloth, reach):
        fixed, pinned = ~free[first:last], held_by[first:last]
        here, there = (values[first:last].detach().cpu().double().numpy() for values in (pos, ahead))
        held = bool(pinned.any() and np.isfinite(here).all() and np.isfinite(there[pinned]).all())
        there = np.where(np.isfinite(there), there, here)
        layers, pins = ClothSurface(mesh, here, fixed, pressure, between, there), None
        if held:
            pins = follow(layers, here, pinned, there)
            if pins.late:
                short = torch.as_tensor(pins.pos).to(ahead).cpu().double().numpy()
                there = np.where((pins.lag > 0)[:, None], short, there)
                layers = ClothSurface(mesh, here, fixed, pressure, between, there)
            layers.resort_to(np.where(pinned[:, None], there, np.where(fixed[:, None], here, pins.pos)))
        found.append(SceneLayers(layers, first, last, pins=pins))
    return tuple(found)


def late_targets(layers: tuple[SceneLayers, ...], target: Tensor) -> Tensor:
    """``target`` (V, 3) of held vertices, where they come to in the step; itself where all of them can be reached."""
    if not any(scene.pins is not None and scene.pins.late for scene in layers):
        return target
    reached = target.clone()
    for scene in layers:
        if scene.pins is not None:
            late = torch.as_tensor(scene.pins.lag > 0, device=target.device).unsqueeze(1)
            own = reached[scene.first : scene.last]
            own.copy_(torch.where(late, torch.as_tensor(scene.pins.pos).to(target), own))
    return reached


_MESHES: dict[tuple[int, float], tuple[weakref.ref[Tensor], list[tuple[LayerMesh, int, int]]]] = {}


def _meshes(cloth: Cloth, reach: float) -> list[tuple[LayerMesh, int, int]]:
    """Mesh and range of vertices of every scene, kept as long as the cloth's faces live."""
    key = id(cloth.faces), reach
    known = _MESHES.get(key)
    if known is not None and known[0]() is cloth.faces:
        return known[1]
    rest, faces = cloth.rest_pos.cpu().double().numpy(), cloth.faces.cpu().numpy()
    flat = None if cloth.flat is None else cloth.flat.double().cpu().numpy()
    bounds = torch.searchsorted(cloth.vertex_scene.cpu(), torch.arange(cloth.num_scenes + 1)).tolist()
    scene, made = cloth.face_scene.cpu().numpy(), []
    for index, (first, last) in enumerate(zip(bounds, bounds[1:], strict=False)):
        own = scene == index
        mesh = LayerMesh(rest[first:last], faces[own] - first, reach, None if flat is None else flat[own])
        made.append((mesh, first, last))
    _MESHES[key] = weakref.ref(cloth.faces, forget(_MESHES, key)), made
    return made

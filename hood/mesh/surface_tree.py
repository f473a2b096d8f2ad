"""Closest points on triangle surfaces by a compiled tree of boxes (``hood/native/surface.cpp``)."""

from __future__ import annotations

import ctypes
import weakref
from collections import deque
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hood import native
from hood.mesh.curvature import MOST_CURVATURE, ROUNDS
from hood.mesh.kept import forget
from hood.native.build import optional
from hood.native.structures import COUNT, POINTER, REAL, fields
from hood.native.threads import num_parts

SOURCE = Path(native.__file__).with_name("surface.cpp")
#: Faces of a leaf, as in the source, and bytes of a line of the cache.
_WIDE, _LINE = 8, 64
#: Points that are searched for together, as in the source; fewer where that makes more visits to leaves than this possible.
_MOST, _VISITS = 64, 1 << 18
#: Points of a part that is worth a thread: threads need the normals of all vertices made before they begin.
_POINTS = 1000


class _Tree(ctypes.Structure):
    """``Tree`` of ``surface.cpp``."""

    _fields_ = [
        *fields("num_faces num_vertices num_nodes num_leaves num_blocks edge_width", COUNT),
        *fields("faces around first valence face_edges edge_faces", POINTER),
        *fields("order place children number corner_of block_first block_vertex block_number", POINTER),
        *fields("fan_first fan fan_share", POINTER),
        *fields("pos corners boxes face_boxes block_pos vertex_normal bulge needed stamp", POINTER),
        ("call", COUNT),
        ("origin", ctypes.c_double * 3),
        ("size_sq", ctypes.c_double),
        *fields("batch parts", COUNT),
        *fields("leaf_normals normal_boxes", POINTER),
        *fields("normals_of fits", COUNT),
        *fields("nodes leaves reach", POINTER),
    ]


class _Matched(ctypes.Structure):
    """``Matched`` of ``surface.cpp``."""

    _fields_ = [("count", COUNT), *fields("points valid dist point normal", POINTER), *fields("ahead near cosine", REAL)]


class _Query(ctypes.Structure):
    """``Query`` of ``surface.cpp``."""

    _fields_ = [
        ("count", COUNT),
        *fields("points next_pos vertex face vertex_dist bary dist", POINTER),
        *fields("point normal next_point next_normal curvature", POINTER),
        ("most_curvature", REAL),
        ("rounds", COUNT),
    ]


#: What is known of a matched point, then and now.
_PLACES = ("point", "normal", "next_point", "next_normal")


class FoldRule(NamedTuple):
    """What another side of a fold is, see :func:`hood.scene.contact.find_fold`."""

    ahead: float  # m, it is looked for this far off the skin
    near: float  # m, of points that are nearer
    cosine: float  # of the angle with the normal by which its own are turned at least
    behind: float  # m, it is no farther behind the skin


class Match(NamedTuple):
    """Closest surface points of N points, as in :class:`hood.mesh.proximity.SurfaceHit`, and the same material points when the
    surface has moved on."""

    vertex: Tensor  # (N,)
    vertex_dist: Tensor  # (N,) m
    face: Tensor  # (N,)
    bary: Tensor  # (N, 3)
    dist: Tensor  # (N,) m
    point: Tensor  # (N, 3) m
    normal: Tensor  # (N, 3) outward unit normals there, interpolated over the face
    next_point: Tensor  # (N, 3) m
    next_normal: Tensor  # (N, 3)
    curvature: Tensor | None = None  # (N,) 1/m, of the surface there (hood.mesh.curvature); None where nobody asked for it


@cache
def library() -> ctypes.CDLL | None:
    """The compiled search; None without a compiler."""
    lib = optional(SOURCE)
    if lib is not None:
        lib.surface_ahead.restype = COUNT
    return lib


class SurfaceTree:
    """The tree of some faces of a topology; its arrays serve every search.

    Args:
        faces: (G, 3) int64.
        members: (F,) the faces that are in it, at least one.
        incidence: around, first, valence, face_edges and edge_faces of :class:`hood.mesh.proximity.Incidence`.
        pos: (W, 3) m, a shape to order the faces by.
    """

    def __init__(self, faces: np.ndarray, members: np.ndarray, incidence: Sequence[np.ndarray], pos: np.ndarray) -> None:
        lib = library()
        assert lib is not None
        self._lib = lib
        leaves, num_vertices = -(-len(members) // _WIDE), len(pos)  # all leaves are full but one
        blocks = 3 * leaves  # at most: faces without a vertex in common
        batch = max(min(_MOST, _VISITS // leaves), 1)
        integers = {
            "order": (leaves, _WIDE),
            "place": (len(faces),),
            "children": (leaves, _WIDE),
            "corner_of": (leaves, 3, _WIDE),
            "block_first": (leaves + 1,),
            "block_vertex": (blocks, _WIDE),
            "fan_first": (num_vertices + 1,),
            "fan": (9 * len(faces),),
            "needed": (num_vertices + 1,),
            "stamp": (num_vertices,),
        }
        reals = {
            "number": (leaves, _WIDE),
            "block_number": (blocks, _WIDE),
            "fan_share": (9 * len(faces),),
            "pos": (num_vertices, 3),
            "corners": (leaves, 9, _WIDE),
            "boxes": (leaves, 6, _WIDE),
            "block_pos": (blocks, 3, _WIDE),
            "vertex_normal": (num_vertices, 6),
            "bulge": (2, num_vertices),
            "leaf_normals": (leaves, 3, _WIDE),
            "normal_boxes": (leaves, 6, _WIDE),
        }
        self._arrays = dict(zip(("around", "first", "valence", "face_edges", "edge_faces"), incidence, strict=True))
        self._arrays |= {name: _aligned(shape, np.int32) for name, shape in integers.items()}
        self._arrays |= {name: _aligned(shape, np.float64) for name, shape in reals.items()}
        self._arrays |= {"face_boxes": _aligned((leaves, 6, _WIDE), np.float32)}
        self._arrays["faces"] = np.ascontiguousarray(faces, np.int64)
        self._arrays["order"].reshape(-1)[: len(members)] = members
        self._arrays["place"].fill(-1)
        counts = {"num_faces": len(members), "num_vertices": num_vertices, "edge_width": incidence[4].shape[1]}
        self._tree = _Tree(**counts, batch=batch)
        _point(self._tree, self._arrays)
        self._visits = batch * leaves + 1
        self._share(1)
        centre = np.ascontiguousarray(np.nan_to_num(np.asarray(pos, np.float64)[faces].mean(axis=1)))
        self._fitted: tuple[weakref.ref[Tensor], int | None] | None = None
        lib.surface_build(ctypes.byref(self._tree), centre.ctypes.data_as(POINTER))

    def _share(self, parts: int) -> None:
        """Search for points in as many parts, by threads of their own; what is found does not depend on it."""
        if parts > self._tree.parts:
            visits = {name: _aligned((parts, self._visits, 2), np.int32) for name in ("nodes", "leaves")}
            visits["reach"] = _aligned((parts, self._visits), np.float64)
            self._arrays |= visits
            _point(self._tree, visits)
        self._tree.parts = parts

    def _fit(self, vertices: Tensor) -> None:
        """Take up where the surface is; nothing to do where it was there in the search before."""
        known, version = self._fitted, None if vertices.is_inference() else vertices._version
        if known is not None and version is not None and known[0]() is vertices and known[1] == version:
            self._lib.surface_again(ctypes.byref(self._tree))
            return
        self._arrays["pos"][...] = _double(vertices)
        self._lib.surface_refit(ctypes.byref(self._tree))
        self._fitted = weakref.ref(vertices), version

    def ahead(
        self, points: np.ndarray, matched: Sequence[np.ndarray], vertices: Tensor, rule: FoldRule
    ) -> tuple[np.ndarray, np.ndarray]:
        """The rows (n,) of ``points`` (N, 3) whose other side :func:`search_folds` has to look for, and the places (n, 3) ahead
        of them; those in ``matched`` are valid (N,) bool, dist (N,), point and normal (N, 3)."""
        count = len(points)
        self._share(num_parts(count, _POINTS))
        self._fit(vertices)
        values = _Matched(count=count, ahead=rule.ahead, near=rule.near, cosine=rule.cosine)
        _point(values, {"points": points, **dict(zip(("valid", "dist", "point", "normal"), matched, strict=True))})
        rows, places, found = np.empty(count, np.int64), np.empty((count, 3)), np.empty(count, bool)
        given = (array.ctypes.data_as(POINTER) for array in (rows, places, found))
        num = self._lib.surface_ahead(ctypes.byref(self._tree), ctypes.byref(values), *given)
        return rows[:num], places[:num]

    def search(self, points: np.ndarray, vertices: Tensor, next_pos: np.ndarray, curved: bool) -> dict[str, np.ndarray]:
        """Fields of :class:`Match` for ``points`` (N, 3) on the surface at ``vertices`` (W, 3), with ``next_pos`` (W, 3); the
        arrays in float64 and C-contiguous. The curvature only if it is to be ``curved``."""
        count = len(points)
        self._share(num_parts(count, _POINTS))
        self._fit(vertices)
        found: dict[str, np.ndarray] = {name: np.empty(count, np.int64) for name in ("vertex", "face")}
        found |= {"vertex_dist": np.empty(count), "dist": np.empty(count)}
        found |= {name: np.empty((count, 3)) for name in ("bary", *_PLACES)}
        found |= {"curvature": np.empty(count)} if curved else {}
        query = _Query(count=count, most_curvature=MOST_CURVATURE, rounds=ROUNDS)
        _point(query, {"points": points, "next_pos": next_pos, **found})
        self._lib.surface_search(ctypes.byref(self._tree), ctypes.byref(query))
        return found


def _aligned(shape: tuple[int, ...], kind: type) -> np.ndarray:
    """Zeros that begin with a line of the cache, as vectors are read fastest."""
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    memory = np.zeros(size + _LINE, np.uint8)
    begin = -memory.ctypes.data % _LINE
    return memory[begin : begin + size].view(kind).reshape(shape)


def _point(structure: ctypes.Structure, arrays: dict[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        assert array.flags.c_contiguous, f"{name} has gaps"
        setattr(structure, name, array.ctypes.data)


@torch.no_grad()
def search(
    points: Tensor,
    point_scene: Tensor,
    vertices: Tensor,
    faces: Tensor,
    face_scene: Tensor,
    incidence: Sequence[Tensor],
    next_vertices: Tensor,
    curved: bool = False,
) -> Match | None:
    """Closest points, scene by scene; None where there is no compiled search, or not for these tensors.

    Args:
        incidence: as for :class:`SurfaceTree`.
        next_vertices: (W, 3) m, where the surface goes.
        curved: with the curvature of the surface.
    """
    if type(points) is not Tensor or points.device.type != "cpu" or library() is None:
        return None
    given, later = _double(points), _double(next_vertices)
    scene = _only_scene(face_scene)
    if scene is not None and scene == _only_scene(point_scene):
        return _found(points, _tree_of(faces, None, face_scene, incidence, vertices).search(given, vertices, later, curved))
    result = _nothing(len(points), curved)
    for scene in point_scene.unique().tolist():
        rows = (point_scene == scene).numpy().nonzero()[0]
        if bool((face_scene == scene).any()):
            part = _tree_of(faces, scene, face_scene, incidence, vertices).search(given[rows], vertices, later, curved)
            for name, values in part.items():
                result[name][rows] = values
    return _found(points, result)


@torch.no_grad()
def search_folds(
    points: Tensor,
    point_scene: Tensor,
    vertices: Tensor,
    faces: Tensor,
    face_scene: Tensor,
    incidence: Sequence[Tensor],
    next_vertices: Tensor,
    matched: Sequence[Tensor],
    rule: FoldRule,
) -> tuple[Match, Tensor] | None:
    """The other side of folds, see :func:`hood.scene.contact.find_fold`, scene by scene: matches with the curvature, and the
    rows (n,) of ``points`` (N, 3) that they are of. None where there is no compiled search, or not for these tensors.

    Args:
        incidence: as for :class:`SurfaceTree`.
        next_vertices: (W, 3) m, where the surface goes.
        matched: of the nearest side valid (N,) bool, dist (N,), point and normal (N, 3).
    """
    if type(points) is not Tensor or points.device.type != "cpu" or library() is None:
        return None
    valid, later = matched[0].numpy(), _double(next_vertices)
    given, near = _double(points), [_double(values) for values in matched[1:]]
    only = _only_scene(face_scene)
    whole = only is not None and only == _only_scene(point_scene)
    found = []
    for scene in [None] if whole else point_scene.unique().tolist():
        if scene is not None and not bool((face_scene == scene).any()):
            continue
        tree = _tree_of(faces, scene, face_scene, incidence, vertices)
        own = valid if scene is None else valid & (point_scene == scene).numpy()
        rows, places = tree.ahead(given, [np.ascontiguousarray(own), *near], vertices, rule)
        if len(rows):
            hit = tree.search(places, vertices, later, curved=True)
            kept = _on_other_side(hit, vertices, faces, near[1][rows], near[2][rows], rule)
            hit |= {"dist": ((given[rows] - hit["point"]) * hit["normal"]).sum(axis=1)}
            found.append(({name: values[kept] for name, values in hit.items()}, rows[kept]))
    if not found:
        return _found(points, _nothing(0, curved=True)), torch.zeros(0, dtype=torch.int64)
    hits = {name: np.concatenate([hit[name] for hit, _ in found]) for name in found[0][0]}
    return _found(points, hits), torch.from_numpy(np.concatenate([rows for _, rows in found]))


def _on_other_side(
    hit: dict[str, np.ndarray], vertices: Tensor, faces: Tensor, point: np.ndarray, normal: np.ndarray, rule: FoldRule
) -> np.ndarray:
    """Which matches ahead (n,) are on another side than the one with these points and normals (n, 3): what
    :func:`hood.scene.contact.find_fold` says of tensors."""
    corners = vertices.numpy()[faces.numpy()[hit["face"]]].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    of_face = (across * normal).sum(axis=1) / np.linalg.norm(across, axis=1).clip(min=1e-300)
    turned = (of_face < rule.cosine) & ((hit["normal"] * normal).sum(axis=1) < rule.cosine)
    in_front = ((hit["point"] - point) * normal).sum(axis=1) > -rule.behind
    return np.asarray(turned & in_front & (np.abs(hit["dist"]) <= rule.ahead + rule.near))


_ONLY: dict[int, tuple[weakref.ref[Tensor], int, int | None]] = {}


def _only_scene(scenes: Tensor) -> int | None:
    """The scene that all of ``scenes`` (N,) name, if they do; kept as long as the tensor is what it was."""
    key = id(scenes)
    known = _ONLY.get(key)
    if known is None or known[0]() is not scenes or known[1] != scenes._version:
        only = int(scenes[0]) if bool((scenes == scenes[0]).all()) else None
        known = _ONLY[key] = weakref.ref(scenes, forget(_ONLY, key)), scenes._version, only
    return known[2]


def _double(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.detach().numpy(), np.float64)


def _nothing(count: int, curved: bool) -> dict[str, np.ndarray]:
    result: dict[str, np.ndarray] = {name: np.zeros(count, np.int64) for name in ("vertex", "face")}
    result |= {"curvature": np.zeros(count)} if curved else {}
    result |= {name: np.full(count, np.inf) for name in ("vertex_dist", "dist")}
    return result | {name: np.zeros((count, 3)) for name in ("bary", *_PLACES)}


def _found(points: Tensor, arrays: dict[str, np.ndarray]) -> Match:
    """The arrays as tensors, numbers in the type of ``points``."""
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    if points.dtype is not torch.float64:
        tensors |= {name: value.to(points.dtype) for name, value in tensors.items() if value.is_floating_point()}
    return Match(**tensors)


#: Incidence, scene and tree of the last topologies.
_TREES: deque[tuple[Tensor, int | None, SurfaceTree]] = deque(maxlen=16)


def _tree_of(faces: Tensor, scene: int | None, face_scene: Tensor, incidence: Sequence[Tensor], pos: Tensor) -> SurfaceTree:
    for key, known, tree in _TREES:
        if key is incidence[0] and known == scene:
            return tree
    members = np.arange(len(faces)) if scene is None else (face_scene == scene).numpy().nonzero()[0]
    arrays = [np.ascontiguousarray(part.numpy(), np.int64) for part in incidence]
    tree = SurfaceTree(faces.numpy(), members, arrays, _double(pos))
    _TREES.append((incidence[0], scene, tree))
    return tree

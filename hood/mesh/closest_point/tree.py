"""Closest points on triangle surfaces by a compiled tree of boxes (``hood/native/surface.cpp``)."""

from __future__ import annotations

import ctypes
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hood import native
from hood.mesh.geometry import MOST_CURVATURE, ROUNDS
from hood.mesh.topology import unique_edges
from hood.native.arguments import COUNT, POINTER, REAL, address_of, fields, num_parts
from hood.native.build import optional
from hood.tensors.batch import forget, made_of

SOURCE = Path(native.__file__).with_name("surface.cpp")
#: Faces of a leaf, as in the source, and bytes of a line of the cache.
_WIDE, _LINE = 8, 64
#: Points that are searched for together, as in the source; fewer where that makes more visits to leaves than this possible.
_MOST, _VISITS = 64, 1 << 18
#: Points of a part that is worth a thread: threads need the normals of all vertices made before they begin.
_POINTS = 1000
#: Searches for so many points at least are remembered, the last few sizes: most likely the same points come again a step later.
_REMEMBERED, _SIZES = 256, 4


class _Tree(ctypes.Structure):
    """``Tree`` of ``surface.cpp``."""

    _fields_ = [
        *fields("num_faces num_vertices num_leaves num_blocks edge_width", COUNT),
        *fields("faces around first valence face_edges edge_faces", POINTER),
        *fields("order place number corner_of block_first block_vertex block_number", POINTER),
        *fields("fan_first fan fan_share", POINTER),
        *fields("pos corners face_boxes boxes block_pos vertex_normal bulge needed stamp", POINTER),
        ("call", COUNT),
        ("origin", ctypes.c_double * 3),
        ("size_sq", ctypes.c_double),
        *fields("batch parts", COUNT),
        *fields("leaf_normals normal_boxes", POINTER),
        *fields("normals_of fits", COUNT),
        *fields("visits next_visits near", POINTER),
    ]


class _Matched(ctypes.Structure):
    """``Matched`` of ``surface.cpp``."""

    _fields_ = [*fields("valid dist point normal", POINTER), *fields("ahead near cosine behind", REAL)]


class _Query(ctypes.Structure):
    """``Query`` of ``surface.cpp``."""

    _fields_ = [
        ("count", COUNT),
        *fields("points next_pos vertex face vertex_dist bary dist", POINTER),
        *fields("point normal next_point next_normal curvature", POINTER),
        ("most_curvature", REAL),
        ("rounds", COUNT),
        ("hint", POINTER),
    ]


#: What is known of a matched point, then and now.
_PLACES = ("point", "normal", "next_point", "next_normal")


class FoldRule(NamedTuple):
    """What another side of a fold is, see :func:`hood.contact.contact.find_second_contact`."""

    ahead: float  # m, it is looked for this far off the skin
    near: float  # m, of points that are nearer
    cosine: float  # of the angle with the normal by which its own are turned at least
    behind: float  # m, it is no farther behind the skin


class Match(NamedTuple):
    """Closest surface points of N points, as in :class:`hood.mesh.closest_point.search.SurfaceHit`, and the same material
    points when the surface has moved on."""

    vertex: Tensor  # (N,)
    vertex_dist: Tensor  # (N,) m
    face: Tensor  # (N,)
    bary: Tensor  # (N, 3)
    dist: Tensor  # (N,) m
    point: Tensor  # (N, 3) m
    normal: Tensor  # (N, 3) outward unit normals there, interpolated over the face
    next_point: Tensor  # (N, 3) m
    next_normal: Tensor  # (N, 3)
    curvature: Tensor | None = None  # (N,) 1/m, of the surface there (hood.mesh.geometry); None where nobody asked for it


@cache
def library() -> ctypes.CDLL | None:
    """The compiled search; None without a compiler."""
    lib = optional(SOURCE)
    if lib is None:
        return None
    return lib


class SurfaceTree:
    """The tree of some faces of a topology; its arrays serve every search.

    Args:
        faces: (G, 3) int64.
        members: (F,) the faces that are in it, at least one.
        incidence: around, first, valence, face_edges and edge_faces of :class:`hood.mesh.closest_point.search.Incidence`.
        pos: (W, 3) m, a shape to order the faces by.
    """

    def __init__(self, faces: np.ndarray, members: np.ndarray, incidence: Sequence[np.ndarray], pos: np.ndarray) -> None:
        lib = library()
        assert lib is not None
        self._lib = lib
        leaves, num_vertices = -(-len(members) // _WIDE), len(pos)  # all leaves are full but one
        blocks = 3 * leaves  # at most: faces without a vertex in common
        groups = (leaves // 7 + 12, 6, _WIDE)  # an eighth, an eighth of that and so on, each rounded up
        batch = max(min(_MOST, _VISITS // leaves), 1)
        integers = {
            "order": (leaves, _WIDE),
            "place": (len(faces),),
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
            "block_pos": (blocks, 3, _WIDE),
            "vertex_normal": (num_vertices, 6),
            "bulge": (2, num_vertices),
        }
        self._arrays = dict(zip(("around", "first", "valence", "face_edges", "edge_faces"), incidence, strict=True))
        self._arrays |= {name: _aligned(shape, np.int32) for name, shape in integers.items()}
        self._arrays |= {name: _aligned(shape, np.float64) for name, shape in reals.items()}
        boxes = {"face_boxes": (leaves, 6, _WIDE), "boxes": groups, "leaf_normals": (leaves, 3, _WIDE), "normal_boxes": groups}
        self._arrays |= {name: _aligned(shape, np.float32) for name, shape in boxes.items()}
        self._arrays["faces"] = np.ascontiguousarray(faces, np.int64)
        self._arrays["order"].reshape(-1)[: len(members)] = members
        self._arrays["place"].fill(-1)
        counts = {"num_faces": len(members), "num_vertices": num_vertices, "edge_width": incidence[4].shape[1]}
        self._tree = _Tree(**counts, batch=batch)
        _point(self._tree, self._arrays)
        self._visits = batch * leaves + _WIDE
        self._share(1)
        centre = np.ascontiguousarray(np.nan_to_num(np.asarray(pos, np.float64)[faces].mean(axis=1)))
        self._fitted: tuple[weakref.ref[Tensor], int | None] | None = None
        self._last: tuple[np.ndarray, dict[str, np.ndarray]] | None = None  # points, and where they are, of the last search
        self._near: dict[int, np.ndarray] = {}  # faces (N,) that the last search for N points found
        lib.surface_build(ctypes.byref(self._tree), centre.ctypes.data_as(POINTER))

    def forget(self) -> None:
        """Search the next time as if there had been no search before."""
        self._near.clear()
        self._last = None

    def _share(self, parts: int) -> None:
        """Search for points in as many parts, by threads of their own; what is found does not depend on it."""
        if parts > self._tree.parts:
            visits = {name: _aligned((parts, self._visits), np.int64) for name in ("visits", "next_visits", "near")}
            self._arrays |= visits
            _point(self._tree, visits)
        self._tree.parts = parts

    def _fit(self, vertices: Tensor) -> None:
        """Take up where the surface is; nothing to do where it was there in the search before."""
        known, version = self._fitted, None if vertices.is_inference() else vertices._version
        if known is not None and version is not None and known[0]() is vertices and known[1] == version:
            self._lib.surface_again(ctypes.byref(self._tree))
            return
        given, self._fitted = _double(vertices), (weakref.ref(vertices), version)
        if known is not None and np.array_equal(self._arrays["pos"], given):
            self._lib.surface_again(ctypes.byref(self._tree))
            return
        self._arrays["pos"][...], self._last = given, None
        self._lib.surface_refit(ctypes.byref(self._tree))

    def search(self, points: np.ndarray, vertices: Tensor, next_pos: np.ndarray, curved: bool) -> dict[str, np.ndarray]:
        """Fields of :class:`Match` for ``points`` (N, 3) on the surface at ``vertices`` (W, 3), with ``next_pos`` (W, 3); the
        arrays in float64 and C-contiguous. The curvature only if it is to be ``curved``."""
        count = len(points)
        found = _arrays(count, curved, np.empty) | self.find(points, vertices)
        query = _Query(count=count, most_curvature=MOST_CURVATURE, rounds=ROUNDS)
        _point(query, {"points": points, "next_pos": next_pos, **found})
        self._lib.surface_describe(ctypes.byref(self._tree), ctypes.byref(query))
        return found

    def find(self, points: np.ndarray, vertices: Tensor) -> dict[str, np.ndarray]:
        """Those of them that do not depend on where the surface goes. A step ends where the next one begins: the same points
        on the same surface are not searched for again."""
        return {name: values.copy() for name, values in self._closest(points, vertices).items()}

    def distances(self, points: np.ndarray, vertices: Tensor) -> np.ndarray:
        """Signed distances (N,) alone."""
        return self._closest(points, vertices)["dist"].copy()

    def _closest(self, points: np.ndarray, vertices: Tensor) -> dict[str, np.ndarray]:
        """The arrays that are remembered themselves: not to be written to."""
        count = len(points)
        self._share(num_parts(count, _POINTS))
        self._fit(vertices)
        if self._last is None or not np.array_equal(self._last[0], points):
            found = _arrays(count, False, np.empty, ("bary",))
            query, given = _Query(count=count), {"points": points, **found}
            if count in self._near:  # what is found does not depend on it, only how soon
                given["hint"] = self._near.pop(count)
            _point(query, given)
            self._lib.surface_find(ctypes.byref(self._tree), ctypes.byref(query))
            self._last = points.copy(), found
            if count >= _REMEMBERED:
                self._near[count] = found["face"]
                if len(self._near) > _SIZES:
                    del self._near[next(iter(self._near))]
        return self._last[1]

    def folds(
        self,
        points: np.ndarray,
        near: dict[str, np.ndarray],
        vertices: Tensor,
        next_pos: np.ndarray,
        rule: FoldRule,
        found: dict[str, np.ndarray],
    ) -> np.ndarray:
        """Which ``points`` (N, 3) have another side than that in ``near``, (N,) bool; ``found`` has room for what it is."""
        count = len(points)
        self._share(num_parts(count, _POINTS))
        self._fit(vertices)
        matched, query = _Matched(**rule._asdict()), _Query(count=count, most_curvature=MOST_CURVATURE, rounds=ROUNDS)
        _point(matched, near)
        _point(query, {"points": points, "next_pos": next_pos, **found})
        other = np.empty(count, bool)
        given = ctypes.byref(self._tree), ctypes.byref(matched), ctypes.byref(query)
        self._lib.surface_folds(*given, other.ctypes.data_as(POINTER))
        return other


def _aligned(shape: tuple[int, ...], kind: type) -> np.ndarray:
    """Zeros that begin with a line of the cache, as vectors are read fastest."""
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    memory = np.zeros(size + _LINE, np.uint8)
    begin = -memory.ctypes.data % _LINE
    return memory[begin : begin + size].view(kind).reshape(shape)


def _point(structure: ctypes.Structure, arrays: dict[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        assert array.flags.c_contiguous, f"{name} has gaps"
        setattr(structure, name, address_of(array) if array.flags.writeable else array.ctypes.data)


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
def distance(
    points: Tensor, point_scene: Tensor, vertices: Tensor, faces: Tensor, face_scene: Tensor, incidence: Sequence[Tensor]
) -> Tensor | None:
    """Signed distances (N,) [m] of points (N, 3) alone, as :func:`search` gives them; None where that does."""
    if type(points) is not Tensor or points.device.type != "cpu" or library() is None:
        return None
    given, scene = _double(points), _only_scene(face_scene)
    if scene is not None and scene == _only_scene(point_scene):
        dist = _tree_of(faces, None, face_scene, incidence, vertices).distances(given, vertices)
        return torch.from_numpy(dist).to(points.dtype)
    dist = np.full(len(points), np.inf)
    for scene in point_scene.unique().tolist():
        rows = (point_scene == scene).numpy().nonzero()[0]
        if bool((face_scene == scene).any()):
            dist[rows] = _tree_of(faces, scene, face_scene, incidence, vertices).distances(given[rows], vertices)
    return torch.from_numpy(dist).to(points.dtype)


def moved(start: np.ndarray, end: np.ndarray) -> tuple[float, float] | None:
    """What :func:`hood.scene.body_motion.mesh_motion.moved` says of points (N, 3), in one pass; None without a compiler.

    The turn is the eigenvector of Horn's matrix (1987), not the singular vectors of Kabsch's: the same rotation.
    """
    lib = library()
    if lib is None:
        return None
    both, found = [np.ascontiguousarray(points, np.float64) for points in (start, end)], np.empty(2)
    lib.surface_moved(COUNT(len(start)), *(POINTER(array.ctypes.data) for array in (*both, found)))
    return float(np.degrees(found[0])), float(found[1])


@torch.no_grad()
def vertex_skin(vertices: Tensor, faces: Tensor, incidence: Sequence[Tensor], curved: bool) -> tuple[Tensor, Tensor] | None:
    """Unit normals (W, 3) and curvatures [1/m] (W,), 0 unless it is to be ``curved``, of a surface at its vertices (W, 3), on a
    CPU, as :mod:`hood.mesh.geometry` has them; None without a compiler. ``incidence``: the adjacency of ``faces`` (G, 3)."""
    lib = library() if vertices.device.type == "cpu" else None
    if lib is None:
        return None
    made = made_of(faces)
    if "skin" not in made:
        tables = faces.numpy(), unique_edges(faces.numpy()), *(tensor.numpy() for tensor in incidence[:3])
        made["skin"] = [np.ascontiguousarray(table, np.int64) for table in tables]
    count = len(vertices)
    normals, of_face, curvature = np.empty((count, 3)), np.empty(len(faces)), np.empty(count)
    counts = len(faces), len(made["skin"][1]) if curved else 0, count
    pointers = (POINTER(array.ctypes.data) for array in (*made["skin"], _double(vertices), normals, of_face, curvature))
    lib.surface_curvature(*map(COUNT, counts), *pointers, REAL(MOST_CURVATURE), COUNT(ROUNDS if curved else 0))
    return torch.from_numpy(normals), torch.from_numpy(curvature)


@torch.no_grad()
def search_folds(
    points: Tensor,
    point_scene: Tensor,
    vertices: Tensor,
    faces: Tensor,
    face_scene: Tensor,
    incidence: Sequence[Tensor],
    next_vertices: Tensor,
    matched: dict[str, Tensor],
    rule: FoldRule,
) -> tuple[Match, Tensor] | None:
    """The other side of folds, see :func:`hood.contact.contact.find_second_contact`, scene by scene: matches with the curvature
    of the ``points`` (N, 3) that have one, zeros for the others, and which they are, (N,) bool. None where there is no compiled
    search, or not for these tensors.

    Args:
        incidence: as for :class:`SurfaceTree`.
        next_vertices: (W, 3) m, where the surface goes.
        matched: of the nearest side ``valid`` (N,) bool, ``dist`` (N,), ``point`` and ``normal`` (N, 3).
    """
    if type(points) is not Tensor or points.device.type != "cpu" or library() is None:
        return None
    given, later = _double(points), _double(next_vertices)
    near = {name: _double(values) for name, values in matched.items() if name != "valid"}
    valid, hits = matched["valid"].numpy(), _arrays(len(points), True, np.zeros)
    other = np.zeros(len(points), bool)
    only = _only_scene(face_scene)
    whole = only is not None and only == _only_scene(point_scene)
    for scene in [None] if whole else point_scene.unique().tolist():
        if scene is None or bool((face_scene == scene).any()):
            tree = _tree_of(faces, scene, face_scene, incidence, vertices)
            own = valid if scene is None else valid & (point_scene == scene).numpy()
            other |= tree.folds(given, near | {"valid": np.ascontiguousarray(own)}, vertices, later, rule, hits)
    return _found(points, hits), torch.from_numpy(other)


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


def _arrays(
    count: int, curved: bool, made: Callable[..., np.ndarray], places: Sequence[str] = ("bary", *_PLACES)
) -> dict[str, np.ndarray]:
    """Room for fields of :class:`Match`."""
    whole: dict[str, np.ndarray] = {name: made(count, np.int64) for name in ("vertex", "face")}
    real = {name: made(count) for name in ("vertex_dist", "dist", *(["curvature"] if curved else []))}
    return whole | real | {name: made((count, 3)) for name in places}


def _nothing(count: int, curved: bool) -> dict[str, np.ndarray]:
    return _arrays(count, curved, np.zeros) | {name: np.full(count, np.inf) for name in ("vertex_dist", "dist")}


def _found(points: Tensor, arrays: dict[str, np.ndarray]) -> Match:
    """The arrays as tensors, numbers in the type of ``points``."""
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    if points.dtype is not torch.float64:
        tensors |= {name: value.to(points.dtype) for name, value in tensors.items() if value.is_floating_point()}
    return Match(**tensors)


#: Incidence, scene and tree of the last topologies.
_TREES: deque[tuple[Tensor, int | None, SurfaceTree]] = deque(maxlen=16)


def forget_searches() -> None:
    """Search the next time as if there had been no searches before: what is found is the same, later where it is far away."""
    for _, _, tree in _TREES:
        tree.forget()


def _tree_of(faces: Tensor, scene: int | None, face_scene: Tensor, incidence: Sequence[Tensor], pos: Tensor) -> SurfaceTree:
    for key, known, tree in _TREES:
        if key is incidence[0] and known == scene:
            return tree
    members = np.arange(len(faces)) if scene is None else (face_scene == scene).numpy().nonzero()[0]
    arrays = [np.ascontiguousarray(part.numpy(), np.int64) for part in incidence]
    tree = SurfaceTree(faces.numpy(), members, arrays, _double(pos))
    _TREES.append((incidence[0], scene, tree))
    return tree
